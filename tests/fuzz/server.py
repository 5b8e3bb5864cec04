"""Runs cases, each in a process of its own with a limit of time and of memory.

    python tests/fuzz/server.py TARGET FIRST COUNT   # cases by number: always the same ones
    python tests/fuzz/server.py --corpus             # the inputs that once failed

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
from contextlib import redirect_stderr
from pathlib import Path
from random import Random
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from fuzz.mutate import damage
from fuzz.targets import TARGETS, implausible

from shiftsim.errors import ConfigError, ShiftsimError

SECONDS, MEMORY = 5.0, 1 << 30
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
        return ("hang" if end == signal.SIGALRM else "crash"), signal.Signals(end).name
    return tuple(json.loads(answer))


def _limit() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, SECONDS)


def _read(target: str, folder: Path) -> tuple[str, str]:
    try:
        with open(os.devnull, "w") as nowhere, redirect_stderr(nowhere):
            bad = list(implausible(TARGETS[target].read(folder)))
        return ("garbage", "; ".join(bad[:3])) if bad else ("ok", "")
    except ShiftsimError as error:
        fault = _fault(error, folder)
        return (fault or "refused"), f"{error} [{error.hint}]"[:2000]
    except BaseException:
        return "traceback", traceback.format_exc()[-3000:]


def _fault(error: Any, folder: Path) -> str:
    """What is wrong with an error of ours; nothing with a good one."""
    text, cause = str(error), error
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


def cases(target: str, first: int, count: int, *, keep: Path | None = None) -> Iterator[Any]:
    """Damage copies of the seeds, and read them; number, way, outcome, details."""
    base = Path(
        tempfile.mkdtemp(prefix="fuzz-", dir="/dev/shm" if os.path.isdir("/dev/shm") else None)
    )
    try:
        (base / "seeds").mkdir()
        TARGETS[target].seeds(base / "seeds")
        seeds = sorted((base / "seeds").iterdir())
        for seed in seeds:  # the sound ones: everything is imported and compiled after it
            shutil.copytree(seed, base / "cases" / "warm", dirs_exist_ok=True)
            bad = list(implausible(TARGETS[target].read(base / "cases" / "warm")))
            assert not bad, (seed.name, bad)
            shutil.rmtree(base / "cases" / "warm")
        for number in range(first, first + count):
            random = Random(f"{target} {number}")
            folder = base / "cases" / f"case{number}"
            shutil.copytree(random.choice(seeds), folder)
            files = sorted(p for p in folder.rglob(TARGETS[target].damaged) if p.is_file())
            ways = [damage(random.choice(files), random) for _ in range(random.choice((1, 1, 2)))]
            outcome, details = run_case(target, folder)
            if keep is not None and outcome not in ("ok", "refused"):
                shutil.copytree(folder, keep / target / f"{number}", dirs_exist_ok=True)
            shutil.rmtree(folder)
            yield number, "; ".join(ways), outcome, details
    finally:
        shutil.rmtree(base, ignore_errors=True)


def main() -> None:
    """As the module says."""
    target, first, count = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    keep = Path(os.environ["FUZZ_KEEP"]) if "FUZZ_KEEP" in os.environ else None
    for case in cases(target, first, count, keep=keep):
        print(json.dumps(case), flush=True)


if __name__ == "__main__":
    main()
