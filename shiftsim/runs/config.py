"""Settings of a run: one frozen dataclass, read from TOML, checked before anything starts.

A setting is wrong at the moment it is read, not an hour later: types, ranges and names that are
known here are checked by the constructor; planners, stores and splits are checked by the runner.
The options of the command line are made from the fields, too.
"""

import os
import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from shiftsim.errors import ConfigError, one_of
from shiftsim.files import DEFAULT_STORE, make_table

Value: TypeAlias = bool | int | float | str | list[Any]

_LABELS = "give each a label: --planner LABEL=PLANNER, or shiftsim.run({label: planner})"
DRIFT = ("noise", "perception", "localization", "latency")  # settings of which a run has a product
MAX_SEED = 2**63 - 1
MAX_SEEDS = 10_000  # of one range


def parse_seeds(text: str) -> list[int]:
    """Seeds as on the command line, `0,1,2` or `0-2`; else a ConfigError."""
    seeds: list[int] = []
    try:
        for word in text.split(","):
            first, dash, last = word.partition("-")
            span = range(int(first), int(last) + 1) if dash and first else [int(word)]
            if len(span) > MAX_SEEDS:
                raise ConfigError(f"seeds {text!r} are more than {MAX_SEEDS}")
            if not span:
                what = f"seeds {text!r} begin behind their end"
                raise ConfigError(what, hint=f"--seeds {last}-{first}")
            seeds += span
    except ValueError as error:
        what = f"seeds {text!r} are not integers"
        raise ConfigError(what, hint="for example --seeds 0,1,2 or --seeds 0-2") from error
    return seeds


def parse_latency(text: str) -> list[int]:
    """Latencies as on the command line, `0,100,200` [ms]; else a ConfigError."""
    try:
        return [int(word) for word in text.split(",")]
    except ValueError as error:
        raise ConfigError(f"latency {text!r} is not in ms", hint="--latency 0,100,200") from error


def parse_workers(text: str) -> int:
    """Worker processes, from 1 on, or 0 for `auto`, by the cores; else a ConfigError."""
    if text == "auto":
        return 0
    if not text.isdecimal() or int(text) < 1:
        what = f"workers {text!r} is neither auto nor a number from 1 on"
        raise ConfigError(what, hint="--workers auto")
    return int(text)


class Option(NamedTuple):
    """A setting on the command line, and what its values may be."""

    help: str  # what the option is for
    flags: tuple[str, ...] = ()  # its names, where they are not the name of the setting
    choices: tuple[str, ...] = ()  # the values there are; empty for any
    parse: Callable[[str], Any] | None = None  # makes the value from the text of the command line


def setting(default: Any, help: str, *flags: str, **more: Any) -> Any:
    """A field of settings that is an option of the command line, too."""
    return field(default=default, metadata={"option": Option(help, flags, **more)})


