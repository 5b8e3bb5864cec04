"""Runs cases, each in a process of its own with a limit of time and of memory.

    python tests/fuzz/server.py TARGET FIRST COUNT   # cases by number: always the same ones
    python tests/fuzz/server.py                      # the inputs that once failed, of all targets

One line of JSON per case goes to the standard output. The processes are forks of this one, so that
imports and kernels are paid for once.
"""

import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr
from itertools import chain
from pathlib import Path
from random import Random
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from fuzz.mutate import damage
from fuzz.targets import TARGETS, implausible

from shiftsim.errors import ConfigError, ShiftsimError

SECONDS, MEMORY = 5.0, 1 << 30  # of the processor, as others may use it, too; bytes
PATIENCE = 60.0  # s of waiting
_HANGS = (signal.SIGPROF, signal.SIGALRM)
CORPUS = Path(__file__).parent / "corpus"


def run_case(target: str, folder: Path) -> tuple[str, str]:
    """What became of reading a folder: `ok`, `refused` or a failure, and the details."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reader)
        _limit()
        answer = json.dumps(_read(target, folder))
        os.write(writer, answer.encode())
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as pipe:
        answer = pipe.read()
    _, status = os.waitpid(child, 0)
    if os.WIFSIGNALED(status):
        end = os.WTERMSIG(status)
        return ("hang" if end in _HANGS else "crash"), signal.Signals(end).name
    return tuple(json.loads(answer))


def _limit() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    for end in _HANGS:
        signal.signal(end, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    signal.setitimer(signal.ITIMER_REAL, PATIENCE)


def _read(target: str, folder: Path) -> tuple[str, str]:
    try:
        with open(os.devnull, "w") as nowhere, redirect_stderr(nowhere):
            bad = list(implausible(TARGETS[target].read(folder)))
        return ("garbage", "; ".join(bad[:3])) if bad else ("ok", "")
    except ShiftsimError as error:
        fault = _fault(error, folder)
        return (fault or "refused"), f"{error.message} [{error.hint}]"[:2000]
    except BaseException:
        return "traceback", traceback.format_exc()[-3000:]


def _fault(error: Any, folder: Path) -> str:
    """What is wrong with an error of ours; nothing with a good one."""
    text, cause = error.message, error
    while cause is not None:
        if isinstance(cause, MemoryError):
            return "memory"
        cause = cause.__cause__
    names = {"scenario '", *(path.name for path in folder.rglob("*"))}
    if "\n" in text or len(text) > 1500:
        return "long message"
    if not any(name in text for name in names):
        return "no file named"
    return "" if error.hint or isinstance(error, ConfigError) else "no hint"


@contextmanager
def seeds_of(target: str) -> Iterator[tuple[list[Path], Path]]:
    """The sound inputs of a reader, each read once, and the folder for cases."""
    shared = "/dev/shm" if os.path.isdir("/dev/shm") else None
    with tempfile.TemporaryDirectory(prefix="fuzz-", dir=shared) as base:
        folder = Path(base) / "seeds"
        folder.mkdir()
        TARGETS[target].seeds(folder)
        seeds = sorted(folder.iterdir())
        for seed in seeds:  # everything is imported and compiled after it
            warm = shutil.copytree(seed, Path(base) / "cases/warm")
            bad = list(implausible(TARGETS[target].read(warm)))
            assert not bad, (seed.name, bad)
            shutil.rmtree(warm)
        yield seeds, folder.parent / "cases"


def fuzz(target: str, first: int, count: int, keep: Path | None = None) -> Iterator[Any]:
    """Damage copies of the seeds, and read them; number, way, outcome, details."""
    with seeds_of(target) as (seeds, place):
        for number in range(first, first + count):
            random = Random(f"{target} {number}")
            seed = random.choice(seeds)
            folder = shutil.copytree(seed, place / f"case{number}")
            files = sorted(p for p in folder.rglob(TARGETS[target].damaged) if p.is_file())
            ways = [damage(random.choice(files), random) for _ in range(random.choice((1, 1, 2)))]
            changed = {
                path.relative_to(folder): path.read_bytes()
                for path in files
                if path.read_bytes() != (seed / path.relative_to(folder)).read_bytes()
            }
            outcome, details = run_case(target, folder)
            if keep is not None and outcome not in ("ok", "refused"):
                for name, data in changed.items():
                    kept = keep / target / f"{seed.name}-{number}" / name
                    kept.parent.mkdir(parents=True, exist_ok=True)
                    kept.write_bytes(data)
            shutil.rmtree(folder)
            yield number, "; ".join(ways), outcome, details


def replay(target: str) -> Iterator[Any]:
    """Read what is kept of inputs that once failed: the files that differ from a seed."""
    with seeds_of(target) as (seeds, place):
        for kept in sorted((CORPUS / target).glob("*")):
            seed = next(seed for seed in seeds if seed.name == kept.name.rpartition("-")[0])
            folder = shutil.copytree(seed, place / kept.name)
            shutil.copytree(kept, folder, dirs_exist_ok=True)
            yield (f"{target}/{kept.name}", "kept", *run_case(target, folder))


def main() -> None:
    """As the module says; with a folder in `FUZZ_KEEP`, what fails is kept there."""
    keep = Path(os.environ["FUZZ_KEEP"]) if "FUZZ_KEEP" in os.environ else None
    if len(sys.argv) > 1:
        found = fuzz(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), keep)
    else:
        found = chain.from_iterable(map(replay, TARGETS))
    for case in found:
        print(json.dumps(case), flush=True)


if __name__ == "__main__":
    main()
