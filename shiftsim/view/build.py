"""Replays of runs: which rollouts belong on one page, and a folder of pages with a list of them."""

import html
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.errors import ConfigError, DataError, ShiftsimError, beginning
from shiftsim.files import safe_join, write_text
from shiftsim.metrics import MULTIPLIERS, SHORT_NAMES
from shiftsim.report import words
from shiftsim.report.palette import planner_styles
from shiftsim.runs.results import Run
from shiftsim.runs.rollouts import Task
from shiftsim.sim.perception import drift_order
from shiftsim.view.page import MAX_ROLLOUTS, Page, framed, replay_page
from shiftsim.view.scene import ShownRollout
from shiftsim.view.thumbnails import thumbnails
from shiftsim.world.scenario import FULL_DURATION

_ENDS = [*Task._fields, "status", "error", "scenario_type"]
_NO_PAGE = {"page": None, "index": 0}
# what went wrong, in the order of metrics
_WRONG = {SHORT_NAMES[name]: reason for name, reason in words.REASONS.items()}


@dataclass(frozen=True)
class Choice:
    """Which rollouts to show."""

    planners: tuple[str, ...] = ()  # only these; empty for all
    noises: tuple[str, ...] = ()  # only these; empty for all
    seeds: tuple[int, ...] = ()  # only these; empty for all

    def __str__(self) -> str:
        parts = zip(("planner", "noise", "seed"), vars(self).values(), strict=True)
        return ", ".join(f"{n} {' or '.join(map(str, v))}" for n, v in parts if v) or "any planner"

    def __contains__(self, task: Task) -> bool:
        # a planner's name may end in the remark that tells runs apart
        name = task.planner
        return (
            (not self.planners or any(f"{name} (".startswith(f"{p} (") for p in self.planners))
            and (not self.noises or task.noise in self.noises)
            and (not self.seeds or task.seed in self.seeds or task.noise == "none")
        )


@dataclass(frozen=True, slots=True)
class _Rollout:
    """What the tables of a run say of a rollout."""

    run: Run
    key: Task  # in the run, whose planners have no remark
    end: Mapping[str, Any]  # its row of `tasks.parquet`
    score: Mapping[str, Any]  # its row of `scores.parquet`; empty where it failed
    metrics: Sequence[Mapping[str, Any]]  # its rows of `metrics.parquet`
    is_drawable: bool  # whether it is stored, and its scenario can be read