@dataclass(frozen=True, slots=True)
class RunConfig:
    """Everything that one run depends on; the text of each setting is that of its option.

    `planner_args` holds arguments of the planners, by label (see `split_label`). A `limit` or
    `timeout` of 0 is none, `workers` of 0 chooses from cores and memory. Results of another
    `batch_size` may differ in the last digits.
    """

    planners: tuple[str, ...] = setting(
        (),
        "Name, ./file.py:Class, [nuplan:]package.module:Class or policy:FILE, or LABEL=… of one;"
        " repeatable.",
        "--planner",
        "-p",
    )
    noise: tuple[str, ...] = setting(
        ("none",), "none, awgn-low … ou-high, all; repeatable. [none]", "--noise", "-n"
    )
    perception: tuple[str, ...] = setting(
        ("none",), "Boxes as seen: low, mid, high, miss-…, dropout-…, range-60; repeatable. [none]"
    )
    localization: tuple[str, ...] = setting(
        ("none",), "Errors of the ego's own pose: low, mid, high; repeatable. [none]"
    )
    latency: tuple[int, ...] = setting(
        (0,), "Plans arrive late by so many ms: 0,100,300 are three. [0]", parse=parse_latency
    )
    seeds: tuple[int, ...] = setting(
        (0,),
        "Noise seeds: 0,1,2 or 0-2 are three, 3 is number 3 alone; repeatable. [0]",
        parse=parse_seeds,
    )
    store: str = setting(DEFAULT_STORE, "Name or folder. [demo]", "--store", "-s")
    split: str = setting("", "Name or file (.toml, .txt). [whole store; runs on demo: demo-mini]")
    limit: int = setting(0, "Only the first N scenarios. [0: all]")
    all_scenarios: bool = setting(False, "Also the scenarios that the filter dropped.", "--all")
    edits: str = setting("", "File (.toml) of edits; only what they make is run.")
    traffic: str = setting(
        "nonreactive",
        "nonreactive (nr), reactive (r), constant-velocity, or package.module:Model. [nonreactive]",
    )
    controller: str = setting(
        "lqr", "lqr, perfect or log-playback. [lqr]", choices=("lqr", "perfect", "log-playback")
    )
    thresholds: str = setting("nuplan", "nuplan or deepplan. [nuplan; score RUN: as before]")
    planner_args: dict[str, dict[str, Value]] = field(
        default_factory=dict,
        metadata={
            "option": Option("key=value, or LABEL.key=value; repeatable.", ("--planner-arg",))
        },
    )
    metrics: tuple[str, ...] = setting(
        (), "Own metric as package.module:function, or navsim; repeatable.", "--metric"
    )
    checkpoints: tuple[str, ...] = setting(
        (), "PATH, official or shiftsim; or LABEL=…; repeatable.", "--checkpoint"
    )
    device: str = setting("cpu", "cpu, cuda or auto. [cpu]", choices=("cpu", "cuda", "auto"))
    batch_size: int = setting(1, "Scenarios per forward pass of a network. [1]")
    isolate: bool = setting(False, "Every planner in a process of its own.")
    planner_python: str = setting("", "Interpreter for isolated planners of your own.")
    strict: bool = setting(False, "Fail where a planner falls back.")
    open_loop: bool = setting(False, "Also nuPlan's open-loop scores of every planner.")
    out: str = setting("", "Run folder. [runs/<id>]")
    workers: int = setting(0, "Worker processes. [auto]", parse=parse_workers)
    timeout: float = setting(0.0, "Seconds that one scenario may take; a hung one is killed.")
    resume: bool = setting(False, "Finish an interrupted or killed run.")
    retry_failed: bool = setting(False, "Finish a run, and do again what failed.")
    shard: str = setting("", "Only the part i/n of the tasks; see merge.")
    executor: str = setting(
        "processes", "processes or dask. [processes]", choices=("processes", "dask")
    )
    scheduler: str = setting("", "Address of the dask scheduler.")
    save_rollouts: str = setting(
        "all", "all, failed (score 0) or none. [all]", choices=("all", "failed", "none")
    )
    bundle: bool = setting(False, "Copy the scenarios used into the run folder.")
    allow_partial: bool = setting(False, "Print a labelled mean over what finished.")

    def __post_init__(self) -> None:
        labels = [split_label(planner)[0] for planner in self.planners]
        for name in ("planners", *DRIFT, "metrics", "checkpoints", "seeds"):
            values = labels if name == "planners" else getattr(self, name)
            if len(set(values)) != len(values):
                what = f"{name} {list(values)!r}: a value is listed twice"
                raise ConfigError(what, hint=_LABELS if name == "planners" else "")
        if not self.planners:
            raise ConfigError("no planner", hint="name one, for example --planner idm")
        for name in (*DRIFT, "seeds"):
            if not getattr(self, name):
                raise ConfigError(f"{name} is empty", hint=f"give at least one value for {name}")
        if any(not 0 <= seed <= MAX_SEED for seed in self.seeds):
            raise ConfigError(f"seeds {list(self.seeds)!r}: a seed is an integer from 0 on")
        if self.executor == "dask" and not self.scheduler:
            what = "executor 'dask' needs a scheduler"
            raise ConfigError(what, hint="for example --scheduler tcp://head:8786")
        if self.shard:
            parse_shard(self.shard)
        for planner in self.planner_args:
            one_of("planner in planner_args", planner, labels)

    @property
    def resumes(self) -> bool:
        """Whether what is finished is kept."""
        return self.resume or self.retry_failed

    @property
    def added_metrics(self) -> list[str]:
        """What is measured beside nuPlan's closed-loop metrics."""
        return sorted([*self.metrics, *(["open-loop"] if self.open_loop else [])])

    def to_dict(self) -> dict[str, Any]:
        """The settings as JSON or TOML values."""
        out = {item.name: getattr(self, item.name) for item in fields(self)}
        return {name: list(v) if isinstance(v, tuple) else v for name, v in out.items()}


