"""The review of a store in the browser: the server, and what its page asks for.

The only file written is the review; every change is on disk before its answer.
"""

import getpass
import json
from dataclasses import replace
from http import HTTPStatus
from pathlib import Path
from threading import Lock
from typing import Any
from urllib.parse import parse_qs

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
from shiftsim.errors import ConfigError, ShiftsimError
from shiftsim.runs.filter import read_filter_results
from shiftsim.sim.log import as_recorded
from shiftsim.view.local import TOKEN_HEADER, LocalHandler, LocalServer
from shiftsim.view.pack import Quantised, pack
from shiftsim.view.page import framed
from shiftsim.view.scene import (
    Fields,
    Replay,
    ShownRollout,
    describe_scene,
    indices_near,
    rollout_fields,
    scene_fields,
)
from shiftsim.world.scenario import Scenario

MAX_BODY = 1 << 20  # bytes
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
            DataError: There is no store, or its filter results or reviews are damaged.
        """
        self.store = open_store(store)
        self.reviewer = reviewer or _login()
        filtered = read_filter_results(self.store.path, self.store.hash)
        self._filter_results = {row["token"]: row for row in (filtered.rows if filtered else ())}
        self._reviews = read_reviews(self.store.path)

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
        """Everything the page draws of one scenario.

        Raises:
            DataError: The store has no such scenario.
        """
        recorded = self.store.read_recorded(token)
        replay = Replay(recorded, [ShownRollout("recorded", "none", 0, as_recorded(recorded))])
        blocks = _blocks_near(replay)
        result = self._filter_results.get(token) or {}
        numbers = ("max_outside_m", "path_m", "progress_m", "first_violation_s", "partner_token")
        return {
            "meta": describe_scene(replay),
            "scene": pack(scene_fields(replay)),
            "rollout": pack(rollout_fields(replay, 0)),
            "blocks": pack(_block_fields(replay, blocks)),
            "blockIds": [recorded.map.blocks.ids[block] for block in blocks],
            "recordedRoute": list(recorded.route),
            "numbers": {name: result[name] for name in numbers if result.get(name) is not None},
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
    if not _is_route(route) or not route or not all(name in known for name in route):
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


class ReviewServer(LocalServer):
    """Serves the reviews of one store.

    Attributes:
        service: Does the work; one request at a time.
    """

    def __init__(self, service: ReviewService, port: int = 0) -> None:
        """Bind to a port of the loopback interface; 0 chooses a free one."""
        self.service = service
        self.turn = Lock()
        super().__init__(_Handler, port)


class _Handler(LocalHandler):
    server: ReviewServer

    def do_GET(self) -> None:
        """The page, the list of scenarios, or one of them."""
        if (url := self.url()) is None:
            return
        query = parse_qs(url.query)
        given = self.headers.get(TOKEN_HEADER) or query.get("token", [""])[0]
        if not self.may(given if url.path == "/" else self.headers.get(TOKEN_HEADER, "")):
            return
        if url.path == "/":
            self.answer(review_page(self.server.service.store.path.name), "text/html")
        elif url.path == "/api/scenarios":
            self._work(lambda service: service.listing())
        elif url.path == "/api/scenario":
            token = query.get("id", [""])[0]
            self._work(lambda service: service.scenario(token))
        else:
            self.refuse(HTTPStatus.NOT_FOUND, "no such page")

    def do_POST(self) -> None:
        """Check a route, or keep a review."""
        if not self.may(self.headers.get(TOKEN_HEADER, "")):
            return
        body = self._body()
        if body is None:
            return
        token, values = str(body.get("token", "")), body.get("values")
        if (url := self.url()) is None:
            return
        path = url.path
        if path == "/api/review" and isinstance(values, dict):
            self._work(lambda service: service.keep(token, values))
        elif path == "/api/route" and _is_route(values):
            self._work(lambda service: service.check_route(token, values))
        else:
            self.refuse(HTTPStatus.NOT_FOUND, "no such request")

    def _body(self) -> dict[str, Any] | None:
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal():
            self.refuse(HTTPStatus.BAD_REQUEST, "the request has no Content-Length")
            return None
        if len(length) > 9 or int(length) > MAX_BODY:
            self.refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "the request is too long")
            return None
        try:
            body = json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError):
            body = None
        if not isinstance(body, dict):
            self.refuse(HTTPStatus.BAD_REQUEST, "the request is not a JSON object")
            return None
        return body

    def _work(self, request: Any) -> None:
        try:
            with self.server.turn:
                answer = request(self.server.service)
        except ShiftsimError as error:
            self.refuse(HTTPStatus.BAD_REQUEST, f"{error.message} {error.hint}".strip())
        except OSError as error:
            self.refuse(HTTPStatus.INTERNAL_SERVER_ERROR, f"not kept: {error.strerror or error}")
        else:
            self.answer(json.dumps(answer), "application/json")


def _is_route(values: Any) -> bool:
    return isinstance(values, list) and all(isinstance(name, str) for name in values)


def review_page(store: str) -> str:
    """The page; it fetches everything else."""
    return framed(
        "review.html",
        title=f"{store} · review",
        meta='<meta name="referrer" content="no-referrer">',
        styles=["replay.css", "review.css"],
        scripts=["codec.js", "world.js", "review.js"],
    )
