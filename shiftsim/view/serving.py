"""One server on the loopback interface, for the holder of a random token only.

Every request needs the token: in the address of a page, in a header for what a page asks for below
`/api/`. Other origins and other host names are refused, so that no page elsewhere can read or
write, also where its name has been made to lead to this machine. What is answered is a fixed list
of routes; nothing is looked up on disk by name.
"""

import hmac
import json
import secrets
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Lock
from typing import Any, TypeAlias
from urllib.parse import parse_qsl, urlsplit

from shiftsim.errors import ShiftsimError

HOST = "127.0.0.1"
TOKEN_HEADER = "X-Shiftsim-Token"
MAX_BODY = 1 << 20  # bytes
_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}

# from the values of an address, or of the JSON object sent, to a page, JSON values, or None where
# there is nothing of the kind
Route: TypeAlias = Callable[[dict[str, Any]], str | dict[str, Any] | None]


class LocalServer(ThreadingHTTPServer):
    """Answers on the loopback interface, one request at a time.

    Attributes:
        token: What a request must carry.
        turn: Held from the call of a route until its answer is sent.
    """

    daemon_threads = True

    def __init__(self, routes: Mapping[str, Route], port: int = 0) -> None:
        """Bind to a port, 0 for a free one; `routes` are by method and path, as in `GET /`."""
        self.routes, self.turn = routes, Lock()
        self.token = secrets.token_urlsafe(24)
        super().__init__((HOST, port), _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Nothing: a page that was left before its answer came is no failure."""

    @property
    def address(self) -> str:
        """Address of the page, token included."""
        return f"http://{HOST}:{self.server_address[1]}/?token={self.token}"


class _Refusal(Exception):
    """A request that is not answered: a status, and the reason."""


class _Handler(BaseHTTPRequestHandler):
    server: LocalServer
    server_version = "shiftsim"
    sys_version = ""
    protocol_version = "HTTP/1.1"
    timeout = 60.0  # s, for a request that never ends

    def do_GET(self) -> None:
        """Check who asks, call the route, and send what it returns."""
        try:
            route, values = self._request()
            with self.server.turn:
                found = self._call(route, values)
                if isinstance(found, str):
                    self._send(found, "text/html")
                else:
                    self._send(json.dumps(found))
        except _Refusal as refusal:
            status, reason = refusal.args
            self.close_connection = True  # its body may not have been read
            self._send(json.dumps({"error": reason}), status=status)

    do_POST = do_GET

    def _request(self) -> tuple[Route, dict[str, Any]]:
        """The route that is asked for and its values, when the request comes from our own page."""
        try:
            url = urlsplit(self.path)
            values: dict[str, Any] = dict(parse_qsl(url.query))
        except ValueError as error:
            raise _Refusal(HTTPStatus.BAD_REQUEST, f"not an address: {error}") from error
        hosts = [f"{name}:{self.server.server_address[1]}" for name in (HOST, "localhost")]
        if self.headers.get("Host", "") not in hosts:
            raise _Refusal(HTTPStatus.FORBIDDEN, "another host name")
        origin = self.headers.get("Origin")
        if origin is not None and origin not in [f"http://{host}" for host in hosts]:
            raise _Refusal(HTTPStatus.FORBIDDEN, "another origin")
        by_address = "" if url.path.startswith("/api/") else values.get("token", "")
        given = self.headers.get(TOKEN_HEADER) or by_address
        if not hmac.compare_digest(given.encode(), self.server.token.encode()):
            raise _Refusal(HTTPStatus.FORBIDDEN, "the token is missing or wrong")
        route = self.server.routes.get(f"{self.command} {url.path}")
        if route is None:
            raise _Refusal(HTTPStatus.NOT_FOUND, "no such page")
        return route, values if self.command == "GET" else self._body()

    def _body(self) -> dict[str, Any]:
        """The JSON object that was sent."""
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal():
            raise _Refusal(HTTPStatus.BAD_REQUEST, "the request has no Content-Length")
        if len(length) > 9 or int(length) > MAX_BODY:
            raise _Refusal(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "the request is too long")
        try:
            body = json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError):
            body = None
        if not isinstance(body, dict):
            raise _Refusal(HTTPStatus.BAD_REQUEST, "the request is not a JSON object")
        return body

    def _call(self, route: Route, values: dict[str, Any]) -> str | dict[str, Any]:
        try:
            found = route(values)
        except ShiftsimError as error:
            reason = f"{error.message} {error.hint}".strip()
            raise _Refusal(HTTPStatus.BAD_REQUEST, reason) from error
        except OSError as error:
            reason = error.strerror or str(error)
            raise _Refusal(HTTPStatus.INTERNAL_SERVER_ERROR, reason) from error
        if found is None:
            raise _Refusal(HTTPStatus.NOT_FOUND, "it is no longer there")
        return found

    def _send(
        self, text: str, kind: str = "application/json", status: HTTPStatus = HTTPStatus.OK
    ) -> None:
        """Send a text, which no cache keeps and which may load nothing from elsewhere."""
        body = text.encode()
        self.send_response(status)
        own = {"Content-Type": f"{kind}; charset=utf-8", "Content-Length": str(len(body))}
        for name, value in {**own, **_HEADERS}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: the terminal belongs to the command."""
