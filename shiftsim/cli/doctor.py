"""Commands that try this installation: doctor, and verify on a user's own results from nuPlan."""

import os
import tempfile
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import Any

from typer import Argument, Option

import shiftsim
from shiftsim import cli
from shiftsim.cli import Advance, Json, Quiet, echo, print_result, progress_bar
from shiftsim.errors import ConfigError, DataError, one_of


def verify(
    folder: Path = Argument(metavar="DIR", help="Folder of results."),
    experiment: bool = Option(
        False, "--experiment", help="DIR holds what nuPlan's run_simulation.py wrote."
    ),
    store: str | None = Option(
        None, "--store", "-s", help="Store with the scenarios of --experiment."
    ),
    mode: str | None = Option(None, help="Only runs of this mode: NR, R or PT."),
    require_all: bool = Option(
        False, "--require-all", help="Exit with 3 if anything is not covered."
    ),
) -> int:
    """Compare your nuPlan results with what shiftsim computes.

    Exit codes: 0 all covered cases equal, 1 a mismatch or a wrong setting, 2 nothing covered,
    3 not all covered (with --require-all).
    """
    from shiftsim.verify.experiment import verify_experiment
    from shiftsim.verify.rollouts import CHALLENGES

    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder")
    if not experiment:
        raise ConfigError(
            f"{folder}: without --experiment there is nothing to compare it with",
            hint="results of nuPlan's own simulation: shiftsim verify --experiment DIR --store "
            "NAME; reference outputs: python -m pytest tests/parity --reference DIR in a checkout",
        )
    if mode is not None:
        one_of("mode", mode, tuple(CHALLENGES))
    if store is None:
        raise ConfigError(
            f"{folder}: nothing says where the scenarios are",
            hint="--store NAME; shiftsim convert nuplan LOGS MAPS --store NAME makes it",
        )
    opened = cli.open_store(store)
    result = verify_experiment(
        folder, lambda token: opened.read_recorded(token) if token in opened else None, mode
    )
    echo("\n".join(result.lines()))
    return result.exit_code(require_all=require_all)


def doctor(
    fills: bool = Option(False, "--compile", help="First compile all kernels that runs need."),
    quiet: Quiet = False,
    as_json: Json = False,
) -> int:
    """Versions, cores and memory, and whether the kernels compute what they should."""
    kernels = None
    if fills:
        with progress_bar(quiet=quiet or as_json) as advance:
            kernels = compile_kernels(advance)
    with progress_bar(quiet=quiet or as_json) as advance:
        found = examine(advance, kernels)
    print_result(found, diagnosis_lines(found), as_json=as_json)
    return cli.DATA if found["mismatches"] or not found["cases"] else 0


_MAX_NAMED = 20  # mismatches that are printed
_COMPILED = (
    " kernels: {files} ({bytes:.3g} bytes) in {folder}, {compiled} of them compiled in "
    "{seconds:.0f} s"
)


