"""Whether a checkout is slower than another: python benchmarks/speed/compare.py OLD NEW.

Runs the short benchmarks of both checkouts in alternation, each with its own files and its own
cached kernels, and prints the ratio new / old of the time of each, and their geometric mean. Times
are CPU times: medians within a round, the lowest over the rounds. Exits with 1 past a limit.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

FILES = ("dynamics", "metrics", "planners", "traffic", "pdm", "store", "scenario", "nets")
LONG = "memory or help or batch_against or gpu or first_step or plain_one"
SCENES = ("bench_scene_100", "s04_left_turn")  # of the ten that networks drive
OPTIONS = "-q -p no:cacheprovider --benchmark-disable-gc --benchmark-timer=time.process_time"


def selection(keyword: str) -> str:
    """The expression for pytest's `-k`: short benchmarks, and those that the user names."""
    short = f"not ({LONG}) and (not stages or {' or '.join(SCENES)})"
    return f"({short}) and ({keyword})" if keyword else short


def measure(checkout: Path, keyword: str) -> dict[str, float]:
    """One round in a checkout: median CPU time [s] by benchmark.

    Raises:
        SystemExit: The benchmarks of the checkout failed.
    """
    folder = Path("shiftsim/benchmarks/speed")
    files = [str(folder / f"test_{name}.py") for name in FILES]
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    environment.pop("NUMBA_CACHE_DIR", None)  # each checkout has a cache of its own
    with tempfile.TemporaryDirectory() as made:
        out = Path(made) / "figures.json"
        command = [sys.executable, "-m", "pytest", *OPTIONS.split(), *files, "-k", keyword]
        command.append(f"--benchmark-json={out}")
        done = subprocess.run(command, cwd=checkout, env=environment, capture_output=True)
        if done.returncode:
            sys.exit(f"{checkout}: the benchmarks failed\n{done.stdout.decode()[-4000:]}")
        entries = json.loads(out.read_text("utf-8"))["benchmarks"]
    figures = {}
    for entry in entries:
        several = entry["extra_info"].get("seconds")
        parts = {f": {part}": value for part, value in several.items()} if several else None
        for part, seconds in (parts or {"": entry["stats"]["median"]}).items():
            figures[entry["name"].removeprefix("test_") + part] = seconds
    return figures


def lowest(rounds: list[dict[str, float]]) -> dict[str, float]:
    """The lowest figure of each benchmark over the rounds: what else runs only adds time."""
    return {name: min(figures[name] for figures in rounds) for name in rounds[0]}


def main() -> None:
    """Measure, print, and exit with 1 when the new checkout is too slow."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("-k", default="", help="only these, as in pytest")
    parser.add_argument("--rounds", type=int, default=3, help="of both checkouts")
    parser.add_argument("--mean-limit", type=float, default=1.03, help="of the geometric mean")
    parser.add_argument("--single-limit", type=float, default=1.15, help="of each benchmark")
    given = parser.parse_args()
    checkouts, keyword = (given.old.resolve(), given.new.resolve()), selection(given.k)
    rounds: tuple[list[dict[str, float]], ...] = ([], [])
    for _ in range(given.rounds):
        for figures, checkout in zip(rounds, checkouts, strict=True):
            figures.append(measure(checkout, keyword))
    old, new = map(lowest, rounds)
    ratios = {name: new[name] / old[name] for name in old if name in new}
    for name, ratio in sorted(ratios.items(), key=lambda item: item[1]):
        slow = "  TOO SLOW" if ratio > given.single_limit else ""
        print(f"{ratio:6.3f}  {name:60} {old[name] * 1e6:10.1f} -> {new[name] * 1e6:.1f} µs{slow}")
    for name in sorted(old.keys() ^ new.keys()):
        print(f"        {name:60} only in the {'old' if name in old else 'new'} checkout")
    mean = float(np.exp(np.mean(np.log([*ratios.values()]))))
    print(f"{mean:6.3f}  geometric mean of {len(ratios)}, limit {given.mean_limit:g}")
    if mean > given.mean_limit or max(ratios.values()) > given.single_limit:
        sys.exit(1)


if __name__ == "__main__":
    main()
