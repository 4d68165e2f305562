"""Who may ask: this machine's own browser with the token, tools with the other token, and nobody through another site.

A web page that the user looks at elsewhere can make the browser send requests to this machine: what it may not know is
the token, what it cannot choose are the headers Host, Origin and Sec-Fetch-Site.
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field

from aiohttp import web

MOST_BODY = 256 << 10
_TOKEN_BYTES = 24
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}
TAP = "/tap/"
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


def new_token() -> str:
    """192 random bits."""
    return secrets.token_urlsafe(_TOKEN_BYTES)


@dataclass(frozen=True, slots=True)
class Gate:
    """The rules for one address.

    hosts     : names by which it may be called, without the port
    token     : of the page; tap_token : of the TAP service, which stands in its address since tools send no cookies
    """

    hosts: tuple[str, ...]
    port: int
    token: str = field(default_factory=new_token)
    tap_token: str = field(default_factory=new_token)

    @property
    def cookie(self) -> str:
        """Named by the port: two lakes may be open side by side."""
        return f"truesky-{self.port}"

    @property
    def origins(self) -> set[str]:
        return {f"http://{host}:{self.port}" for host in self.hosts}

    def refusal(self, request: web.Request) -> tuple[int, str] | None:
        """Status and reason where a request is not answered."""
        if request.headers.get("Host") not in {f"{host}:{self.port}" for host in self.hosts}:
            return 403, "this is not the address that truesky listens on"
        if request.headers.get("Origin", next(iter(self.origins))) not in self.origins:
            return 403, "another site may not ask"
        enters = request.method == "GET" and request.path == "/"
        if not enters and request.headers.get("Sec-Fetch-Site") in ("cross-site", "same-site"):
            return 403, "another site may not ask"
        if request.path.startswith(TAP):
            given = request.path.removeprefix(TAP).partition("/")[0]
            # Whoever does not know the address is told that there is none.
            return None if _same(given, self.tap_token) else (404, "there is nothing here")
        if enters and "token" in request.query:
            return None if _same(request.query["token"], self.token) else (401, "the token is another")
        if not _same(request.cookies.get(self.cookie, ""), self.token):
            return 401, "open the address that truesky printed"
        return None

    @web.middleware
    async def middleware(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse, or let answer."""
        refused = self.refusal(request)
        if refused is not None:
            status, reason = refused
            answer: web.StreamResponse = web.Response(status=status, text=f"{reason}\n")
        elif request.path == "/" and "token" in request.query:
            answer = web.Response(status=303, headers={"Location": "/"})
            answer.set_cookie(self.cookie, self.token, httponly=True, samesite="Strict", path="/")
        else:
            try:
                answer = await handler(request)
            except web.HTTPException as error:
                answer = web.Response(status=error.status, text=f"{error.reason}\n")
        return answer


async def dress(request: web.Request, answer: web.StreamResponse) -> None:
    """Give an answer, just before it is sent, the headers that confine the page."""
    answer.headers.update(_HEADERS)


def _same(given: str, token: str) -> bool:
    return hmac.compare_digest(given.encode("utf-8", "surrogateescape"), token.encode())