class Gallery:
    """The rollouts of one or several runs on the same store, scenario by scenario.

    All are listed, also those that failed or were not stored; a page draws up to `MAX_ROLLOUTS` of
    a scenario, the lowest scores first, and the others follow on further pages.

    Attributes:
        listed: Scenarios with rollouts of the choice: failures first, then the lowest score.
    """

    def __init__(self, runs: Sequence[Run], store: Any, choice: Choice | None = None) -> None:
        """Index runs that were made with this open store; None where nothing is drawn."""
        self.store, self.choice = store, choice or Choice()
        self.rollouts: dict[Task, _Rollout] = {}
        for run, name in zip(runs, _names(runs), strict=True):
            if store is not None and run.manifest["determining"]["store"] != store.hash:
                what = f"run {run.path.name!r} was made with another store than {str(store.path)!r}"
                raise DataError(what, hint="name the store that its manifest.json names")
            tables = (run.scores, run.metrics, run.tasks.select(_ENDS))
            scores, metrics, ends = map(words.rows_by_task, tables)
            for key, place in run.rollout_places.items():
                planner = f"{key.planner} ({name})" if name else key.planner
                (end,), (score,) = ends[key], scores.get(key, [{}])
                is_drawable = store is not None and place is not None
                one = _Rollout(run, key, end, score, metrics.get(key, []), is_drawable)
                self.rollouts[key._replace(planner=planner)] = one
        # by scenario, all and those of the choice: failures first, then the lowest score
        self._all: dict[str, list[Task]] = {}
        self._chosen: dict[str, list[Task]] = {}
        for task in sorted(self.rollouts, key=self._place):
            self._all.setdefault(task.token, []).append(task)
            if task in self.choice:
                self._chosen.setdefault(task.token, []).append(task)
        self.listed = list(self._chosen)

    def _place(self, task: Task) -> tuple[float, str, Task]:
        cls = self.rollouts[task].score.get("cls", -1.0)
        return 2.0 if cls is None else cls, task.token, task  # undefined ones last

    @property
    def tokens(self) -> list[str]:
        """Those of `listed` with rollouts to draw."""
        return [token for token in self.listed if self.parts(token)]

    def __len__(self) -> int:
        """All rollouts, whatever the choice."""
        return len(self.rollouts)

    def parts(self, token: str) -> list[list[Task]]:
        """The rollouts that can be drawn, page by page, the lowest scores on the first."""
        drawn = [task for task in self._chosen.get(token, []) if self.rollouts[task].is_drawable]
        starts = range(0, len(drawn), MAX_ROLLOUTS)
        return [sorted(drawn[start : start + MAX_ROLLOUTS]) for start in starts]

    def shown_words(self, token: str, part: int = 0) -> str:
        """What a page draws of how much, such as "6 of 16 rollouts shown"; empty for all."""
        found = [self.rollouts[task] for task in self._chosen[token]]
        failed = sum(not one.score for one in found)
        lone = sum(not one.is_drawable for one in found)
        here, total = len(self.parts(token)[part]), len(found)
        more = [f"{failed} failed"] if failed else []
        more += [f"{lone - failed} not stored"] if lone > failed else []
        more += [f"only {self.choice}"] if any(vars(self.choice).values()) else []
        shown = ", ".join([f"{here} of {total} rollouts shown", *more])
        return shown if here < total or more else ""

    def find(self, text: str) -> str:
        """A scenario by its token or an unambiguous beginning of it, or a ConfigError."""
        return beginning("what is stored", "scenario", text, self._all)

    def tasks(self, token: str, part: int = 0) -> list[Task]:
        """The rollouts that a page of a scenario shows, the first or another; or a ConfigError."""
        found = self.parts(token)
        if not found:
            tasks = self._all.get(token, [])
            there = _offered(task for task in tasks if self.rollouts[task].is_drawable)
            what = f"scenario {token!r} has no stored rollout with {self.choice}"
            raise ConfigError(what, hint=there or "--save-rollouts all keeps them")
        return found[part]

    def shown(
        self, token: str, scenario: Any, part: int = 0, *, fork: bool = False
    ) -> list[ShownRollout]:
        """The rollouts of a page with what is known of them, with `fork` also their forks."""
        out = []
        for task in self.tasks(token, part):
            one = self.rollouts[task]
            log = one.run.rollout(one.key, scenario)
            cls = one.score.get("cls")
            item = ShownRollout(task.planner, task.noise, task.seed, log, cls, one.metrics)
            if fork:
                from shiftsim.view.fork import find_fork  # it drives, which other pages need not

                item = replace(item, fork=find_fork(scenario, item, one.run.manifest))
            out.append(item)
        return out

    def settings_words(self, token: str, part: int = 0) -> str:
        """How the rollouts of a page were driven and scored."""
        settings = []
        for run in (self.rollouts[task].run for task in self.tasks(token, part)):
            made, rules = run.manifest, run.manifest["determining"]
            words = [f"{name} {rules[name]}" for name in ("traffic", "controller")]
            words += [f"thresholds {rules['thresholds']['name']}"]
            words += [f"shiftsim {made['versions']['shiftsim']}"]
            settings.append(" · ".join([*run.remarks, *words]))  # a narrow page shows the first
        return "; ".join(dict.fromkeys(settings))

    def pages(
        self, token: str, *, back: str = "", fork: bool = False, alone: bool = False
    ) -> dict[str, Page]:
        """The replays of one scenario as HTML by file name; `alone` has no links to others."""
        self.tasks(token)
        scenario, links, first = self.store.read(token), [], 1
        for part, tasks in enumerate(self.parts(token)):
            links.append((f"{first}–{first + len(tasks) - 1}", page_name(token, part)))
            first += len(tasks)
        shown = [self.shown(token, scenario, part, fork=fork) for part in range(len(links))]
        seeds, out = list(chain(*shown)), {}
        for part, (_, name) in enumerate(links[:1] if alone else links):
            linked = {"parts": links if len(links) > 1 else [], "part": part}
            more = ({} if alone else linked) | {
                "shown": self.shown_words(token, part),
                "settings": self.settings_words(token, part),
            }
            out[name] = replay_page(scenario, shown[part], seeds=seeds, back=back, more=more)
        return out

    def page(self, token: str) -> Page:
        """The first replay of one scenario as HTML, alone."""
        return next(iter(self.pages(token, alone=True).values()))

    def rows(self, token: str, *, with_pages: bool = True) -> list[dict[str, Any]]:
        """Rows of the scenario list: labels, scores and violated metrics of every rollout."""
        parts = self.parts(token) if with_pages else []
        where = {
            task: {"page": f"replay/{page_name(token, part)}", "index": index}
            for part, tasks in enumerate(parts)
            for index, task in enumerate(tasks)
        }
        drawn = self._thumbnails(token, where) if where else {}
        about, tasks = self._about(token), self._chosen[token]
        return [about | self._row(t) | where.get(t, _NO_PAGE) | drawn.get(t, {}) for t in tasks]

    def _thumbnails(self, token: str, tasks: Iterable[Task]) -> dict[Task, dict[str, Any]]:
        """What the list draws of stored rollouts, which mark the worst violation."""
        driven = {}
        for task in tasks:
            one = self.rollouts[task]
            rows = one.run.rollout_rows(one.key)
            worst = words.worst_moment(words.violations(one.metrics))
            path = np.stack([rows[name].to_numpy() for name in ("x_m", "y_m")], axis=1)
            seconds = 1e-6 * (rows["time_us"].to_numpy() - rows["time_us"][0].as_py())
            at = None if worst is None else worst.time
            driven[task] = (path, None if at is None else int(np.argmin(np.abs(seconds - at))))
        return thumbnails(self.store.read(token), driven)

    def _about(self, token: str) -> dict[str, str]:
        """Type and city of a scenario; of one that never finished as its store has them."""
        found = [self.rollouts[task] for task in self._all[token]]
        kind = next(filter(None, (one.end["scenario_type"] for one in found)), "")
        city = next(filter(None, (one.score.get("city") for one in found)), "")
        if not (kind and city) and self.store is not None:
            with suppress(ShiftsimError, OSError):  # why it failed may be that it cannot be read
                scenario = self.store.read(token)
                kind, city = kind or scenario.scenario_type, city or scenario.city
        return {"type": kind, "city": city}

    def _row(self, task: Task) -> dict[str, Any]:
        one = self.rollouts[task]
        found = words.violations(one.metrics)
        worst, cause = words.worst_moment(found), words.worst_violation(found)
        status, error, kind = (one.end[name] for name in ("status", "error", "scenario_type"))
        row = {
            **task._asdict(),
            "log": one.score.get("log_name") or "",
            "cls": one.score.get("cls"),
            "failed": "" if status == "ok" else f"{status}: {error}" if error else status,
            "cause": cause.reason if cause else "",
            "severity": words.severity(cause) if cause else (),
            "violated": {one.short: one.time for one in found},
            "at": worst and worst.time,
        }
        window = one.score.get("duration_class") or FULL_DURATION
        return row | ({"type": kind} if kind else {}) | {"window": window}


