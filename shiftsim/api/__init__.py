"""What `import shiftsim` offers that joins layers which may not import one another.

The other public names are where they are defined; `shiftsim/__init__.py` lists all of them.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import shiftsim.api.notebook  # pictures, and answers to other names
import shiftsim.edits  # noqa: F401  # attaches Scenario.edited
from shiftsim.api.stores import demo_store as demo_store
from shiftsim.data import open_store as open_store
from shiftsim.errors import ConfigError, listed, one_of
from shiftsim.files import DEFAULT_STORE, store_path
from shiftsim.planners import registry
from shiftsim.report.tables import FORMATS
from shiftsim.runs import results
from shiftsim.sim import loop
from shiftsim.sim.log import SimulationLog
from shiftsim.sim.noise import NOISE_NAMES, NoiseModel, parse_noise
from shiftsim.sim.planner import Planner
from shiftsim.world.scenario import Scenario, require_scenario

# settings of the demo's run
DEMO = {"planners": ("log-future", "idm", "constant-velocity"), "noise": ("none", "ou-high")}


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

    def table(
        self,
        name: str = "scores",
        format: str = "text",
        *,
        by: str | None = None,
        allow_partial: bool = False,
    ) -> Any:
        """A table of `shiftsim report --list`, `by` `scenario_type`, `city` or `seed` if asked.

        Formats are `text`, `md`, `latex`, `csv`, `html`, and `pandas` for a DataFrame;
        `allow_partial` shows means over what finished, labelled so.

        Raises:
            ConfigError: There is no such table or format, or the run holds nothing of it.
            MissingExtraError: pandas is asked for and missing.
        """
        from shiftsim.report.build import Options, in_format

        options = Options((name,), by)
        tables = self._opened().tables(options, allow_partial=allow_partial)
        if not tables:
            raise ConfigError(f"run {str(self.path)!r} holds nothing of the table {name!r}")
        found = in_format(tables, format)
        return Explanation(found) if isinstance(found, str) else found

    def compare(self, *others: results.Run) -> Any:
        """Every pair of planners of this and other runs on the same scenarios, with intervals.

        Raises:
            ConfigError: No two planners drove the same scenarios in the same traffic and noise.
        """
        from shiftsim.report.build import Comparison, Options

        options = Options(("planner-comparison", "planner-comparison-noise"))
        if tables := self._opened(*others).tables(options):
            return Comparison(tables)
        names = ", ".join(run.path.name for run in (self, *others))
        raise ConfigError(
            f"nothing to compare in {names}",
            hint="needs two planners that finished the same scenarios, traffic, noise and seeds",
        )

    def report(
        self,
        folder: str | Path,
        *others: results.Run,
        formats: Sequence[str] = FORMATS,
        tables: Sequence[str] = (),
        by: str | None = None,
        **settings: Any,
    ) -> list[Path]:
        """Write tables (all of them by default) and pictures of runs to a folder; the files.

        There is a file per format. `pictures=False` leaves pictures out, `pages=True` writes HTML
        pages with a replay of every scenario, `allow_partial=True` labels means over what finished.

        Raises:
            ConfigError: There is no such table or format.
            MissingExtraError: matplotlib is missing.
        """
        from shiftsim.report.build import TABLES, Options

        for name in formats:
            one_of("format", name, FORMATS)
        options = Options(tuple(tables or TABLES), by)
        return list(self._opened(*others).report(Path(folder), options, formats, **settings))

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

    def plot(
        self, token: str, *, at: float | Sequence[float] = 0.0, grid: bool = False, **chosen: Any
    ) -> Any:
        """The driven paths of one scenario `at` seconds from the start, as a matplotlib figure.

        Several times, or `grid`, give a row per rollout and a column per time. `planner`, `noise`
        and `seed`, a value or a list of them each, choose rollouts.

        Raises:
            ConfigError: There is no stored rollout of it, or no such time.
            DataError: The store of the run is not there.
            MissingExtraError: matplotlib is missing.
        """
        from shiftsim.view import still

        gallery = self._gallery(**chosen)
        found = gallery.find(token)
        scenario = gallery.store.read(found)
        shown, note = gallery.shown(found, scenario), gallery.shown_words(found)
        times = [at] if isinstance(at, (int, float)) else list(at)
        if grid or len(times) > 1:
            return still.grid(scenario, shown, at=times, note=note)
        return still.still(scenario, shown, at=times[0], note=note)

    def plot_open_against_closed(self, *others: results.Run) -> Any:
        """Open-loop scores and errors against closed-loop scores, as a matplotlib figure.

        Raises:
            ConfigError: The runs were not made with `open_loop=True`.
            MissingExtraError: matplotlib is missing.
        """
        from shiftsim.report.figures import open_against_closed

        return open_against_closed(self._opened(*others).groups(allow_partial=True)).drawn

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

    def rollout(self, task: Any, scenario: Scenario | None = None, **choice: Any) -> SimulationLog:
        """One stored rollout.

        Args:
            task: Its task, or the token of its scenario.
            scenario: That of the store the run was made with; read from there by default.
            choice: `planner`, `noise` and `seed`, where the scenario was driven more than once.

        Raises:
            ConfigError: There is no such task, or there are several.
            DataError: It was not stored, cannot be read, or the scenario is another one.
        """
        from shiftsim.report.explain import select_tasks
        from shiftsim.report.words import task_of, task_words
        from shiftsim.runs.scenarios import open_run_store

        if isinstance(task, str):
            rows = select_tasks(
                self, task, **{"planner": None, "noise": None, "seed": None} | choice
            )
            if len(rows) > 1:
                there = listed([task_words(row) for row in rows])
                raise ConfigError(f"{task!r} was driven {len(rows)} times", f"there are {there}")
            task = task_of(rows[0])
        driven = open_run_store(self).read(task.token) if scenario is None else scenario
        return super().rollout(task, driven)

    def _gallery(self, *, planner: Any = (), noise: Any = (), seed: Any = ()) -> Any:
        from shiftsim.runs.scenarios import open_run_store
        from shiftsim.view.build import Choice, Gallery

        given = (planner, noise, seed)
        choice = Choice(*((one,) if isinstance(one, (str, int)) else tuple(one) for one in given))
        return Gallery([self], open_run_store(self), choice)

    def _opened(self, *others: results.Run) -> Any:
        from shiftsim.benchmarks.bench import OpenedRuns

        return OpenedRuns([self, *others], [], [])

    def __repr__(self) -> str:
        counts = self.manifest["counts"]
        return f"<Run {self.path}: {counts['ok']} of {counts['expected']} tasks finished>"

    def _repr_html_(self) -> str:
        return str(self.table(format="html", allow_partial=True))


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
        planner: A name, `package.module:Class`, a class or an instance; a list of those, or a
            dict by what tables call them. Classes and instances of the main script run in this
            process.
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
        planners = {"slow": shiftsim.load_planner("idm", headway=3.0), "idm": "idm"}
        run = shiftsim.run(planners, noise="ou-high", split="demo-mini", limit=2)
        ```
    """
    from shiftsim.runs.config import make_config
    from shiftsim.runs.execute import execute
    from shiftsim.runs.prepare import prepare

    several = planner if isinstance(planner, (list, tuple)) else [planner]
    named = planner if isinstance(planner, Mapping) else {}
    planners = list(named.values()) or list(several)
    labels = list(named) or [registry.planner_name(source) for source in planners]
    if wrong := [label for label in named if "=" in label]:
        raise ConfigError(f"label {wrong[0]!r} of a planner holds '='", hint="choose another one")
    noises = [noise] if isinstance(noise, (str, NoiseModel)) else list(noise)
    models = [m if isinstance(m, NoiseModel) else parse_noise(m) for m in noises if m != "all"]
    if any(isinstance(m, str) and m == "all" for m in noises):
        models += [parse_noise(name) for name in NOISE_NAMES]
    values = {
        "planners": labels,
        "noise": [model.name for model in models],
        "seeds": [seeds] if isinstance(seeds, int) else list(seeds),
        **settings,
    }
    plan = prepare(make_config(values), planners=planners, noises=models)
    finished = execute(plan, **{"on_progress": on_progress} if on_progress else {})
    return Run(finished.path, finished.manifest)


