"""Servers on the loopback interface, for the holder of a random token only.

Every request needs the token, in the address of a page or in a header; other origins and other
host names are refused, so that no page elsewhere can read or write, also where its name has been
made to lead to this machine. Paths are a fixed list, nothing is looked up on disk by name.
"""

import hmac
import json
import secrets
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import SplitResult, urlsplit

HOST = "127.0.0.1"
TOKEN_HEADER = "X-Shiftsim-Token"
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class LocalServer(ThreadingHTTPServer):
    """Answers on the loopback interface.

    Attributes:
        token: What a request must carry.
    """

    daemon_threads = True

    def __init__(self, handler: "type[LocalHandler]", port: int = 0) -> None:
        """Bind to a port of the loopback interface; 0 chooses a free one."""
        self.token = secrets.token_urlsafe(24)
        super().__init__((HOST, port), handler)

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


class LocalHandler(BaseHTTPRequestHandler):
    """What the answers to all requests share."""

    server: LocalServer
    server_version = "shiftsim"
    sys_version = ""
    protocol_version = "HTTP/1.1"
    timeout = 60.0  # s, for a request that never ends

    def url(self) -> SplitResult | None:
        """What is asked for; None where it is no address, which is answered."""
        try:
            return urlsplit(self.path)
        except ValueError as error:
            self.refuse(HTTPStatus.BAD_REQUEST, f"not an address: {error}")
            return None

    def may(self, given: str) -> bool:
        """Whether the request comes from our own page; else it is refused."""
        own = self.server.origin
        host = own.removeprefix("http://")
        if self.headers.get("Host", "") not in (host, host.replace(HOST, "localhost")):
            return self.refuse(HTTPStatus.FORBIDDEN, "another host name")
        origin = self.headers.get("Origin")
        if origin is not None and origin not in (own, own.replace(HOST, "localhost")):
            return self.refuse(HTTPStatus.FORBIDDEN, "another origin")
        if not hmac.compare_digest(given.encode(), self.server.token.encode()):
            return self.refuse(HTTPStatus.FORBIDDEN, "the token is missing or wrong")
        return True

    def refuse(self, status: HTTPStatus, reason: str) -> bool:
        """Answer with a reason; always False."""
        self.close_connection = True  # its body may not have been read
        self.answer(json.dumps({"error": reason}), "application/json", status)
        return False

    def answer(self, text: str, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        """Send a text, which no cache keeps and which may load nothing from elsewhere."""
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