def page_name(token: str, part: int = 0) -> str:
    """File name of a scenario's page, further ones with a number: letters, digits, others coded."""
    safe = re.sub(r"[^A-Za-z0-9_-]", lambda found: f"~{ord(found[0]):x}", token)
    return f"{safe}.{part + 1}.html" if part else f"{safe}.html"


def list_page(
    title: str, rows: Sequence[Mapping[str, Any]], *, above: str = "", shown: str = ""
) -> Page:
    """The page that lists rows of `Gallery.rows`, the worst first; `above` is HTML before them."""
    scenes = {one: n for n, one in enumerate(dict.fromkeys(row.get("scene") for row in rows))}
    looks = {
        "multipliers": [SHORT_NAMES[name] for name in MULTIPLIERS],
        "noises": drift_order(row["noise"] for row in rows),
        "styles": planner_styles(row["planner"] for row in rows),
        "scenes": list(scenes),
    }
    numbered = [{**row, "scene": scenes[row.get("scene")]} for row in rows]
    data = {"rows": numbered, "metrics": _WRONG, "looks": looks}
    images, shown = "'self' data:", html.escape(shown)
    return framed("list", title=title, images=images, data=data, above=above, shown=shown)


def write_site(
    folder: Path,
    galleries: Sequence[Gallery],
    *,
    title: str,
    limit: int = 0,
    above: str = "",
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Write the list, and pages of at most `limit` scenarios (0 for all); returns of how many."""
    pages = safe_join(folder, "replay")
    pages.mkdir(parents=True, exist_ok=True)
    drawable = [(gallery, token) for gallery in galleries for token in gallery.tokens]
    found = drawable[:limit] if limit else drawable
    for done, (gallery, token) in enumerate(found):
        for name, one in gallery.pages(token, back="../index.html").items():
            one.save(pages / name)
        on_progress(done + 1, len(found))
    drawn = set(found)
    rows = [
        row
        for gallery in galleries
        for token in gallery.listed
        for row in gallery.rows(token, with_pages=(gallery, token) in drawn)
    ]
    shown = _left_out(galleries, len(found), len(drawable), rows)
    write_text(folder / "index.html", list_page(title, rows, above=above, shown=shown))
    return len(found)


def _left_out(
    galleries: Sequence[Gallery], drawn: int, drawable: int, rows: Sequence[Mapping[str, Any]]
) -> str:
    """What a list and its replays leave out, in words; empty where that is nothing."""
    parts, total = [], sum(map(len, galleries))
    if len(rows) < total:
        only = dict.fromkeys(str(gallery.choice) for gallery in galleries)
        parts.append(f"{len(rows)} of {total} rollouts listed: only {', '.join(only)}")
    failed = sum(bool(row["failed"]) for row in rows)
    lone = sum(not row["failed"] for row in rows if row["page"] is None)
    parts += [f"{failed} of {len(rows)} rollouts failed"] if failed else []
    if drawn < drawable:
        parts.append(f"replays of {drawn} of {drawable} scenarios, the others with --limit 0")
    elif lone:
        parts.append(f"{lone} rollouts have no replay: --save-rollouts all keeps them")
    return "; ".join(parts)


def galleries(runs: Sequence[Run], stores: Sequence[Any], choice: Choice) -> list[Gallery]:
    """One gallery per store; `stores` are the open ones of runs, None where nothing is drawn."""
    opened: dict[str, Any] = {}
    members: dict[str, list[Run]] = {}
    for run, store in zip(runs, stores, strict=True):
        made_with = run.manifest["determining"]["store"]
        opened[made_with] = opened.get(made_with) or store
        members.setdefault(made_with, []).append(run)
    found = [Gallery(same, opened[made_with], choice) for made_with, same in members.items()]
    tasks = [task for gallery in found for task in gallery.rollouts]
    for name, values in vars(choice).items():
        for only in (Choice(**{name: (value,)}) for value in values):
            if not any(task in only for task in tasks):
                raise ConfigError(f"no rollout has {only}", hint=_offered(tasks))
    return found


def _offered(tasks: Iterable[Task]) -> str:
    """Planners, noise and seeds of tasks, as a hint."""
    names = zip(("planners", "noise", "seeds"), zip(*sorted(tasks), strict=True), strict=False)
    return "; ".join(f"{n}: {', '.join(map(str, dict.fromkeys(v)))}" for n, v in names)


def _names(runs: Sequence[Run]) -> list[str]:
    """What tells rollouts of runs apart beside planners: nothing, traffic, or the run's name."""
    planners = [name for run in runs for name in run.manifest["config"]["planners"]]
    traffic = [str(run.manifest["determining"]["traffic"]) for run in runs]
    if len(set(traffic)) == 1 and len({*planners}) == len(planners):
        return [""] * len(runs)
    return traffic if len(set(traffic)) == len(runs) else [run.path.name for run in runs]
