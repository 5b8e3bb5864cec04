"""What a benchmark will cost on this machine: tasks, time, memory and disk, before it is run.

A few tasks of every planner and run are done and timed, after one of each noise that loads and
compiles; nothing is kept.
"""

import sys
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

from shiftsim.benchmarks.bench import Plan
from shiftsim.runs.prepare import RunPlan
from shiftsim.runs.rollouts.files import decode_rows, write_rollouts
from shiftsim.runs.task import Batch, TaskRunner

_SECONDS = 2.0  # spent on each planner of each run, as long as it has done a task in that time
_FEWEST, _MOST = 3, 24  # tasks that are timed
_ROW_BYTES = 400.0  # of the tables, per task


@dataclass(frozen=True, slots=True)
class Cost:
    """What one planner costs in one run."""

    run: str  # name of the run
    planner: str  # name of the planner
    tasks: int  # rollouts
    seconds_per_task: float  # of one core [s]
    hours: float  # with all workers of all shards [h]
    memory: int  # all workers of one machine at their peak [bytes], 0 where unknown
    disk: int  # [bytes]


def estimate(plan: Plan, *, shards: int = 1) -> list[Cost]:
    """The cost of every planner in every run, shared by so many machines like this one."""
    return [cost for name, run in plan.runs.items() for cost in _costs(name, run, shards)]


def total(costs: list[Cost]) -> Cost:
    """All of it: runs follow one another."""
    tasks, hours = sum(cost.tasks for cost in costs), sum(cost.hours for cost in costs)
    work = sum(cost.tasks * cost.seconds_per_task for cost in costs)
    memory, disk = max(cost.memory for cost in costs), sum(cost.disk for cost in costs)
    return Cost("all", "all", tasks, work / max(1, tasks), hours, memory, disk)


def _costs(name: str, run: RunPlan, shards: int) -> Iterator[Cost]:
    with closing(run.runner()()) as do:
        for planner in run.config.planners:
            own = [batch for batch in run.batches if batch[0].planner == planner]
            tasks = sum(map(len, own))
            each, stored = _measure(do, own)
            workers = max(1, min(run.workers * shards, len(own)))
            memory = _peak() * min(run.workers, workers)
            hours = tasks * each / workers / 3600.0
            yield Cost(name, planner, tasks, each, hours, memory, round(tasks * stored))


def _measure(do: TaskRunner, batches: list[Batch]) -> tuple[float, float]:
    """Seconds and bytes of one task: the mean of some from all over the run."""
    if not batches:
        return 0.0, 0.0
    for batch in {batch[0].noise: batch for batch in batches}.values():
        do(batch)  # loads, and compiles
    step = max(1, len(batches) // _MOST)
    spent, done = 0.0, 0
    with TemporaryDirectory() as folder:
        rollouts = []
        for number, batch in enumerate(batches[::step][:_MOST]):
            if number >= _FEWEST and spent > _SECONDS:
                break
            began = perf_counter()
            results = do(batch)
            spent += perf_counter() - began
            done += len(results)
            rollouts += [(one.task, decode_rows(one.rollout)) for one in results if one.rollout]
        write_rollouts(Path(folder), rollouts)
        stored = sum(file.stat().st_size for file in Path(folder).iterdir())
    return spent / done, _ROW_BYTES + stored / done


def _peak() -> int:
    """Most memory that this process has had [bytes], 0 where unknown."""
    if sys.platform == "win32":
        return 0
    import resource

    size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return size if sys.platform == "darwin" else size * 1024


def lines(plan: Plan, costs: list[Cost], *, shards: int) -> list[str]:
    """As a table in text."""
    workers = next(iter(plan.runs.values())).workers
    head = f"{'run':24} {'planner':20} {'tasks':>8} {'s per task':>11} {'time':>9} {'memory':>9} "
    out = [f"{plan.track.name}: {shards} x {workers} workers", f"{head}{'disk':>9}"]
    for cost in (*costs, total(costs)):
        out.append(
            f"{cost.run:24} {cost.planner:20} {cost.tasks:8d} {cost.seconds_per_task:11.4f}"
            f" {_time(cost.hours):>9} {cost.memory / 1e9:6.1f} GB {cost.disk / 1e9:6.2f} GB"
        )
    return out


def _time(hours: float) -> str:
    return f"{hours:.1f} h" if hours >= 1.0 else f"{hours * 60.0:.1f} min"


def as_json(plan: Plan, costs: list[Cost], *, shards: int) -> Mapping[str, object]:
    """As plain values."""
    rows = [asdict(cost) for cost in (*costs, total(costs))]
    workers = next(iter(plan.runs.values())).workers
    return {"track": plan.track.name, "workers": workers, "shards": shards, "costs": rows}