def demo(store: str | Path = DEFAULT_STORE, **settings: Any) -> Run:
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
    planner: Any = (),
    *,
    out: str | Path = "",
    val14: str = "",
    on_progress: Any = None,
    **settings: Any,
) -> list[Run]:
    """Run a benchmark track with all its traffic modes, noises and seeds, as `shiftsim bench` does.

    Args:
        track: `semantic-shift`, `state-drift` or `edits`.
        planner: A name or `package.module:Class`, or a list of those; those of the track if empty.
        out: Folder; that of an earlier call goes on.
        val14: Store, or STORE:SPLIT, with Val14.
        on_progress: Called with a `Progress` after every task.
        settings: Other settings of a run; what narrows the track makes the result partial.

    Raises:
        ShiftsimError: A setting is wrong, or something it names is missing.
    """
    from shiftsim.benchmarks import load_track
    from shiftsim.benchmarks.bench import plan_bench, run_bench

    if planner:
        settings["planners"] = [planner] if isinstance(planner, str) else list(planner)
    plan = plan_bench(load_track(track), settings, reference=val14, out=str(out))
    done = run_bench(plan, **{"on_progress": on_progress} if on_progress else {})
    return [Run(finished.path, finished.manifest) for finished in done]


def merge(runs: Iterable[Any], *, out: str | None = None, allow_partial: bool = False) -> Run:
    """Join the shards of one run, as runs or folders: the same bytes as without shards.

    Raises:
        ConfigError: Something is no shard, of another run, given twice or missing.
    """
    from shiftsim.runs.derive import merge_runs

    shards = [each if isinstance(each, results.Run) else open_run(each) for each in runs]
    merged = merge_runs(shards, out=out, allow_partial=allow_partial)
    return Run(merged.path, merged.manifest)


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


def __getattr__(name: str) -> Any:
    from shiftsim import deprecated_name

    return deprecated_name(__name__, name)
