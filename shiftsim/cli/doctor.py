"""Commands that try this installation: doctor, and verify on whole folders of reference outputs.

The few reference values that come with the package are compared by the code that `verify` uses.
"""

import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import typer

from shiftsim.cli import Advance, Debug, Json, Quiet, progress_bar, say, show
from shiftsim.files import PACKAGE

REFERENCE = PACKAGE / "verify" / "reference"
_DATA = 2


def verify(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of reference outputs.")],
    experiment: Annotated[
        bool, typer.Option("--experiment", help="DIR holds what nuPlan's run_simulation.py wrote.")
    ] = False,
    store: Annotated[
        str | None, typer.Option("--store", "-s", help="Store with the scenarios of --experiment.")
    ] = None,
    mode: Annotated[str | None, typer.Option(help="Only runs of this mode: NR, R or PT.")] = None,
    scenes: Annotated[Path | None, typer.Option(help="Folder with logs and maps.")] = None,
    maps: Annotated[Path | None, typer.Option(help="Folder with OpenDRIVE maps.")] = None,
    require_all: Annotated[
        bool, typer.Option("--require-all", help="Exit with 3 if anything is not covered.")
    ] = False,
    debug: Debug = False,
) -> None:
    """Compare with reference outputs of nuPlan's own code, or with results of your own from nuPlan.

    Exit codes: 0 all covered cases equal, 1 a mismatch, 2 nothing covered or not recognised,
    3 not all covered (with --require-all).
    """
    from shiftsim.errors import one_of
    from shiftsim.verify import MODES
    from shiftsim.verify import verify as compare

    if mode is not None:
        one_of("mode", mode, MODES)
    kind = "experiment" if experiment else None
    result = compare(folder, kind=kind, mode=mode, scenes=scenes, maps=maps, store=store)
    for line in result.lines():
        say(line)
    raise typer.Exit(result.exit_code(require_all=require_all))


def doctor(
    fills: Annotated[
        bool, typer.Option("--compile", help="First compile all kernels that runs need.")
    ] = False,
    quiet: Quiet = False,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Versions, cores and memory, and whether the kernels compute what they should."""
    kernels = None
    if fills:
        with progress_bar(quiet=quiet or as_json) as advance:
            kernels = compile_kernels(advance)
    with progress_bar(quiet=quiet or as_json) as advance:
        found = replace(examine(advance), kernels=kernels)
    show(asdict(found), found.lines(), as_json=as_json)
    if not found.is_well:
        raise typer.Exit(_DATA)


@dataclass(frozen=True)
class Compiled:
    """What `compile_kernels` left on disk."""

    folder: str  # where the machine code is
    files: int  # kernels, one for each combination of types
    bytes: int  # their size
    compiled: int  # of the files, those that were not there before
    seconds: float  # from start to end [s]

    def line(self) -> str:
        """As text."""
        return (
            f"kernels: {self.files} ({self.bytes / 1e6:.1f} MB) in {self.folder}, "
            f"{self.compiled} of them compiled in {self.seconds:.0f} s"
        )


@dataclass(frozen=True)
class Diagnosis:
    """What was found."""

    versions: dict[str, str]  # of Python and the packages that matter
    torch: str  # what learned planners would run on
    cores: int  # cores this process may use
    memory: int  # memory of the machine [bytes], 0 where unknown
    workers: int  # suggested number of worker processes
    kernel_cache: str  # folder of compiled kernels
    seconds: float  # how long the checks took, compilation included [s]
    cases: int  # reference values compared
    mismatches: tuple[str, ...]  # those that differ, in words
    kernels: Compiled | None = None  # what was compiled before, where it was asked for

    @property
    def is_well(self) -> bool:
        """Whether results can be trusted."""
        return self.cases > 0 and not self.mismatches

    def lines(self) -> list[str]:
        """As text."""
        packages = "  ".join(f"{name} {version}" for name, version in self.versions.items())
        memory = f"{self.memory / 1e9:.1f} GB memory" if self.memory else "memory unknown"
        equal = self.cases - len(self.mismatches)
        return [
            f" {packages}",
            f" torch: {self.torch}",
            f" {self.cores} cores, {memory}, suggested workers {self.workers}",
            f" kernel cache: {self.kernel_cache}",
            *([f" {self.kernels.line()}"] if self.kernels else []),
            f" reference checks {equal}/{self.cases} equal in {self.seconds:.1f} s",
            *(f" MISMATCH {line}" for line in self.mismatches[:20]),
        ]


def examine(advance: Advance = lambda done, total, note: None) -> Diagnosis:
    """Examine this installation; compiles the kernels that are not in the cache yet."""
    from shiftsim.kernels import CACHE_FOLDER
    from shiftsim.runs.config import default_workers
    from shiftsim.runs.manifest import versions
    from shiftsim.verify import verify

    began = perf_counter()
    reports = []
    advance(0, 3, "torch")
    torch = _torch()
    advance(1, 3, "dynamics")
    reports.append(verify(REFERENCE / "dynamics"))
    advance(2, 3, "metrics")
    reports.append(verify(REFERENCE / "metric_worlds"))
    advance(3, 3, "")
    return Diagnosis(
        versions=versions(),
        torch=torch,
        cores=default_workers(memory_each=1.0),
        memory=_memory(),
        workers=default_workers(),
        kernel_cache=CACHE_FOLDER or "none can be written",
        seconds=perf_counter() - began,
        cases=sum(report.num_cases for report in reports),
        mismatches=tuple(line for report in reports for line in report.mismatches),
    )


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


def compile_kernels(advance: Advance) -> Compiled:
    """Make small runs that together use every kernel of a run.

    Raises:
        ShiftsimError: A run failed.
    """
    from shiftsim.api import run
    from shiftsim.data.synthetic.store import demo_store
    from shiftsim.kernels import CACHE_FOLDER, machine_code

    began, before = perf_counter(), len(machine_code())
    runs = [*_compiling_runs()]
    with tempfile.TemporaryDirectory(prefix="shiftsim-kernels-") as folder:
        store = demo_store(Path(folder, "demo"))
        for number, (planners, settings) in enumerate(runs):
            advance(number, len(runs), f"{', '.join(planners)} in {settings['traffic']} traffic")
            settings |= {"store": str(store), "split": "demo-mini", "limit": 6, "workers": 1}
            run(planners, noise="ou-high", out=f"{folder}/run-{number}", **settings)
        advance(len(runs), len(runs), "")
    files = machine_code()
    return Compiled(
        folder=CACHE_FOLDER,
        files=len(files),
        bytes=sum(path.stat().st_size for path in files),
        compiled=len(files) - before,
        seconds=perf_counter() - began,
    )


def _compiling_runs() -> Iterator[tuple[Sequence[str], dict[str, Any]]]:
    """Planners and settings of runs that together use every kernel."""
    from importlib.util import find_spec

    from shiftsim.planners.table import PLANNERS

    learned = [name for name, entry in PLANNERS.items() if entry.kind == "learned"]
    rules = [name for name in PLANNERS if name not in ("scripted", *learned)]
    yield ["constant-velocity"], {"traffic": "reactive"}
    yield rules, {"traffic": "nonreactive"}
    yield ["constant-velocity"], {"traffic": "constant-velocity", "controller": "perfect"}
    if find_spec("torch") is not None:
        drawn = {name: {"checkpoint": "deterministic:drive"} for name in learned}
        yield learned, {"traffic": "nonreactive", "planner_args": drawn}
        yield ["constant-velocity"], {"traffic": "learned"}
