"""The review of a store in the browser: the server, and what its page asks for.

The only file written is the review; every change is on disk before its answer.
"""

import getpass
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim._version import __version__
from shiftsim.data.store import review as reviews
from shiftsim.data.store.reading import open_store
from shiftsim.data.store.review import Review, write_reviews
from shiftsim.errors import ConfigError
from shiftsim.runs.filter import read_filter_results
from shiftsim.sim.log import as_recorded
from shiftsim.view import scene
from shiftsim.view.page import framed
from shiftsim.view.scene import Quantised, pack
from shiftsim.view.serving import LocalServer
from shiftsim.view.thumbnails import thumbnails
from shiftsim.world.scenario import Scenario

MAX_COMMENT = 4000  # characters
_CHANGED = {"decision", "comment", "route"}  # fields of a review that the page may write
_NUMBERS = ("max_outside_m", "path_m", "progress_m", "first_violation_s", "partner_token")


class ReviewService:
    """The reviews of one store, and what is needed to make them.

    Methods raise `DataError` where the store has no such scenario.
    """

    def __init__(self, store: Path, reviewer: str = "") -> None:
        """Open the store of a folder, or a DataError; an empty `reviewer` is the login name."""
        self.store = open_store(store)
        self.reviewer = reviewer
        with suppress(OSError, KeyError):  # there may be no login name
            self.reviewer = reviewer or getpass.getuser()
        filtered = read_filter_results(self.store.path, self.store.hash)
        self._filter_results = {row["token"]: row for row in (filtered.rows if filtered else ())}
        self._reviews = reviews.read_reviews(self.store.path)

    def listing(self) -> dict[str, Any]:
        """All scenarios with their filter result and review."""
        table = self.store.summary().select(["token", "type", "city"]).to_pylist()
        return {
            "store": self.store.path.name,
            "reviewer": self.reviewer,
            "scenarios": [row | self._state(row["token"]) for row in table],
        }

    def _state(self, token: str) -> dict[str, Any]:
        result = self._filter_results.get(token)
        review = self._reviews.get(token, Review(token))
        return {
            "verdict": result["verdict"] if result else "not filtered",
            "reason": result["reason"] if result else "",
            "decision": review.decision,
            "comment": review.comment,
            "route": None if review.route is None else list(review.route),
        }

    def scenario(self, token: str) -> dict[str, Any]:
        """Everything the page draws of one scenario."""
        recorded = self.store.read_recorded(token)
        replay = scene.Replay(
            recorded, [scene.ShownRollout("recorded", "none", 0, as_recorded(recorded))]
        )
        layer = recorded.map.blocks
        route = (layer.index[name] for name in recorded.route if name in layer.index)
        blocks = sorted({*scene.indices_near(layer, replay.box), *route})
        rings = [layer.rings(block) for block in blocks]
        counts = Quantised(np.array([*map(len, rings)], float), 1.0)  # of rings per block
        outlines = scene.line_fields("blocks", list(chain(*rings)), replay.origin)
        result = self._filter_results.get(token) or {}
        return {
            "meta": scene.describe_scene(replay),
            "scene": pack(scene.scene_fields(replay)),
            "rollout": pack(scene.rollout_fields(replay, 0)),
            "blocks": pack({"blocks.rings": counts, **outlines}),
            "blockIds": [layer.ids[block] for block in blocks],
            "recordedRoute": list(recorded.route),
            "numbers": {name: result[name] for name in _NUMBERS if result.get(name) is not None},
            **self._state(token),
            **self._checked_route(recorded),
        }

    def thumbnail(self, token: str) -> dict[str, Any]:
        """The small picture of one scenario."""
        recorded = self.store.read_recorded(token)
        return thumbnails(recorded, {token: (recorded.expert[:, :2], None)})[token]

    def check_route(self, token: str, route: Any) -> dict[str, Any]:
        """A route with what is wrong with it; a ConfigError if it is no list of names."""
        if not isinstance(route, list) or not all(isinstance(name, str) for name in route):
            raise ConfigError("a route is a list of roadblocks")
        return self._checked_route(self.store.read_recorded(token), route)

    def _checked_route(
        self, recorded: Scenario, given: Sequence[str] | None = None
    ) -> dict[str, Any]:
        """A route, else that of the review, else the recorded one, with what is wrong with it."""
        review = self._reviews.get(recorded.token)
        route = (review and review.route) or recorded.route if given is None else given
        # it starts in the block under the ego; in one on the route where there are several
        found = recorded.map.blocks.containing(*recorded.expert[0, :2]).tolist()
        on_route = [block for block in found if recorded.map.blocks.ids[block] in recorded.route]
        problems = reviews.route_problems(recorded.map, route, next(iter(on_route or found), None))
        return {"current": list(route), "problems": problems}

    def keep(self, token: str, values: Any) -> dict[str, Any]:
        """Put the given fields of a review on disk; returns what is kept, or a ShiftsimError."""
        recorded = self.store.read_recorded(token)
        if not isinstance(values, dict) or not set(values) <= _CHANGED:
            raise ConfigError(f"the fields of a review are {', '.join(sorted(_CHANGED))}")
        before = asdict(self._reviews.get(token, Review(token)))
        before["route"] = before["route"] and list(before["route"])
        review = reviews.parse_review({**before, **values}, "the review")
        if len(review.comment) > MAX_COMMENT:
            raise ConfigError(f"a comment has up to {MAX_COMMENT} characters")
        reviews.require_blocks(recorded.map, review, "the review")
        route = None if review.route == recorded.route else review.route
        review = replace(review, route=route, reviewer=self.reviewer, version=__version__)
        changed = self._reviews.with_review(review)
        write_reviews(self.store.path, changed)
        self._reviews = changed
        return self._state(token) | self._checked_route(recorded)


def review_server(service: ReviewService, port: int = 0) -> LocalServer:
    """The server of the page that reviews a store; port 0 chooses a free one."""
    page = framed("review", title=f"{service.store.path.name} · review")
    return LocalServer(
        {
            "GET /": lambda values: page,
            "GET /api/scenarios": lambda values: service.listing(),
            "GET /api/scenario": lambda values: service.scenario(values.get("id", "")),
            "GET /api/thumbnail": lambda values: service.thumbnail(values.get("id", "")),
            "POST /api/review": lambda body: service.keep(_token(body), body.get("values")),
            "POST /api/route": lambda body: service.check_route(_token(body), body.get("values")),
        },
        port,
    )


def _token(body: dict[str, Any]) -> str:
    return str(body.get("token", ""))
