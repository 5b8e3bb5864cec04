"""Settings of a run: one frozen dataclass, read from TOML, checked before anything starts.

A setting is wrong at the moment it is read, not an hour later: types, ranges and names that are
known here are checked by the constructor; planners, stores and splits are checked by the runner.
"""

import json
import math
import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeAlias

from shiftsim.errors import ConfigError, one_of

Value: TypeAlias = bool | int | float | str | list[Any]

SAVE_ROLLOUTS = ("all", "failed", "none")
EXECUTORS = ("processes", "dask")
DEVICES = ("cpu", "cuda", "auto")
DEFAULT_STORE = "demo"
MAX_SEED = 2**63 - 1


@dataclass(frozen=True, slots=True)
class RunConfig:
    """Everything that one run depends on.

    Attributes:
        planners: Names, `package.module:Class`, or names with a checkpoint.
        planner_args: Arguments of the planners, by planner as named in `planners`.
        noise: Names of noise models; `all` stands for the seven of the benchmark.
        seeds: Seeds of the noise; ignored for `none`.
        traffic: Traffic mode.
        controller: How a plan moves the ego.
        thresholds: Threshold profile of the metrics.
        metrics: Own metrics as `module:attribute`, reported beside the official ones.
        store: Name or path of the scenario store.
        split: Name or file of a split; empty for all scenarios of the store.
        limit: Use only the first scenarios of the split, 0 for all.
        all_scenarios: Also use what the filter dropped, where a whole store is run.
        checkpoints: Checkpoints of learned planners, as a path or `planner=path`.
        device: Where learned planners compute: `cpu`, `cuda`, or `auto` for what there is.
        batch_size: Scenarios that advance together, for planners that can; results of another
            batch size may differ in the last digits.
        strict: Fail where a planner falls back to a makeshift instead of counting the step.
        workers: Worker processes; 0 chooses from cores and memory.
        timeout: Time that one scenario may take [s]; 0 for any.
        executor: `processes` of this machine, or `dask` for a cluster.
        scheduler: Address of the cluster's scheduler.
        shard: The part `i/n` of all tasks; empty for all.
        out: Run folder; empty for `runs/<id>`.
        resume: Go on with a run that was interrupted, instead of refusing to replace it.
        retry_failed: Go on with a run, and do again what failed.
        save_rollouts: `all`, `failed` for those with a score of 0, or `none`.
        bundle: Copy the scenarios and maps that were used into the run folder.
        allow_partial: Print a labelled mean over the survivors when tasks fail or are missing.
    """

    planners: tuple[str, ...]
    planner_args: dict[str, dict[str, Value]] = field(default_factory=dict)
    noise: tuple[str, ...] = ("none",)
    seeds: tuple[int, ...] = (0,)
    traffic: str = "nonreactive"
    controller: str = "lqr"
    thresholds: str = "nuplan"
    metrics: tuple[str, ...] = ()
    store: str = DEFAULT_STORE
    split: str = ""
    limit: int = 0
    all_scenarios: bool = False
    checkpoints: tuple[str, ...] = ()
    device: str = "cpu"
    batch_size: int = 1
    strict: bool = False
    workers: int = 0
    timeout: float = 0.0
    executor: str = "processes"
    scheduler: str = ""
    shard: str = ""
    out: str = ""
    resume: bool = False
    retry_failed: bool = False
    save_rollouts: str = "all"
    bundle: bool = False
    allow_partial: bool = False

    def __post_init__(self) -> None:
        for item in fields(self):
            _check_type(item.name, getattr(self, item.name))
        _not_empty("planners", self.planners)
        _not_empty("noise", self.noise)
        _not_empty("seeds", self.seeds)
        for name in _LISTS:
            _no_repeats(name, getattr(self, name))
        if any(not 0 <= seed <= MAX_SEED for seed in self.seeds):
            raise ConfigError(f"seeds {list(self.seeds)!r}: a seed is an integer from 0 on")
        for name in ("limit", "workers", "timeout"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ConfigError(f"{name} is {getattr(self, name)!r}; it cannot be negative")
        if self.batch_size < 1:
            raise ConfigError(f"batch_size is {self.batch_size!r}; it must be at least 1")
        one_of("save_rollouts", self.save_rollouts, SAVE_ROLLOUTS)
        one_of("executor", self.executor, EXECUTORS)
        one_of("device", self.device.partition(":")[0], DEVICES)
        if self.executor == "dask" and not self.scheduler:
            raise ConfigError(
                "executor 'dask' needs a scheduler", hint="for example --scheduler tcp://head:8786"
            )
        if self.shard:
            parse_shard(self.shard)
        for planner in self.planner_args:
            one_of("planner in planner_args", planner, self.planners)

    def to_dict(self) -> dict[str, Any]:
        """The settings as JSON or TOML values."""
        out = {item.name: getattr(self, item.name) for item in fields(self)}
        return {name: list(v) if isinstance(v, tuple) else v for name, v in out.items()}


_LISTS = {"planners": str, "noise": str, "seeds": int, "metrics": str, "checkpoints": str}
_SCALARS = {
    "limit": int,
    "workers": int,
    "batch_size": int,
    "timeout": float,
    **dict.fromkeys(
        ("allow_partial", "all_scenarios", "strict", "resume", "retry_failed", "bundle"), bool
    ),
}


def _check_type(name: str, value: object) -> None:
    """Types are checked strictly: TOML and Python callers get the same message."""
    if name in _LISTS:
        kind = _LISTS[name]
        good = isinstance(value, tuple) and all(_is_a(item, kind) for item in value)
        wanted = f"a list of {kind.__name__}"
    elif name == "planner_args":
        good = isinstance(value, dict) and all(isinstance(v, dict) for v in value.values())
        wanted = "a table of arguments per planner"
    else:
        kind = _SCALARS.get(name, str)
        good, wanted = _is_a(value, kind), kind.__name__
    if not good:
        raise ConfigError(f"{name} is {value!r}; it must be {wanted}")


def _is_a(value: object, kind: type) -> bool:
    kinds = (int, float) if kind is float else (kind,)
    return isinstance(value, kinds) and (kind is bool or not isinstance(value, bool))


def _not_empty(name: str, values: tuple[object, ...]) -> None:
    if not values:
        raise ConfigError(f"{name} is empty", hint=f"give at least one value for {name}")


def _no_repeats(name: str, values: tuple[object, ...]) -> None:
    if len(set(values)) != len(values):
        raise ConfigError(f"{name} {list(values)!r}: a value is listed twice")


def make_config(values: Mapping[str, Any], *, where: str = "run") -> RunConfig:
    """Settings from plain values, such as those of a TOML file.

    Raises:
        ConfigError: A name is unknown, or a value is wrong.
    """
    known = {item.name for item in fields(RunConfig)}
    for name in values:
        try:
            one_of("setting", name, known)
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}", hint=error.hint) from error
    if "planners" not in values:
        raise ConfigError(f"{where}: no planner", hint="name one, for example --planner idm")
    plain: dict[str, Any] = dict(values)
    for name in _LISTS:
        if isinstance(plain.get(name), list):
            plain[name] = tuple(plain[name])
    try:
        return RunConfig(**plain)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}", hint=error.hint) from error


