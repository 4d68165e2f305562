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

MAX_BODY_BYTES = 256 << 10
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
    """192 random bits."""
    return secrets.token_urlsafe(_TOKEN_BYTES)


@dataclass(frozen=True, slots=True)
class AccessRules:
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
        is_entry = request.method == "GET" and request.path == "/"
        if not is_entry and request.headers.get("Sec-Fetch-Site") in ("cross-site", "same-site"):
            return 403, "another site may not ask"
        if request.path.startswith(TAP_PATH):
            presented_token = request.path.removeprefix(TAP_PATH).partition("/")[0]
            # Whoever does not know the address is told that there is none.
            return None if _tokens_match(presented_token, self.tap_token) else (404, "there is nothing here")
        if is_entry and "token" in request.query:
            return None if _tokens_match(request.query["token"], self.token) else (401, "the token is another")
        if not _tokens_match(request.cookies.get(self.cookie, ""), self.token):
            return 401, "open the address that truesky printed"
        return None

    @web.middleware
    async def middleware(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse, or let answer."""
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


async def add_security_headers(request: web.Request, response: web.StreamResponse) -> None:
    """Give an answer, just before it is sent, the headers that confine the page."""
    response.headers.update(_SECURITY_HEADERS)


def _tokens_match(presented: str, token: str) -> bool:
    return hmac.compare_digest(presented.encode("utf-8", "surrogateescape"), token.encode())
