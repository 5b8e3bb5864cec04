"""`shiftsim demo`."""

from pathlib import Path
from typing import Annotated, Any

import typer

from shiftsim import cli
from shiftsim.cli import Debug, Quiet, say
from shiftsim.cli.running import run_config

_PLANNERS = ("log-future", "idm", "constant-velocity")
_NOISE = ("none", "ou-high")


@cli.with_settings("workers", "limit")
def demo(
    out: Annotated[Path | None, typer.Option(help="Folder of the demo store.")] = None,
    *,
    settings: cli.Settings,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Generate small recordings, convert them, run three planners clean and disturbed."""
    from shiftsim.data.demo.store import DEMO_SPLIT, demo_store
    from shiftsim.files import store_path
    from shiftsim.runs.config import DEFAULT_STORE, make_config
    from shiftsim.verify.warmup import warm_up

    folder = out or store_path(DEFAULT_STORE)
    if not folder.exists():
        say(f"generating and converting recordings, compiling kernels → {folder}")
        with warm_up():
            demo_store(folder)
    values: dict[str, Any] = {
        "planners": list(_PLANNERS),
        "noise": list(_NOISE),
        "store": str(folder) if out else DEFAULT_STORE,
        "split": DEMO_SPLIT,
        **settings,
    }
    try:
        run_config(make_config(values, where="demo"), dry_run=False, quiet=quiet, as_json=False)
    finally:
        named = f" --store {folder}" if out else ""
        say()
        say("next:")
        say(f"  shiftsim run --planner idm --noise awgn-mid --seeds 0,1,2{named}")
        say(f"  shiftsim run --planner my_package.my_module:MyPlanner{named}")
        say("  shiftsim report runs/<id>        shiftsim view runs/<id>")
        say("  shiftsim explain runs/<id> TOKEN")
        say("  shiftsim planners list           shiftsim --help")
