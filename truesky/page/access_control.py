"""Refuse HTTP requests that lack the secret token of the page or of the TAP service, or that another web site caused.

A web page of another site can make the user's browser send HTTP requests to this machine. Such a page does not know the
token, and it cannot change the headers Host, Origin and Sec-Fetch-Site, which the browser sets.
"""

from __future__ import annotations

import asyncio
import hmac
import logging
import secrets
import socket
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

from aiohttp import http_exceptions, web

from lake_schema.errors import BadInput

MAX_BODY_BYTES = 256 << 10
# Longest time in seconds in which a client must send the body of a request.
BODY_TIMEOUT = 30.0
# Settings of aiohttp for each connection. A connection without a complete header of a request is closed after the
# first time. After an answer, the rest of the request's body is read for the second time, so that the client gets the
# answer. Bodies are not decompressed, because a short one may contain gigabytes, and the page sends none.
CONNECTION_SETTINGS = {"keepalive_timeout": 75.0, "lingering_time": 2.0, "auto_decompress": False}
# Size of the buffer in which the system receives the bytes of a connection (Linux doubles it). The server therefore
# reads small pieces in turn, so that other users need not wait while a client sends without end.
_RECEIVED_BYTES = 16 << 10
_TOKEN_BYTES = 24
_CONTENT_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_SECURITY_HEADERS = {
    "Content-Security-Policy": _CONTENT_POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}
TAP_PATH = "/tap/"
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


def new_token() -> str:
    """Return a new random token of 192 bits as 32 characters that need no escaping in addresses."""
    return secrets.token_urlsafe(_TOKEN_BYTES)


def open_socket(host: str, port: int) -> socket.socket:
    """Return a socket that accepts connections, with a small receive buffer for each; port 0 selects a free port.

    OSError is raised if the port is in use.
    """
    server_socket = socket.create_server((host, port))
    server_socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVED_BYTES)
    return server_socket


@dataclass(frozen=True, slots=True)
class AccessRules:
    """Host names and tokens that HTTP requests to the server of the page must have.

    Attributes
    ----------
    hosts : tuple of str
        Host names or addresses under which the server answers, without the port.
    port : int
        Port of the server.
    token : str
        Secret token of the page; by default a random one. The browser sends it once in the address, then as a cookie.
    tap_token : str
        Secret token of the TAP service; by default a random one. It is part of the address, because TAP clients send no
        cookies.
    """

    hosts: tuple[str, ...]
    port: int
    token: str = field(default_factory=new_token)
    tap_token: str = field(default_factory=new_token)

    @property
    def cookie(self) -> str:
        """Name of the cookie with the token. It contains the port, so that servers on this machine do not share it."""
        return f"truesky-{self.port}"

    @property
    def origins(self) -> set[str]:
        """Allowed values of the HTTP header Origin: the addresses of this server, such as http://localhost:8000."""
        return {f"http://{host}:{self.port}" for host in self.hosts}

    def refusal(self, request: web.Request) -> tuple[int, str] | None:
        """Return the HTTP status and the reason if a request must be refused, else None.

        The status is 403 for a wrong header Host or Origin or a request of another site, 401 for a missing or wrong
        token of the page, and 404 for a wrong token of the TAP service.
        """
        if request.headers.get("Host") not in {f"{host}:{self.port}" for host in self.hosts}:
            return 403, "truesky does not listen on this address"
        if request.headers.get("Origin", next(iter(self.origins))) not in self.origins:
            return 403, "requests from other sites are refused"
        is_entry = request.method == "GET" and request.path == "/"
        if not is_entry and request.headers.get("Sec-Fetch-Site") in ("cross-site", "same-site"):
            return 403, "requests from other sites are refused"
        if request.path.startswith(TAP_PATH):
            presented_token = request.path.removeprefix(TAP_PATH).partition("/")[0]
            # A wrong token of the TAP service gets the same answer as an address that does not exist.
            return None if _tokens_match(presented_token, self.tap_token) else (404, "there is nothing here")
        if is_entry and "token" in request.query:
            return None if _tokens_match(request.query["token"], self.token) else (401, "the token is wrong")
        if not _tokens_match(request.cookies.get(self.cookie, ""), self.token):
            return 401, "open the address that truesky printed"
        return None

    @web.middleware
    async def middleware(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Answer an HTTP request: refuse it, set the cookie, or call its handler.

        A request for "/" with the right token in the address gets a redirection to "/" without it, and the cookie.
        """
        refusal = self.refusal(request)
        if refusal is not None:
            status, reason = refusal
            response: web.StreamResponse = web.Response(status=status, text=f"{reason}\n")
        elif request.path == "/" and "token" in request.query:
            response = web.Response(status=303, headers={"Location": "/"})
            response.set_cookie(self.cookie, self.token, httponly=True, samesite="Strict", path="/")
        else:
            try:
                response = await handler(request)
            except web.HTTPException as error:
                response = web.Response(status=error.status, text=f"{error.reason}\n")
        return response


@asynccontextmanager
async def limit_body() -> AsyncIterator[None]:
    """Limit the time in which an `async with` block may read the body of a request.

    The client gets the status 408 if it has not sent the body after 30 s. BadInput is raised if the body breaks the
    rules of HTTP.
    """
    try:
        async with asyncio.timeout(BODY_TIMEOUT):
            yield
    except TimeoutError:
        raise web.HTTPRequestTimeout from None
    except web.RequestPayloadError:
        raise BadInput("the body of the request does not follow the rules of HTTP") from None


def is_no_client_error(record: logging.LogRecord) -> bool:
    """Return False for messages of aiohttp about requests that break the rules of HTTP.

    Anyone can send such requests, and each message would print a traceback. The client gets the reason.
    """
    error = record.exc_info[1] if record.exc_info else None
    return not isinstance(error, http_exceptions.HttpProcessingError | web.RequestPayloadError)


async def add_security_headers(request: web.Request, response: web.StreamResponse) -> None:
    """Add HTTP headers to a response that restrict which files and servers the page may use.

    aiohttp calls this function just before it sends a response.
    """
    response.headers.update(_SECURITY_HEADERS)


def _tokens_match(presented: str, token: str) -> bool:
    return hmac.compare_digest(presented.encode("utf-8", "surrogateescape"), token.encode())