def examine(
    advance: Advance = lambda *progress: None, kernels: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Examine this installation; compiles the kernels that are not in the cache yet."""
    from shiftsim.kernels import CACHE_FOLDER
    from shiftsim.runs.config import default_workers
    from shiftsim.runs.manifest import versions
    from shiftsim.verify.report import Report
    from shiftsim.verify.rollouts import CHECKS, check_reference

    began, report = perf_counter(), Report()
    advance(0, len(CHECKS) + 1, "torch")
    torch = _torch()
    for number, name in enumerate(CHECKS, start=1):
        advance(number, len(CHECKS) + 1, name)
        check_reference(name, report)
    advance(len(CHECKS) + 1, len(CHECKS) + 1)
    return {
        "versions": versions(),  # of Python and the packages that matter
        "torch": torch,  # what learned planners would run on
        "cores": default_workers(memory_each=1.0),  # that this process may use
        "memory": _memory(),  # of the machine [bytes], 0 where unknown
        "workers": default_workers(),  # suggested number of worker processes
        "kernel_cache": CACHE_FOLDER or "none can be written",
        "seconds": perf_counter() - began,  # that the checks took, compilation included
        "cases": report.num_cases,  # reference values compared
        "mismatches": list(report.mismatches),  # those that differ, in words
        "kernels": kernels,  # of `compile_kernels`, where it was asked for
    }


def diagnosis_lines(found: dict[str, Any]) -> Iterator[str]:
    """What `examine` found, as text."""
    wrong, cases = found["mismatches"], found["cases"]
    memory = f"{found['memory'] / 1e9:.1f} GB memory" if found["memory"] else "memory unknown"
    yield f" {'  '.join(f'{name} {version}' for name, version in found['versions'].items())}"
    yield f" torch: {found['torch']}"
    yield f" {found['cores']} cores, {memory}, suggested workers {found['workers']}"
    yield f" kernel cache: {found['kernel_cache']}"
    if found["kernels"]:
        yield _COMPILED.format(**found["kernels"])
    yield f" reference checks {cases - len(wrong)}/{cases} equal in {found['seconds']:.1f} s"
    yield from (f" MISMATCH {line}" for line in wrong[:_MAX_NAMED])
    if len(wrong) > _MAX_NAMED:
        yield f" and {len(wrong) - _MAX_NAMED} more mismatches: --json lists them"


def _memory() -> int:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return 0


def _torch() -> str:
    try:
        import torch
    except ImportError:
        return "not installed (learned planners: pip install 'shiftsim[learned]')"
    if not torch.cuda.is_available():
        return f"{torch.__version__}, no CUDA device"
    names = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    return f"{torch.__version__}, CUDA {torch.version.cuda}: {', '.join(names)}"


def compile_kernels(advance: Advance) -> dict[str, Any]:
    """Make small runs that together use every kernel of a run; what is on disk then."""
    from shiftsim.data.synthetic.store import demo_store
    from shiftsim.kernels import CACHE_FOLDER, machine_code

    began, before = perf_counter(), len(machine_code())
    runs = [*_compiling_runs()]
    with tempfile.TemporaryDirectory(prefix="shiftsim-kernels-") as folder:
        store = demo_store(Path(folder, "demo"))
        for number, (planners, settings) in enumerate(runs):
            advance(number, len(runs), f"{', '.join(planners)} in {settings['traffic']} traffic")
            chosen: dict[str, Any] = {"store": str(store), "split": "demo-mini", "limit": 6}
            chosen |= {"workers": 1, "noise": "ou-high", "out": f"{folder}/run-{number}"}
            shiftsim.run(planners, **chosen | settings)
        advance(len(runs), len(runs))
    files = machine_code()
    return {
        "folder": CACHE_FOLDER,
        "files": len(files),
        "bytes": sum(path.stat().st_size for path in files),
        "compiled": len(files) - before,
        "seconds": perf_counter() - began,
    }


def _compiling_runs() -> Iterator[tuple[Sequence[str], dict[str, Any]]]:
    """Planners and settings of runs that together use every kernel."""
    from shiftsim.planners.table import PLANNERS

    learned = [name for name, entry in PLANNERS.items() if entry.kind == "learned"]
    rules = [name for name in PLANNERS if name not in ("scripted", *learned)]
    yield ["constant-velocity"], {"traffic": "reactive"}
    yield rules, {"traffic": "nonreactive"}
    yield ["constant-velocity"], {"traffic": "constant-velocity", "controller": "perfect"}
    if find_spec("torch") is not None:
        drawn = {name: {"checkpoint": "deterministic:drive"} for name in learned}
        # one scenario: networks take long, and have few kernels of their own
        yield learned, {"traffic": "nonreactive", "planner_args": drawn, "limit": 1}
        yield ["constant-velocity"], {"traffic": "learned"}
