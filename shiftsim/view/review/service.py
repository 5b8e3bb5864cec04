"""What the review page asks for: the list of scenarios, one of them, and a review to keep.

Nothing here knows of HTTP. Every change is on disk before its answer.
"""

import getpass
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim._version import __version__
from shiftsim.data.store.reading import open_store
from shiftsim.data.store.review import (
    ACCEPT,
    REJECT,
    UNDECIDED,
    Review,
    read_reviews,
    route_problems,
    write_reviews,
)
from shiftsim.errors import ConfigError
from shiftsim.runs.filter import read_filter_results
from shiftsim.sim.log import as_recorded
from shiftsim.view.pack import Quantised, pack
from shiftsim.view.scene import (
    Fields,
    Replay,
    Shown,
    describe_scene,
    indices_near,
    rollout_fields,
    scene_fields,
)
from shiftsim.world.scenario import Scenario

MAX_COMMENT = 4000  # characters
_STEP = 0.05  # m


class ReviewService:
    """The reviews of one store, and what is needed to make them."""

    def __init__(self, store: Path, reviewer: str = "") -> None:
        """Open the store.

        Args:
            store: Its folder.
            reviewer: Who reviews; the user's login name when empty.

        Raises:
            DataError: There is no store, or its verdicts or reviews are damaged.
        """
        self.store = open_store(store)
        self.reviewer = reviewer or _login()
        found = read_filter_results(self.store.path, self.store.hash)
        self._verdicts = {row["token"]: row for row in (found.rows if found else ())}
        self._reviews = read_reviews(self.store.path)

    def listing(self) -> dict[str, Any]:
        """All scenarios with their verdict and review."""
        table = self.store.summary().select(["token", "type", "city"]).to_pylist()
        return {
            "store": self.store.path.name,
            "reviewer": self.reviewer,
            "scenarios": [row | self._state(row["token"]) for row in table],
        }

    def _state(self, token: str) -> dict[str, Any]:
        verdict = self._verdicts.get(token)
        review = self._reviews.get(token, Review(token))
        return {
            "verdict": verdict["verdict"] if verdict else "not filtered",
            "reason": verdict["reason"] if verdict else "",
            "decision": review.decision,
            "comment": review.comment,
            "route": None if review.route is None else list(review.route),
        }

    def scenario(self, token: str) -> dict[str, Any]:
        """Everything the page draws of one scenario.

        Raises:
            DataError: The store has no such scenario.
        """
        recorded = self.store.read_recorded(token)
        replay = Replay(recorded, [Shown("recorded", "none", 0, as_recorded(recorded))])
        blocks = _blocks_near(replay)
        verdict = self._verdicts.get(token) or {}
        numbers = ("max_outside_m", "path_m", "progress_m", "first_violation_s", "partner_token")
        return {
            "meta": describe_scene(replay),
            "scene": pack(scene_fields(replay)),
            "rollout": pack(rollout_fields(replay, 0)),
            "blocks": pack(_block_fields(replay, blocks)),
            "blockIds": [recorded.map.blocks.ids[block] for block in blocks],
            "recordedRoute": list(recorded.route),
            "numbers": {name: verdict[name] for name in numbers if verdict.get(name) is not None},
            **self._state(token),
            **self.check_route(token, self._route(recorded)),
        }

    def _route(self, recorded: Scenario) -> list[str]:
        review = self._reviews.get(recorded.token)
        return list(review.route if review and review.route else recorded.route)

    def check_route(self, token: str, route: list[str]) -> dict[str, Any]:
        """A route with what is wrong with it."""
        recorded = self.store.read_recorded(token)
        return {
            "current": route,
            "problems": route_problems(recorded.map, route, _start_block(recorded)),
        }

    def keep(self, token: str, values: dict[str, Any]) -> dict[str, Any]:
        """Put a review on disk; returns what is kept.

        Args:
            token: The scenario.
            values: `decision`, `comment` and `route` (null for the recorded one); those missing
                stay as they are.

        Raises:
            ConfigError: A value is none of those possible.
            DataError: The store has no such scenario.
        """
        recorded = self.store.read_recorded(token)
        review = self._reviews.get(token, Review(token))
        review = replace(review, **_checked(values, recorded))
        review = replace(review, reviewer=self.reviewer, version=__version__)
        reviews = self._reviews.with_review(review)
        write_reviews(self.store.path, reviews)
        self._reviews = reviews
        return self._state(token) | self.check_route(token, self._route(recorded))


def _login() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return ""


def _checked(values: dict[str, Any], recorded: Scenario) -> dict[str, Any]:
    out = {}
    unknown = sorted(set(values) - {"decision", "comment", "route"})
    if unknown:
        raise ConfigError(f"a review has no field {unknown[0]!r}")
    if "decision" in values:
        if values["decision"] not in (ACCEPT, REJECT, UNDECIDED):
            raise ConfigError(f"decision {values['decision']!r}", hint="accept, reject or nothing")
        out["decision"] = values["decision"]
    if "comment" in values:
        comment = values["comment"]
        if not isinstance(comment, str) or len(comment) > MAX_COMMENT:
            raise ConfigError(f"a comment is a text of up to {MAX_COMMENT} characters")
        out["comment"] = comment
    if "route" in values:
        out["route"] = _checked_route(values["route"], recorded)
    return out


def _checked_route(route: Any, recorded: Scenario) -> tuple[str, ...] | None:
    if route is None:
        return None
    known = recorded.map.blocks.index
    if not isinstance(route, list) or not route or not all(name in known for name in route):
        raise ConfigError("a route is a list of roadblocks of the map, or null")
    return None if tuple(route) == recorded.route else tuple(route)


def _start_block(scenario: Scenario) -> int | None:
    """The block under the ego at the first iteration; one on the route where there are several."""
    x, y = scenario.expert[0, :2]
    found = scenario.map.blocks.containing(x, y).tolist()
    on_route = [b for b in found if scenario.map.blocks.ids[b] in scenario.route]
    return next(iter(on_route or found), None)


def _blocks_near(replay: Replay) -> list[int]:
    """Blocks that share a point with the box that is drawn, and those of the route."""
    layer = replay.scenario.map.blocks
    route = (layer.index[name] for name in replay.scenario.route if name in layer.index)
    return sorted({*indices_near(layer, replay.box), *route})


def _block_fields(replay: Replay, blocks: list[int]) -> Fields:
    """Outlines of the blocks: rings per block, vertices per ring, vertices."""
    layer = replay.scenario.map.blocks
    rings = [layer.rings(block) for block in blocks]
    flat = [ring for group in rings for ring in group]
    xy = np.concatenate(flat) if flat else np.zeros((0, 2))
    return {
        "blocks.rings": Quantised(np.array([len(group) for group in rings], float), 1.0),
        "blocks.count": Quantised(np.array([len(ring) for ring in flat], float), 1.0),
        "blocks.xy": Quantised(xy - replay.origin, _STEP),
    }
