"""The review server: on the loopback interface, for the holder of a random token only.

Every request needs the token, in the address of the page or in a header; other origins and other
host names are refused, so that no page elsewhere can read or write. Paths are a fixed list, nothing
is looked up on disk by name, and the only file written is the review.
"""

import hmac
import json
import secrets
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Lock
from typing import Any
from urllib.parse import parse_qs, urlsplit

from shiftsim.errors import ShiftsimError
from shiftsim.view.page import framed
from shiftsim.view.review.service import ReviewService

HOST = "127.0.0.1"
TOKEN_HEADER = "X-Shiftsim-Token"
MAX_BODY = 1 << 20  # bytes
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class ReviewServer(ThreadingHTTPServer):
    """Serves the reviews of one store.

    Attributes:
        service: Does the work; one request at a time.
        token: What a request must carry.
    """

    daemon_threads = True

    def __init__(self, service: ReviewService, port: int = 0) -> None:
        """Bind to a port of the loopback interface; 0 chooses a free one."""
        self.service = service
        self.token = secrets.token_urlsafe(24)
        self.turn = Lock()
        super().__init__((HOST, port), _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Nothing: a page that was left before its answer came is no failure."""

    @property
    def origin(self) -> str:
        """Address of the server."""
        return f"http://{HOST}:{self.server_address[1]}"

    @property
    def address(self) -> str:
        """Address of the page, token included."""
        return f"{self.origin}/?token={self.token}"


class _Handler(BaseHTTPRequestHandler):
    server: ReviewServer
    server_version = "shiftsim"
    sys_version = ""
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        """The page, the list of scenarios, or one of them."""
        url = urlsplit(self.path)
        query = parse_qs(url.query)
        given = self.headers.get(TOKEN_HEADER) or query.get("token", [""])[0]
        if not self._may(given if url.path == "/" else self.headers.get(TOKEN_HEADER, "")):
            return
        if url.path == "/":
            self._answer(
                HTTPStatus.OK, review_page(self.server.service.store.path.name), "text/html"
            )
        elif url.path == "/api/scenarios":
            self._work(lambda service: service.listing())
        elif url.path == "/api/scenario":
            token = query.get("id", [""])[0]
            self._work(lambda service: service.scenario(token))
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "no such page")

    def do_POST(self) -> None:
        """Check a route, or keep a review."""
        if not self._may(self.headers.get(TOKEN_HEADER, "")):
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
            self._refuse(HTTPStatus.NOT_FOUND, "no such request")

    def _may(self, given: str) -> bool:
        """Whether the request comes from our own page."""
        own = self.server.origin
        host = own.removeprefix("http://")
        if self.headers.get("Host", "") not in (host, host.replace(HOST, "localhost")):
            return self._refuse(HTTPStatus.FORBIDDEN, "another host name")
        origin = self.headers.get("Origin")
        if origin is not None and origin not in (own, own.replace(HOST, "localhost")):
            return self._refuse(HTTPStatus.FORBIDDEN, "another origin")
        if not hmac.compare_digest(given.encode(), self.server.token.encode()):
            return self._refuse(HTTPStatus.FORBIDDEN, "the token is missing or wrong")
        return True

    def _body(self) -> dict[str, Any] | None:
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > MAX_BODY:
            self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "the request is too long")
            return None
        try:
            body = json.loads(self.rfile.read(int(length)))
        except ValueError:
            body = None
        if not isinstance(body, dict):
            self._refuse(HTTPStatus.BAD_REQUEST, "the request is not a JSON object")
            return None
        return body

    def _work(self, request: Any) -> None:
        try:
            with self.server.turn:
                answer = request(self.server.service)
        except ShiftsimError as error:
            self._refuse(HTTPStatus.BAD_REQUEST, f"{error.message} {error.hint}".strip())
        except OSError as error:
            self._refuse(HTTPStatus.INTERNAL_SERVER_ERROR, f"not kept: {error.strerror or error}")
        else:
            self._answer(HTTPStatus.OK, json.dumps(answer), "application/json")

    def _refuse(self, status: HTTPStatus, reason: str) -> bool:
        self.close_connection = True  # its body may not have been read
        self._answer(status, json.dumps({"error": reason}), "application/json")
        return False

    def _answer(self, status: HTTPStatus, text: str, kind: str) -> None:
        body = text.encode()
        self.send_response(status)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Content-Security-Policy", _POLICY)
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: the terminal belongs to the command."""


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