def write_toml(config: RunConfig) -> str:
    """The settings as the text of a TOML file that `read_toml` and `make_config` take back."""
    values = config.to_dict()
    arguments = values.pop("planner_args")
    lines = [f"{name} = {_toml(value)}" for name, value in values.items()]
    for planner, table in arguments.items():
        lines += ["", f"[planner_args.{_toml(planner)}]"]
        lines += [f"{_toml(name)} = {_toml(value)}" for name, value in table.items()]
    return "\n".join(lines) + "\n"


def _toml(value: Value) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return repr(value)


def parse_argument(text: str, planners: tuple[str, ...]) -> tuple[str, str, Value]:
    """Planner, name and value of one `key=value`, or `planner.key=value` with several planners.

    The value is read as a TOML value; anything that is none is taken as a string.

    Raises:
        ConfigError: It has another form, or it does not say which planner is meant.
    """
    key, equals, raw = text.partition("=")
    if not equals or not key:
        raise ConfigError(
            f"planner argument {text!r} is not key=value", hint="for example --planner-arg gap=1.0"
        )
    named = [name for name in planners if key.startswith(f"{name}.")]
    if not named and len(planners) != 1:
        raise ConfigError(
            f"planner argument {text!r} does not say which planner is meant",
            hint=f"write PLANNER.{text}; planners: {', '.join(planners)}",
        )
    planner = max(named, key=len) if named else planners[0]
    name = key[len(planner) + 1 :] if named else key
    try:
        value = tomllib.loads(f"value = {raw}")["value"]
    except tomllib.TOMLDecodeError:
        value = raw
    return planner, name, value


def parse_shard(text: str) -> tuple[int, int]:
    """Number and count of a shard `i/n`, i from 1 to n.

    Raises:
        ConfigError: It has another form.
    """
    number, _, count = text.partition("/")
    if number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count):
        return int(number), int(count)
    raise ConfigError(f"shard {text!r} is not i/n with i from 1 to n", hint="for example 2/16")


def default_workers(memory_each: float = 0.5e9) -> int:
    """Worker processes when nothing is said: one per core, as long as they fit into the memory.

    Args:
        memory_each: Memory that each of them needs [bytes].
    """
    free = _free_memory()
    fitting = int(free // memory_each) if free else _cores()
    return max(1, min(_cores(), fitting))


def _cores() -> int:
    """Cores that this process may use, also in a container that gets only a share of them."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    quota, _, period = _first_line("/sys/fs/cgroup/cpu.max").partition(" ")
    if quota.isdecimal() and period.isdecimal():
        return max(1, min(cores or 1, int(quota) // int(period)))
    return cores or 1


def _free_memory() -> float:
    """Memory that this process could still take [bytes], 0 where unknown."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return 0.0
    free = next((float(x.split()[1]) * 1024 for x in lines if x.startswith("MemAvailable")), 0.0)
    limit = _first_line("/sys/fs/cgroup/memory.max")
    used = _first_line("/sys/fs/cgroup/memory.current")
    if limit.isdecimal() and used.isdecimal():
        free = min(free, float(limit) - float(used))
    return free


def _first_line(path: str) -> str:
    try:
        return Path(path).read_text().partition("\n")[0]
    except OSError:
        return ""
