"""A finished run, with all that can be made of it: tables, pictures, replays, other runs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from shiftsim.errors import ConfigError, listed, missing_attribute
from shiftsim.runs import results
from shiftsim.sim.log import SimulationLog
from shiftsim.world.scenario import Scenario


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
        formats: Sequence[str] = (),
        tables: Sequence[str] = (),
        by: str | None = None,
        **settings: Any,
    ) -> list[Path]:
        """Write tables and pictures of runs to a folder, all of them by default; the files.

        There is a file per format. `pictures=False` leaves pictures out, `pages=True` writes HTML
        pages with a replay of every scenario, `allow_partial=True` labels means over what finished.
        Pictures have the `width`, and are `serif` and `plain`, as those of `plot`.

        Raises:
            ConfigError: There is no such table or format.
            MissingExtraError: matplotlib is missing.
        """
        from shiftsim.report.build import TABLES, Options
        from shiftsim.report.palette import FigureFormat

        options = Options(tuple(tables or TABLES), by)
        form = {name: settings.pop(name) for name in FigureFormat._fields if name in settings}
        settings["form"] = FigureFormat.of(**form)
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
        self,
        token: str,
        *,
        at: float | Sequence[float] = 0.0,
        grid: bool = False,
        width: float | str | None = None,
        serif: bool = False,
        plain: bool = False,
        **chosen: Any,
    ) -> Any:
        """The driven paths of one scenario `at` seconds from the start, as a matplotlib figure.

        Several times, or `grid`, give a row per rollout and a column per time. `planner`, `noise`
        and `seed`, a value or a list of them each, choose rollouts. A figure is as wide as a column
        of a paper, in inches or as `3.5in` or `89mm`, may have its `serif` letters, and is `plain`
        without the title and notes that a caption says.

        Raises:
            ConfigError: There is no stored rollout of it, or no such time or width.
            DataError: The store of the run is not there.
            MissingExtraError: matplotlib is missing.
        """
        from shiftsim.report.palette import FigureFormat
        from shiftsim.view.still import picture

        gallery = self._gallery(**chosen)
        found = gallery.find(token)
        scenario = gallery.store.read(found)
        form = FigureFormat.of(width, serif=serif, plain=plain)
        shown = gallery.shown(found, scenario)
        form = form._replace(note=gallery.shown_words(found))
        times = [at] if isinstance(at, (int, float)) else list(at)
        return picture(scenario, shown, at=times, in_grid=grid, form=form)

    def plot_open_against_closed(self, *others: results.Run, **form: Any) -> Any:
        """Open-loop scores and errors against closed-loop scores, as a matplotlib figure.

        `width`, `serif` and `plain` are as those of `plot`.

        Raises:
            ConfigError: The runs were not made with `open_loop=True`.
            MissingExtraError: matplotlib is missing.
        """
        from shiftsim.report.figures import open_against_closed
        from shiftsim.report.palette import FigureFormat

        groups = self._opened(*others).groups(allow_partial=True)
        return open_against_closed(groups, form=FigureFormat.of(**form)).drawn

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

    def mine(self, kind: str = "collision", **settings: Any) -> Path:
        """Write what went wrong as edits, which begin shortly before; the file.

        Kinds are `collision`, `off-road`, `wrong-way`, `ttc` and `speeding`. Settings are `before`
        (3 s), `window` (duration), `planner`, and `out` (`mined.toml`), which `edits=` of a run and
        of a benchmark then names.

        Raises:
            ConfigError: There is nothing of that kind, or the run drove edited scenarios.
        """
        from shiftsim.runs.rollouts.mining import mine

        return mine(self, kind, **settings)

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
        from shiftsim.report.words import task_of
        from shiftsim.runs.scenarios import open_run_store

        if isinstance(task, str):
            rows = select_tasks(self, task, **choice)
            if len(rows) > 1:
                there = listed([task_of(row).words for row in rows])
                raise ConfigError(f"{task!r} was driven {len(rows)} times", f"there are {there}")
            task = task_of(rows[0])
        driven = open_run_store(self).read(task.token) if scenario is None else scenario
        return super().rollout(task, driven)

    def export_results(self, out: str | Path, **settings: Any) -> Any:
        """Write the run as nuPlan's own result folders, one per noise and seed, for nuBoard.

        Settings are `logs` and `maps`, the folders of the recordings and maps that nuBoard opens,
        `simulation_logs` (False for tables alone), `store`, `workers` and `progress`. Returned are
        the `folders`, and counts of `rollouts` and `failed` tasks.

        Raises:
            ConfigError: The folder is not empty, or two planners would have the same name.
            DataError: Rollouts are missing, or the store is another one.
        """
        from shiftsim.compat.nuplan.results import export_results

        return export_results(self, out, **settings)

    def _gallery(self, *, planner: Any = (), noise: Any = (), seed: Any = ()) -> Any:
        from shiftsim.runs.scenarios import open_run_store
        from shiftsim.view.build import Choice, galleries

        given = (planner, noise, seed)
        choice = Choice(*((one,) if isinstance(one, (str, int)) else tuple(one) for one in given))
        return galleries([self], [open_run_store(self)], choice)[0]

    def _opened(self, *others: results.Run) -> Any:
        from shiftsim.benchmarks.bench import OpenedRuns

        return OpenedRuns([self, *others], [], [])

    def __repr__(self) -> str:
        counts = self.manifest["counts"]
        return f"<Run {self.path}: {counts['ok']} of {counts['expected']} tasks finished>"

    def _repr_html_(self) -> str:
        return str(self.table(format="html", allow_partial=True))


setattr(Run, "__getattr__", missing_attribute)  # noqa: B010
