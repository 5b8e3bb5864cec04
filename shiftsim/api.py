"""What `import shiftsim` offers that joins layers which may not import one another.

The other public names are where they are defined; `shiftsim/__init__.py` lists all of them. What a
notebook shows of scenarios, maps and logs is registered here: these know nothing of pictures.
"""

import html
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import shiftsim.edits  # noqa: F401  # attaches Scenario.edited
from shiftsim.data import open_store as open_store
from shiftsim.errors import ConfigError
from shiftsim.files import DEFAULT_STORE
from shiftsim.planners import registry
from shiftsim.runs import results
from shiftsim.sim import loop
from shiftsim.sim.log import SimulationLog
from shiftsim.sim.noise import NOISE_NAMES, NoiseModel, parse_noise
from shiftsim.sim.planner import Planner
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario, require_scenario
from shiftsim.world.state import speeds


class Explanation(str):
    """Text; printed as it is by a notebook or a console."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


class Run(results.Run):
    """A finished run on disk, with its tables and pictures.

    Example:
        ```python
        run = shiftsim.run("constant-velocity", split="demo-mini", limit=2, out="two")
        print(run.table())
        token = run.worst(1)[0]["token"]
        print(run.explain(token))
        run.plot(token, at=5.0).savefig("scene.png")
        ```
    """

    def table(self, *, allow_partial: bool = False) -> str:
        """The score table as text."""
        from shiftsim.report.scores import score_table

        return score_table([self], allow_partial=allow_partial)

    def worst(self, count: int = 10) -> list[dict[str, Any]]:
        """The worst of each recording and cause: key, `cls`, `reason`, how many `others`."""
        from shiftsim.report.scores import worst_rollouts

        return worst_rollouts(self, count)

    def explain(
        self,
        token: str,
        *,
        planner: str | None = None,
        noise: str | None = None,
        seed: int | None = None,
    ) -> Explanation:
        """Why rollouts of one scenario have their scores, or why tasks failed, in words.

        Raises:
            ConfigError: There is no such task; the token may be an unambiguous beginning of one.
        """
        from shiftsim.report.explain import explain_lines, select_tasks

        tasks = select_tasks(self, token, planner=planner, noise=noise, seed=seed)
        return Explanation("\n\n".join("\n".join(explain_lines(task)) for task in tasks))

    def plot(self, token: str, *, at: float = 0.0) -> Any:
        """The driven paths of one scenario `at` seconds from the start, as a matplotlib figure.

        Raises:
            ConfigError: There is no stored rollout of it, or no such time.
            DataError: The store of the run is not there.
            MissingExtraError: matplotlib is missing.
        """
        from shiftsim.view.still import still

        gallery = self._gallery()
        found = gallery.find(token)
        scenario = gallery.store.read(found)
        shown, note = gallery.shown(found, scenario), gallery.shown_words(found)
        return still(scenario, shown, at=at, note=note)

    def view(self, token: str) -> Any:
        """The replay of one scenario: a `Page`, which notebooks show and `.save(path)` writes.

        Raises:
            ConfigError: There is no stored rollout of it.
            DataError: The store of the run is not there.
        """
        gallery = self._gallery()
        return gallery.page(gallery.find(token))

    def diff(self, other: results.Run, *, limit: int = 10, tolerance: float = 1e-6) -> Any:
        """Scenarios whose score differs in another run, and where the rollouts part.

        Printed in words; its fields are those of `shiftsim.runs.diff.Difference`. Rollouts part
        where a quantity differs by more than the tolerance [m, rad, m/s, …].

        Raises:
            ConfigError: The runs have no rollout in common.
        """
        from shiftsim.runs.diff import diff_runs

        return diff_runs(self, other, limit=limit, tolerance=tolerance)

    def rescore(self, thresholds: str, **settings: Any) -> "Run":
        """A new run: the stored rollouts under another threshold profile, or with more `metrics`.

        Settings are `metrics`, `store`, `out` and `workers`.

        Raises:
            DataError: Rollouts are missing, or the store is another one.
        """
        from shiftsim.runs.derive import rescore

        made = rescore(self, thresholds=thresholds, **settings)
        return Run(made.path, made.manifest)

    def bundle(self, store: str | None = None) -> "Run":
        """Copy the scenarios and maps of the run into its folder, which then needs no store.

        Raises:
            DataError: The store is not there, or is another one.
        """
        from shiftsim.runs.scenarios import bundle_run

        bundle_run(self, store)
        return self

    def _gallery(self) -> Any:
        from shiftsim.runs.scenarios import open_run_store
        from shiftsim.view.build import Gallery

        return Gallery([self], open_run_store(self))

    def __repr__(self) -> str:
        counts = self.manifest["counts"]
        return f"<Run {self.path}: {counts['ok']} of {counts['expected']} tasks finished>"

    def _repr_html_(self) -> str:
        return _preformatted(self.table(allow_partial=True))


def run(
    planner: Any,
    *,
    noise: str | NoiseModel | Sequence[str | NoiseModel] = "none",
    seeds: int | Iterable[int] = 0,
    on_progress: Any = None,
    **settings: Any,
) -> Run:
    """Simulate and score planners on scenarios, as `shiftsim run` does.

    Args:
        planner: A name, `package.module:Class`, a class or an instance, or a list of those.
            Classes and instances of the main script run in this process.
        noise: Name or model, or a list of them.
        seeds: Seeds of the noise.
        on_progress: Called with a `Progress` after every task.
        settings: The other settings of a run, as in a configuration file: `store`, `split`,
            `limit`, `traffic`, `thresholds`, `workers`, `out`, …

    Returns:
        The finished run; print `.table()`.

    Raises:
        ShiftsimError: A setting is wrong, or something it names is missing.

    Example:
        ```python
        run = shiftsim.run(["idm", "log-future"], noise="ou-high", split="demo-mini", limit=2)
        ```
    """
    from shiftsim.runs.config import make_config
    from shiftsim.runs.execute import execute
    from shiftsim.runs.prepare import prepare

    planners = list(planner) if isinstance(planner, (list, tuple)) else [planner]
    noises = [noise] if isinstance(noise, (str, NoiseModel)) else list(noise)
    models = [m if isinstance(m, NoiseModel) else parse_noise(m) for m in noises if m != "all"]
    if any(isinstance(m, str) and m == "all" for m in noises):
        models += [parse_noise(name) for name in NOISE_NAMES]
    values = {
        "planners": [registry.planner_name(source) for source in planners],
        "noise": [model.name for model in models],
        "seeds": [seeds] if isinstance(seeds, int) else list(seeds),
        **settings,
    }
    plan = prepare(make_config(values), planners=planners, noises=models)
    finished = execute(plan, **{"on_progress": on_progress} if on_progress else {})
    return Run(finished.path, finished.manifest)


def score_files(
    source: str | Path,
    *,
    store: str = DEFAULT_STORE,
    tracks: str = "",
    partial: bool = False,
    **settings: Any,
) -> Run:
    """Score what was driven elsewhere, as `shiftsim score FILE` does: tables of poses, or logs.

    Args:
        source: Parquet or CSV, a folder of those, or simulation logs of nuPlan.
        store: The store with the scenarios.
        tracks: The others: a table of boxes, or "recorded"; logs have their own.
        partial: Whether rollouts may end before their scenarios.
        settings: `point`, `traffic`, `controller`, `thresholds`, `metrics`, `out`, …

    Raises:
        DataError: Something cannot be right; the message names row and number.
    """
    from shiftsim.runs.derive import score_elsewhere
    from shiftsim.runs.rollouts.elsewhere import RECORDED, read_source
    from shiftsim.verify.simulation_log import log_source

    logs = log_source(Path(source))
    if logs and tracks:
        raise ConfigError("simulation logs say where the others were", hint="leave tracks out")
    found = logs or read_source(Path(source), tracks)
    settings |= {"recorded": tracks == RECORDED, "partial_rollouts": partial}
    made = score_elsewhere(found, store=store, **settings)
    return Run(made.path, made.manifest)


def open_run(path: str | Path) -> Run:
    """A run folder.

    Raises:
        ConfigError: There is no such folder.
        DataError: It is not a run folder, one of another format, or the run is not finished.

    Example:
        ```python
        run = shiftsim.open_run("two")
        ```
    """
    found = results.open_run(path)
    return Run(found.path, found.manifest)


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
    scenario: Scenario,
    planner: Planner | str | None,
    setting: loop.Setting = loop.DEFAULT,
    **changes: Any,
) -> SimulationLog:
    """Drive one scenario in closed loop; as `shiftsim.sim.loop.simulate`, or by a planner's name.

    Args:
        scenario: The scenario.
        planner: A planner or the name of one; None only with `log-playback`, which needs none.
        setting: How it is driven.
        changes: Fields of `Setting` that differ from it: `noise`, `seed`, `traffic`, `controller`,
            `strict`.

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


def _preformatted(text: str) -> str:
    return f"<pre>{html.escape(text)}</pre>"


def _picture_of(thing: Scenario | VectorMap) -> str:
    """A scenario or a map as a picture; as text where matplotlib is missing."""
    from shiftsim.errors import MissingExtraError
    from shiftsim.view.still import overview, svg_of

    try:
        return f"{_preformatted(repr(thing))}{svg_of(overview(thing))}"
    except MissingExtraError:
        return _preformatted(repr(thing))


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


for _kind, _shown in (
    (Scenario, _picture_of),
    (VectorMap, _picture_of),
    (SimulationLog, _table_of),
):
    setattr(_kind, "_repr_html_", _shown)  # noqa: B010


def __getattr__(name: str) -> Any:
    from shiftsim import deprecated_name

    return deprecated_name(__name__, name)
