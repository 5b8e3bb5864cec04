"""What `import shiftsim` offers that joins layers which may not import one another.

The other public names are where they are defined; `shiftsim/__init__.py` lists all of them. At the
end come what notebooks show of scenarios, maps and rollouts, which know nothing of pictures, and
what objects answer when they are asked for something by another name.
"""

import html
import logging
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import shiftsim.edits  # noqa: F401  # attaches Scenario.edited
from shiftsim.api.stores import demo_store as demo_store
from shiftsim.data import open_store as open_store
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.errors import ConfigError, MissingExtraError, missing_attribute, plural
from shiftsim.files import DEFAULT_STORE, store_path
from shiftsim.planners import registry
from shiftsim.sim import loop
from shiftsim.sim.log import DEFAULT, Setting, SimulationLog
from shiftsim.sim.noise import NoiseModel
from shiftsim.sim.perception import Localization, Perception, make_drifts
from shiftsim.sim.planner import Observation, Planner, SceneInfo
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario, require_scenario
from shiftsim.world.state import EgoState, Tracks, Trajectory, speeds

if TYPE_CHECKING:
    from shiftsim.api.finished import Run

# settings of the demo's run
DEMO = {"planners": ("log-future", "idm", "constant-velocity"), "noise": ("none", "ou-high")}


def run(
    planner: Any,
    *,
    noise: str | NoiseModel | Sequence[str | NoiseModel] = "none",
    perception: str | Perception | Sequence[str | Perception] = "none",
    localization: str | Localization | Sequence[str | Localization] = "none",
    latency: int | Sequence[int] = 0,
    seeds: int | Iterable[int] = 0,
    on_progress: Any = None,
    **settings: Any,
) -> "Run":
    """Simulate and score planners on scenarios, as `shiftsim run` does.

    Args:
        planner: A name, `package.module:Class`, a class or an instance; a list of those, or a
            dict by what tables call them. Classes and instances of the main script run in this
            process.
        noise: Name or model, or a list of them.
        perception: What planners see: name or model, or a list of them.
        localization: Where they believe to be: name or model, or a list of them.
        latency: How late plans arrive [ms], or a list; all combinations of the four are run.
        seeds: Seeds of what is random.
        on_progress: Called with a `Progress` after every task.
        settings: The other settings of a run, as in a configuration file: `store`, `split`,
            `limit`, `traffic`, `thresholds`, `workers`, `out`, …

    Returns:
        The finished run; print `.table()`. What failed is logged.

    Raises:
        ShiftsimError: A setting is wrong, or something it names is missing.

    Example:
        ```python
        planners = {"slow": shiftsim.load_planner("idm", headway=3.0), "idm": "idm"}
        run = shiftsim.run(planners, noise="ou-high", split="demo-mini", limit=2)
        ```
    """
    from shiftsim.report.scores import failures
    from shiftsim.runs.config import make_config
    from shiftsim.runs.execute import execute
    from shiftsim.runs.prepare import prepare
    from shiftsim.runs.tables import task_of

    several = planner if isinstance(planner, (list, tuple)) else [planner]
    named = planner if isinstance(planner, Mapping) else {}
    planners = list(named.values()) or list(several)
    labels = list(named) or [registry.planner_name(source) for source in planners]
    if wrong := [label for label in named if "=" in label]:
        raise ConfigError(f"label {wrong[0]!r} of a planner holds '='", hint="choose another one")
    models = make_drifts(noise, perception, localization, latency)
    values = {
        "planners": labels,
        "noise": [model.name for model in models],
        "seeds": [seeds] if isinstance(seeds, int) else list(seeds),
        **settings,
    }
    plan = prepare(make_config(values), planners=planners, noises=models)
    done = execute(plan, **{"on_progress": on_progress} if on_progress else {})
    if lost := [row for row in failures(done) if row["error"]]:
        failed = f"{len(lost)} of {plural(len(done.tasks), 'task')} failed"
        words = f"{task_of(lost[0]).words}: {lost[0]['error']}"
        logging.getLogger(__name__).warning("%s, the first: %s", failed, words)
    return _with_methods(done)


