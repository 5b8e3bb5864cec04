"""The review server: what a request for a review may ask, and its answers.

The only file written is the review.
"""

import json
from http import HTTPStatus
from threading import Lock
from typing import Any
from urllib.parse import parse_qs, urlsplit

from shiftsim.errors import ShiftsimError
from shiftsim.view.local import TOKEN_HEADER, LocalHandler, LocalServer
from shiftsim.view.page import framed
from shiftsim.view.review.service import ReviewService

MAX_BODY = 1 << 20  # bytes


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
        url = urlsplit(self.path)
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
        path = urlsplit(self.path).path
        if path == "/api/review" and isinstance(values, dict):
            self._work(lambda service: service.keep(token, values))
        elif path == "/api/route" and _is_route(values):
            self._work(lambda service: service.check_route(token, values))
        else:
            self.refuse(HTTPStatus.NOT_FOUND, "no such request")

    def _body(self) -> dict[str, Any] | None:
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > MAX_BODY:
            self.refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "the request is too long")
            return None
        try:
            body = json.loads(self.rfile.read(int(length)))
        except ValueError:
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
        "review/review.html",
        title=f"{store} · review",
        meta='<meta name="referrer" content="no-referrer">',
        styles=["replay.css", "review/review.css"],
        scripts=["codec.js", "world.js", "review/review.js"],
    )
