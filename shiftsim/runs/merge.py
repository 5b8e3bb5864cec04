"""Join the shards of a run, as if it had been made in one."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from shiftsim.errors import ConfigError
from shiftsim.runs.config import parse_shard
from shiftsim.runs.folder import RunWriter
from shiftsim.runs.manifest import now
from shiftsim.runs.results import MISSING, Run, stored_results
from shiftsim.runs.resume import check_target, difference
from shiftsim.runs.rollouts import Task


def merge_runs(runs: Sequence[Run], *, out: str | None = None, allow_partial: bool = False) -> Run:
    """Write the run folder that the shards `1/n` to `n/n` are parts of.

    Args:
        runs: The shards.
        out: The new folder; by default the name of the shards without their number.
        allow_partial: Accept that shards are missing; their tasks then are `missing`.

    Returns:
        The run; its scores and metrics are the same bytes as without shards.

    Raises:
        ConfigError: Something is no shard, of another run, given twice or missing.
    """
    first = runs[0].manifest
    shards = _check_shards(runs, allow_partial=allow_partial)
    name = first["run"].removesuffix(f".{first['shard'].replace('/', '-of-')}")
    target = Path(out) if out else runs[0].path.parent / name
    check_target(target, first["determining"])
    manifest = {key: value for key, value in first.items() if key != "tokens"} | {
        "run": target.name,
        "shard": "",
        "config": first["config"] | {"shard": ""},
        "started": min(run.manifest["started"] for run in runs),
        "ended": max(run.manifest["ended"] for run in runs),
        "merged": now(),
        "merged_from": [run.path.name for run in runs],
    }
    writer = RunWriter(target, manifest)
    try:
        for run in runs:
            for result, place in stored_results(run.path):
                if result.task in writer.ended:
                    raise ConfigError(
                        f"task {tuple(result.task)!r} of {str(run.path)!r} is in another shard too",
                        hint="name every shard once",
                    )
                writer.add(result, stored=place)
        errors = _errors(runs)
        return writer.finish(
            manifest | {"state": "finished"},
            _expected(first),
            lambda task: errors.get(task, f"shard missing; there are {', '.join(shards)}"),
        )
    finally:
        writer.close()


def _check_shards(runs: Sequence[Run], *, allow_partial: bool) -> list[str]:
    first = runs[0]
    numbers: dict[int, Run] = {}
    for run in runs:
        shard = run.manifest["shard"]
        if not shard:
            raise ConfigError(
                f"{str(run.path)!r} is not a shard", hint="merge joins runs made with --shard i/n"
            )
        differing = difference(run.manifest, first.manifest["determining"], shard)
        if differing or parse_shard(shard)[1] != parse_shard(first.manifest["shard"])[1]:
            raise ConfigError(
                f"{str(run.path)!r} and {str(first.path)!r} are not of the same run: "
                f"{differing or 'their shards are ' + shard + ' and ' + first.manifest['shard']}",
                hint="name the shards of one run",
            )
        number, count = parse_shard(shard)
        if number in numbers:
            raise ConfigError(
                f"{str(run.path)!r} and {str(numbers[number].path)!r} are both shard {shard}",
                hint="name every shard once",
            )
        numbers[number] = run
    lacking = [f"{number}/{count}" for number in range(1, count + 1) if number not in numbers]
    if lacking and not allow_partial:
        raise ConfigError(
            f"shards are missing: {', '.join(lacking)}",
            hint="name all of them, or --allow-partial for a result that is labelled so",
        )
    return [run.manifest["shard"] for run in runs]


def _expected(manifest: dict[str, Any]) -> list[Task]:
    """All tasks of the whole run."""
    determining = manifest["determining"]
    return [
        Task(planner, noise, seed, token)
        for planner in determining["planners"]
        for noise, fields in determining["noise"].items()
        for seed in ([0] if fields["kind"] == "none" else determining["seeds"])
        for token in manifest["tokens"]
    ]


def _errors(runs: Sequence[Run]) -> dict[Task, str]:
    """Why tasks of the shards have no result."""
    out = {}
    for run in runs:
        columns = (run.tasks[name].to_pylist() for name in (*Task._fields, "status", "error"))
        for *key, status, error in zip(*columns, strict=True):
            if status == MISSING:
                out[Task(*key)] = error
    return out