def demo(store: str | Path = DEFAULT_STORE, **settings: Any) -> "Run":
    """Generate the demo's recordings where they are not there, and run three planners on them.

    Args:
        store: Name or folder of the store.
        settings: Those of `run`.

    Example:
        ```python
        run = shiftsim.demo(limit=1, out="demo-run")
        ```
    """
    path = demo_store(store).path
    settings = {"planner": DEMO["planners"], "noise": DEMO["noise"], **settings}
    return run(store=DEFAULT_STORE if path == store_path(DEFAULT_STORE) else str(path), **settings)


def bench(
    track: str,
    planner: str | Sequence[str],
    *,
    out: str | Path = "",
    val14: str = "",
    on_progress: Any = None,
    **settings: Any,
) -> "list[Run]":
    """Run a benchmark track with all its traffic modes, noises and seeds, as `shiftsim bench` does.

    Args:
        track: `semantic-shift`, `state-drift`, `sensor-drift`, `edits` or `finding`.
        planner: A name, `package.module:Class` or `LABEL=` one of those, or a list of them.
        out: Folder; that of an earlier call goes on.
        val14: Store, or STORE:SPLIT, with Val14.
        on_progress: Called with a `Progress` after every task.
        settings: Other settings of a run; what narrows the track makes the result partial.

    Raises:
        ShiftsimError: A setting is wrong, or something it names is missing.

    Example:
        ```python
        runs = shiftsim.bench("state-drift", "idm", limit=1, noise="ou-high", seeds=0)
        ```
    """
    from shiftsim.benchmarks import load_track
    from shiftsim.benchmarks.bench import plan_bench, run_bench
    from shiftsim.runs.config import DRIFT

    settings["planners"] = planner
    for name in ("planners", *DRIFT, "seeds", "traffic"):
        if isinstance(settings.get(name), (str, int)):
            settings[name] = [settings[name]]
    plan = plan_bench(load_track(track), settings, reference=val14, out=str(out))
    done = run_bench(plan, **{"on_progress": on_progress} if on_progress else {})
    return [_with_methods(finished) for finished in done]


def merge(runs: Iterable[Any], *, out: str | None = None, allow_partial: bool = False) -> "Run":
    """Join the shards of one run, as runs or folders: the same bytes as without shards.

    Raises:
        ConfigError: Something is no shard, of another run, given twice or missing.

    Example:
        ```python
        halves = [shiftsim.run("idm", shard=f"{part}/2", limit=2) for part in (1, 2)]
        run = shiftsim.merge(halves)
        ```
    """
    from shiftsim.runs.derive import merge_runs

    shards = [each if hasattr(each, "manifest") else open_run(each) for each in runs]
    return _with_methods(merge_runs(shards, out=out, allow_partial=allow_partial))


def score_files(
    source: str | Path,
    *,
    store: str = DEFAULT_STORE,
    tracks: str = "",
    partial: bool = False,
    **settings: Any,
) -> "Run":
    """Score what was driven elsewhere, as `shiftsim score FILE` does: tables of poses, or logs.

    Args:
        source: Parquet or CSV, a folder of those, or simulation logs of nuPlan.
        store: The store with the scenarios.
        tracks: The others: a table of boxes, or "recorded"; logs have their own.
        partial: Whether rollouts may end before their scenarios.
        settings: `point`, `traffic`, `controller`, `thresholds`, `metrics`, `out`, …

    Raises:
        DataError: Something cannot be right; the message names row and number.

    Example:
        ```python
        run = shiftsim.score_files("two/rollouts", tracks="recorded")
        ```
    """
    from shiftsim.runs.derive import score_elsewhere
    from shiftsim.runs.rollouts.elsewhere import RECORDED, read_source
    from shiftsim.verify.simulation_log import log_source

    logs = log_source(Path(source))
    if logs and tracks:
        raise ConfigError("simulation logs say where the others were", hint="leave tracks out")
    found = logs or read_source(Path(source), tracks)
    settings |= {"recorded": tracks == RECORDED, "partial_rollouts": partial}
    return _with_methods(score_elsewhere(found, store=store, **settings))


def open_run(path: str | Path) -> "Run":
    """A run folder.

    Raises:
        ConfigError: There is no such folder.
        DataError: It is not a run folder, one of another format, or the run is not finished.

    Example:
        ```python
        run = shiftsim.open_run("two")
        ```
    """
    from shiftsim.runs.results import open_run

    return _with_methods(open_run(path))


