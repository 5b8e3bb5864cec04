"""A run that is watched: a page on the loopback interface that shows how far it is.

What the main process hears from its workers is summed up here in a few numbers, result by result;
a thread answers the page, which asks twice a second. Nothing is read from disk until a replay is
opened, and nothing is added to what the workers do.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from operator import itemgetter
from threading import Event, Lock, Thread
from time import monotonic
from typing import Any

import numpy as np

from shiftsim.report.palette import planner_styles
from shiftsim.report.statistics import bootstrap_interval, cluster_codes
from shiftsim.report.words import violations
from shiftsim.runs.execute import Progress
from shiftsim.runs.rollouts.files import complete_rollout, decode_rows
from shiftsim.runs.tables import OK, TaskResult
from shiftsim.sim.perception import drift_order
from shiftsim.view.page import framed, replay_page
from shiftsim.view.scene import ShownRollout
from shiftsim.view.serving import LocalServer
from shiftsim.world.scenario import Scenario

_WORST, _FAILURES = 20, 50  # that the page lists
_DRAWS = 1_000  # of an interval, which is drawn anew as results come; a report makes more
_PATIENCE = 2.0  # s that the end of a run waits for the page to see it


class LiveRun:
    """What is known of a run under way.

    Attributes:
        title: Folder of the run.
    """

    def __init__(
        self, title: str, total: int, planners: Sequence[str], read: Callable[[str], Scenario]
    ) -> None:
        """A run of so many tasks that has just begun; `read` gives a scenario by its token."""
        self.title, self._read = title, read
        self._styles = planner_styles(planners)
        self._lock = Lock()
        self._began, self._ended = monotonic(), 0.0
        self._state = "running"
        self._progress = Progress(0, total, 0)
        self._number = 0  # of results so far
        self._first: int | None = None  # tasks that were done before
        # recordings and their scores by planner, noise and traffic
        self._scores: dict[tuple[str, str, str], list[tuple[str, float]]] = {}
        self._summaries: dict[tuple[str, str, str], dict[str, Any]] = {}
        # the lowest scores by scenario: the score, the number of the result, the result
        self._worst: dict[str, tuple[float, int, TaskResult]] = {}
        self._failures: list[TaskResult] = []
        self._num_failures: Counter[tuple[str, str]] = Counter()  # by planner and noise

    def add(self, progress: Progress) -> None:
        """Take in what has ended since the last call."""
        with self._lock:
            for result in progress.news:
                self._add(result)
            if self._first is None:
                self._first = progress.done - self._number
            self._progress = progress

    def _add(self, result: TaskResult) -> None:
        self._number += 1
        planner, noise, _, token = result.task
        if result.status != OK:
            self._num_failures[planner, noise] += 1
            if len(self._failures) < _FAILURES:
                self._failures.append(result)
            return
        score = float(result.scores["cls"])
        group = (planner, noise, result.scores["traffic"])
        self._scores.setdefault(group, []).append((result.scores["log_name"], score))
        self._summaries.pop(group, None)  # made anew when somebody looks
        if score < (self._worst[token][0] if token in self._worst else 1.0):
            self._worst[token] = (score, self._number, result)
            if len(self._worst) > _WORST:
                del self._worst[max(self._worst, key=lambda token: self._worst[token][:2])]

    def end(self, state: str) -> None:
        """Say how the run ended: `finished`, `interrupted` or `stopped`."""
        with self._lock:
            self._state, self._ended = state, monotonic()

    def values(self) -> dict[str, Any]:
        """Everything that the page shows, as JSON values."""
        with self._lock:
            progress, done = self._progress, self._progress.done - (self._first or 0)
            elapsed = (self._ended or monotonic()) - self._began
            left = elapsed / done * (progress.total - progress.done) if done > 0 else None
            for group in self._scores.keys() - self._summaries.keys():
                self._summaries[group] = _statistics(self._scores[group])
            noises = drift_order(noise for _, noise, _ in self._scores)
            ranks = {name: rank for rank, name in enumerate((*self._styles, *noises))}
            groups = sorted(self._scores, key=lambda one: (ranks[one[0]], ranks[one[1]], one[2]))
            return {
                "title": self.title,
                "state": self._state,
                "done": progress.done,
                "total": progress.total,
                "elapsed": elapsed,
                "left": left,
                "groups": [
                    {
                        **dict(zip(("planner", "noise", "traffic"), group, strict=True)),
                        **self._summaries[group],
                        "failed": self._num_failures[group[:2]],
                    }
                    for group in groups
                ],
                "styles": self._styles,
                "worst": [
                    _describe(result) | {"replay": number if result.rollout else None}
                    for _, number, result in sorted(self._worst.values(), key=lambda one: one[:2])
                ],
                "failures": [
                    {**r.task._asdict(), "status": r.status, "error": r.error, "hint": r.hint}
                    for r in self._failures
                ],
                "num_failures": self._num_failures.total(),
            }

    def replay(self, number: int | str) -> str | None:
        """The replay of one of the worst rollouts; None where it is none of them any more."""
        with self._lock:
            worst = self._worst.values()
            found = (r for _, n, r in worst if str(n) == str(number) and r.rollout)
            result = next(found, None)
        if result is None:
            return None
        scenario = self._read(result.task.token)
        log = complete_rollout(decode_rows(result.rollout), scenario, result.task)
        key = result.task[:3]  # without its scenario
        shown = ShownRollout(*key, log, result.scores["cls"], result.metrics)
        return replay_page(scenario, [shown])


def _statistics(scores: Sequence[tuple[str, float]]) -> dict[str, Any]:
    """Mean and bootstrap interval x 100 of recordings and their scores, as a report has them."""
    recordings, found = zip(*sorted(scores, key=itemgetter(0)), strict=True)
    values = 100.0 * np.array(found)
    interval = bootstrap_interval(values, cluster_codes(recordings), draws=_DRAWS)
    ends = [] if interval is None else [interval.low, interval.high]
    return {"done": len(values), "mean": float(values.mean()), "interval": ends}


def _describe(result: TaskResult) -> dict[str, Any]:
    """A finished rollout as JSON values, with the violations of multipliers, else all."""
    found = violations(result.metrics)
    costly = [one for one in found if one.is_multiplier] or found
    return {
        **result.task._asdict(),
        "score": 100.0 * float(result.scores["cls"]),
        "why": ", ".join(map(str, costly)),
        "at": costly[0].time if costly else None,
    }


class LiveServer(LocalServer):
    """Shows a run while it lasts: `with LiveServer(run) as live: execute(…, on_progress=run.add)`.

    Attributes:
        run: What is shown.
    """

    def __init__(self, run: LiveRun) -> None:
        """Bind to a free port of the loopback interface."""
        self.run = run
        self.last_request = 0.0  # when the page asked last
        self.end_was_shown = Event()  # that the run has ended
        page = framed("live", title=f"{run.title} · live")
        routes = {
            "GET /": lambda values: page,
            "GET /replay": lambda values: run.replay(values.get("id", "")),
            "GET /api/state": lambda values: self._state(),
        }
        super().__init__(routes)

    def _state(self) -> dict[str, Any]:
        values, self.last_request = self.run.values(), monotonic()
        if values["state"] != "running":
            self.end_was_shown.set()
        return values

    def __enter__(self) -> "LiveServer":
        """Begin to answer."""
        Thread(target=self.serve_forever, args=(0.1,), daemon=True).start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        """Let an open page see the end, and stop answering; the page keeps what it shows."""
        interrupted = kind is not None and issubclass(kind, KeyboardInterrupt)
        self.run.end("interrupted" if interrupted else "stopped" if kind else "finished")
        if monotonic() - self.last_request < _PATIENCE:
            self.end_was_shown.wait(_PATIENCE)
        if self.turn.acquire(timeout=_PATIENCE):  # the answer that shows the end is sent
            self.turn.release()
        self.shutdown()
        self.server_close()
