"""What a first run compiles: said while it happens, or done beforehand by `doctor --compile`."""

import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import Any

from shiftsim.kernels import CACHE_FOLDER, machine_code

_KERNELS_OF_A_RUN = 110  # about as many does a run compile, by its planner and traffic
_LOOK_EVERY = 0.5  # s


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


def compile_kernels(
    advance: Callable[[int, int, str], None] = lambda done, total, note: None,
) -> Compiled:
    """Make small runs that together use every kernel of a run.

    Raises:
        ShiftsimError: A run failed.
    """
    from shiftsim.api import run
    from shiftsim.data.synthetic.store import demo_store

    began, before = perf_counter(), len(machine_code())
    runs = [*_runs()]
    with tempfile.TemporaryDirectory(prefix="shiftsim-kernels-") as folder:
        store = demo_store(Path(folder, "demo"))
        for number, (planners, settings) in enumerate(runs):
            advance(number, len(runs), f"{', '.join(planners)} in {settings['traffic']} traffic")
            common: dict[str, Any] = {
                "store": str(store),
                "split": "demo-mini",
                "limit": 6,
                "workers": 1,
            }
            run(planners, noise=["ou-high"], out=f"{folder}/run-{number}", **common, **settings)
        advance(len(runs), len(runs), "")
    files = machine_code()
    return Compiled(
        folder=CACHE_FOLDER,
        files=len(files),
        bytes=sum(path.stat().st_size for path in files),
        compiled=len(files) - before,
        seconds=perf_counter() - began,
    )


def _runs() -> Iterator[tuple[Sequence[str], dict[str, Any]]]:
    """Planners and settings of runs that together use every kernel."""
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


@contextmanager
def compiling_shown(say: Callable[[str], None]) -> Iterator[None]:
    """Say in one line that a first run compiles, how far it is, and that this happens once.

    Nothing is said where the kernels of a run are there already.
    """
    ended = threading.Event()

    def watch() -> None:
        while not ended.wait(_LOOK_EVERY):
            count = len(machine_code())
            if count >= _KERNELS_OF_A_RUN:
                return
            say(f"compiling kernels, once per version: {count} of about {_KERNELS_OF_A_RUN}")

    if len(machine_code()) >= _KERNELS_OF_A_RUN or not CACHE_FOLDER:
        yield
        return
    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