def _check(name: str, value: Any, where: str) -> None:
    """Refuse what is not among the choices of an option, or out of its range."""
    from shiftsim.world.ranges import SETTINGS  # not needed to show the options

    option = next(item.metadata["option"] for item in fields(RunConfig) if item.name == name)
    if option.choices:
        one_of(f"{where}: {name}", value.partition(":")[0], option.choices)
    if name in SETTINGS and not SETTINGS[name].low <= value <= SETTINGS[name].high:
        raise ConfigError(f"{where}: {name} is {value!r}; it must be within {SETTINGS[name]}")


def make_config(values: Mapping[str, Any], *, where: str = "run") -> RunConfig:
    """Settings from plain values, as of a TOML file; a ConfigError where one is wrong."""
    return make_table(RunConfig, values, where, _check)


def split_label(planner: str) -> tuple[str, str]:
    """Label (without `:` and slashes) and source of `LABEL=SOURCE`, or a source, its own label."""
    label, equals, source = planner.partition("=")
    if not equals or any(c in label for c in ":/\\"):
        return planner, planner
    if not label.strip() or not label.isprintable() or not source:
        raise ConfigError(f"planner {planner!r} is not LABEL=PLANNER", hint="--planner ours=idm")
    return label, source


def named_checkpoint(config: Mapping[str, Any], planner: str) -> str:
    """The checkpoint that settings in a manifest name for a planner; empty where they do not."""
    others = {*config["planners"]} - {planner}
    given = [t for t in config.get("checkpoints", ()) if t.partition("=")[0] not in others]
    given += [config.get("planner_args", {}).get(planner, {}).get("checkpoint", "")]
    return str(given[0]).removeprefix(f"{planner}=")


def parse_argument(text: str, planners: tuple[str, ...]) -> tuple[str, str, Value]:
    """Label, name and value, of TOML or text, of `key=value`, or `label.key=value` of several."""
    planners = tuple(split_label(planner)[0] for planner in planners)
    key, equals, raw = text.partition("=")
    if not equals or not key:
        what = f"planner argument {text!r} is not key=value"
        raise ConfigError(what, hint="for example --planner-arg gap=1.0")
    named = [name for name in planners if key.startswith(f"{name}.")]
    owner, dot, _ = key.partition(".")
    if not named and len(planners) != 1:
        if dot:
            one_of(f"argument {text!r}: planner", owner, planners)
        what = f"planner argument {text!r} does not say which planner is meant"
        raise ConfigError(what, hint=f"write PLANNER.{text}; planners: {', '.join(planners)}")
    planner = max(named, key=len) if named else planners[0]
    name = key[len(planner) + 1 :] if named else key
    try:
        value = tomllib.loads(f"value = {raw}")["value"]
    except (ValueError, RecursionError):
        value = raw
    return planner, name, value


def parse_shard(text: str) -> tuple[int, int]:
    """Number and count of a shard `i/n`, i from 1 to n; else a ConfigError."""
    found = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
    if found and 1 <= int(found[1]) <= int(found[2]):
        return int(found[1]), int(found[2])
    raise ConfigError(f"shard {text!r} is not i/n with i from 1 to n", hint="for example 2/16")


def default_workers(memory_each: float = 0.5e9) -> int:
    """One worker process per core, as long as they fit into the memory [bytes]."""
    free, cores = _free_memory(), _cores()
    return max(1, min(cores, int(free // memory_each) if free else cores))


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