def load_planner(name: str, **arguments: Any) -> Planner:
    """A new planner: a registered name, or `package.module:Class`, with constructor arguments.

    Raises:
        ConfigError: The name, the module, the class or an argument is wrong.
        CheckpointError: A learned planner has no checkpoint, or the wrong one.
        MissingExtraError: A learned planner needs PyTorch.

    Example:
        ```python
        planner = shiftsim.load_planner("idm", headway=2.0)
        ```
    """
    return registry.load_planner(name, arguments)


def simulate(
    scenario: Scenario, planner: Planner | str | None, setting: Setting = DEFAULT, **changes: Any
) -> SimulationLog:
    """Drive one scenario in closed loop; as `shiftsim.sim.loop.simulate`, or by a planner's name.

    Args:
        scenario: The scenario.
        planner: A planner or the name of one; None only with `log-playback`, which needs none.
        setting: How it is driven.
        changes: Fields of `Setting` that differ from it: `noise`, `seed`, `traffic`, `controller`,
            `strict`, `perception`, `localization`, `latency`.

    Returns:
        The rollout, K = T - 1 samples.

    Raises:
        ConfigError: A setting or the planner is unknown, or there is no scenario.
        DataError: The scenario has fewer than three iterations.
        PlannerError: The planner returned something that cannot be executed.

    Example:
        ```python
        scenario = shiftsim.open_store("demo")["01f13e"]
        log = shiftsim.simulate(scenario, "idm", noise="ou-high")
        ```
    """
    require_scenario("simulate", scenario)
    driver = load_planner(planner) if isinstance(planner, str) else planner
    return loop.simulate(scenario, driver, setting, **changes)


def _with_methods(found: Any) -> "Run":
    """A run on disk with all that can be made of it."""
    from shiftsim.api.finished import Run

    return Run(found.path, found.manifest)


def _plot(
    thing: Scenario | VectorMap,
    *,
    width: float | str | None = None,
    serif: bool = False,
    plain: bool = False,
) -> Any:
    """A matplotlib figure of a scenario at its first iteration, or of a whole map.

    It is as wide as a column of a paper, in inches or as `3.5in`, and `plain` without its title.

    Raises:
        ConfigError: The width is none.
        MissingExtraError: matplotlib is missing.
    """
    from shiftsim.report.palette import FigureFormat
    from shiftsim.view.still import map_picture, picture

    form = FigureFormat.of(width, serif=serif, plain=plain)
    return (
        picture(thing, form=form) if isinstance(thing, Scenario) else map_picture(thing, form=form)
    )


def _picture_of(thing: Scenario | VectorMap) -> str:
    """A scenario or a map as a picture; as text where matplotlib is missing."""
    from shiftsim.view.still import svg_of

    text = f"<pre>{html.escape(repr(thing))}</pre>"
    try:
        return f"{text}{svg_of(_plot(thing))}"
    except MissingExtraError:
        return text


def _table_of(log: SimulationLog) -> str:
    """What can be said of a rollout without its map."""
    driven = speeds(log.ego)
    rows = {
        "scenario": log.token,
        "samples": len(log.ego),
        "duration": f"{(log.time_us[-1] - log.time_us[0]) * 1e-6:.1f} s",
        "speed": f"{driven.mean():.1f} m/s on average, {driven.max():.1f} m/s at most",
        "tracks": log.tracks.num_tracks,
        "noise": "yes" if log.noise.any() else "none",
        "planning": f"{log.planning_seconds.mean() * 1e3:.2f} ms per step",
    }
    cells = (f"<tr><th>{name}</th><td>{html.escape(str(v))}</td></tr>" for name, v in rows.items())
    return f"<table>{''.join(cells)}</table>"


setattr(SimulationLog, "_repr_html_", _table_of)  # noqa: B010
for _kind in (Scenario, VectorMap):
    setattr(_kind, "_repr_html_", _picture_of)  # noqa: B010
    setattr(_kind, "plot", _plot)  # noqa: B010
_kinds: tuple[type, ...] = (
    *(Scenario, ScenarioStore, Observation, SceneInfo, EgoState, Tracks),
    *(SimulationLog, Trajectory, VectorMap),
)
for _answering in _kinds:
    setattr(_answering, "__getattr__", missing_attribute)  # noqa: B010


def __getattr__(name: str) -> Any:
    from shiftsim import deprecated_name

    return deprecated_name(__name__, name)
