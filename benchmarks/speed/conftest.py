"""Speed figures, each in µs and as a ratio to one fixed calculation in the same session.

With `--benchmark-disable` (`make bench-smoke`) every benchmark runs once, on little: it shows that
it works, and its figures mean nothing.
"""

from collections.abc import Callable
from time import perf_counter

import numpy as np
import pytest

from shiftsim.kernels import kernel

CALIBRATION_STEPS = 10_000  # dependent multiply-adds: about 8 cycles each, whatever the machine
ROUNDS = 200


@kernel
def calibration(steps: int) -> float:
    """A chain of float operations that no compiler can shorten or vectorise."""
    value = 0.5
    for _ in range(steps):
        value = value * 0.999999 + 1e-7
    return value


def median_seconds(function: Callable[[], object], rounds: int) -> float:
    """Median time of a call [s], warm."""
    function()
    times = []
    for _ in range(rounds):
        began = perf_counter()
        function()
        times.append(perf_counter() - began)
    return float(np.median(times))


@pytest.fixture(scope="session")
def size(pytestconfig: pytest.Config) -> Callable[[int, int], int]:
    """How much of something: the first number, or the second where every benchmark runs once."""
    smoke = pytestconfig.getoption("benchmark_disable")
    return lambda usual, once=1: once if smoke else usual


@pytest.fixture(scope="session")
def calibration_seconds(size) -> float:
    """Median time of the calibration kernel [s]."""
    return median_seconds(lambda: calibration(CALIBRATION_STEPS), size(ROUNDS))


@pytest.fixture
def measure(benchmark, calibration_seconds):
    """Benchmark a call: median in µs, as a ratio to the calibration kernel, against a target [s].

    A missed target is printed, not an error: machines differ.
    """

    def run(
        function: Callable[..., object],
        *arguments: object,
        calls: int = 100,
        target: float | None = None,
    ) -> None:
        benchmark.pedantic(
            function, args=arguments, rounds=ROUNDS, iterations=calls, warmup_rounds=3
        )
        if benchmark.disabled:
            return
        median = benchmark.stats.stats.median
        ratio = median / calibration_seconds
        benchmark.extra_info["median_us"] = round(median * 1e6, 3)
        benchmark.extra_info["ratio"] = round(ratio, 4)
        name = benchmark.name.removeprefix("test_")
        print(f"\n{name}: {median * 1e6:.2f} µs, {ratio:.3f} of the calibration", end="")
        if target is not None:
            verdict = "met" if median <= target else "NOT MET"
            print(f", target {target * 1e6:g} µs {verdict}", end="")

    return run


@pytest.fixture
def note(benchmark):
    """Hand figures that were timed otherwise to `compare.py`: by name [s]."""

    def take(**seconds: float) -> None:
        benchmark.pedantic(lambda: None)
        benchmark.extra_info["seconds"] = seconds

    return take
