"""`shiftsim demo`."""

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from shiftsim import cli
from shiftsim.cli import Debug, Quiet, plural, progress_bar, say
from shiftsim.cli.running import run_config
from shiftsim.errors import ConfigError

_PLANNERS = ("log-future", "idm", "constant-velocity")
_NOISE = ("none", "ou-high")


@cli.with_settings("workers", "limit")
def demo(
    out: Annotated[Path | None, typer.Option(help="Folder of the store.")] = None,
    towns: Annotated[
        int | None, typer.Option(min=1, help="Only make a store of N random towns to train in.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Of the random towns; same seed, same bytes. [0]")
    ] = None,
    *,
    settings: cli.Settings,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Generate small recordings, convert them, run three planners clean and disturbed.

    With --towns, generate, convert and filter random towns to train in, and run nothing.
    """
    from shiftsim.files import store_path

    if towns is not None:
        _make_towns(out, towns, seed or 0, settings, quiet=quiet)
        return
    if seed is not None:
        raise ConfigError("--seed is of random towns only", hint="say how many with --towns")
    from shiftsim.data.synthetic.store import DEMO_SPLIT, demo_store
    from shiftsim.runs.config import DEFAULT_STORE, make_config

    folder = out or store_path(DEFAULT_STORE)
    if not folder.exists():
        say(f"generating and converting recordings, compiling kernels → {folder}")
        demo_store(folder)
    values: dict[str, Any] = {
        "planners": list(_PLANNERS),
        "noise": list(_NOISE),
        "store": str(folder) if out else DEFAULT_STORE,
        "split": DEMO_SPLIT,
        **settings,
    }
    try:
        run_config(make_config(values, where="demo"), quiet=quiet)
    finally:
        named = f" --store {folder}" if out else ""
        say()
        say("next:")
        say(f"  shiftsim run --planner idm --noise awgn-mid --seeds 0,1,2{named}")
        say(f"  shiftsim run --planner my_package.my_module:MyPlanner{named}")
        say("  shiftsim report runs/<id>        shiftsim view runs/<id>")
        say("  shiftsim explain runs/<id> TOKEN")
        say("  shiftsim planners list           shiftsim --help")


def _make_towns(
    out: Path | None, towns: int, seed: int, settings: cli.Settings, *, quiet: bool
) -> None:
    """Generate, convert and filter random towns."""
    if "limit" in settings:
        raise ConfigError("--limit is of runs, --towns runs nothing", hint="leave one of them out")
    from shiftsim.data.synthetic.store import write_towns
    from shiftsim.files import store_path
    from shiftsim.runs.config import default_workers
    from shiftsim.runs.filter import filter_store
    from shiftsim.runs.workers import map_unordered

    folder = out or store_path(f"towns-{seed}")
    workers = settings.get("workers", 0) or default_workers()
    say(f"generating and converting {plural(towns, 'town')} of seed {seed} → {folder}")
    with progress_bar(quiet=quiet) as advance:
        spread = partial(map_unordered, workers=min(workers, towns), alone=1)
        write_towns(folder, towns=towns, seed=seed, spread=spread, progress=advance)
    say("driving every scenario as recorded, to leave out those that cannot be driven so")
    with progress_bar(quiet=quiet) as advance:
        found = filter_store(
            folder, workers=workers, on_progress=lambda done, total: advance(done, total, "")
        )
    counts = found.counts()
    say(f" {counts['accepted']} of {plural(len(found.rows), 'scenario')} accepted → {folder}")
    say(f" next: shiftsim run --planner log-future --store {folder} --limit 20")
