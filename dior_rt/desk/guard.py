"""Access control: only the page that has the link, on this machine, may speak to the server.

Every address begins with a random token, which only the printed link contains. A request is refused if its
Host is not this server (DNS rebinding), or if its Origin is another page (cross-site requests). Answers may
not be framed, kept by caches, or load anything from elsewhere.
"""

from __future__ import annotations

import secrets
from typing import Any, Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

POLICY: Final = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' blob: data:",
        "connect-src 'self'",
        "manifest-src 'self'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
        "require-trusted-types-for 'script'",
        "trusted-types 'none'",
    )
)

HEADERS: Final = {
    "Content-Security-Policy": POLICY,
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}

STRANGER: Final = "Open the link that dior-rt printed; addresses without its token are not answered.\n"


def new_token() -> str:
    """Return a token that cannot be guessed: 192 random bits."""
    return secrets.token_urlsafe(24)


class Guard:
    """Middleware that admits requests that begin with /TOKEN/ and come from this server's own page."""

    def __init__(self, app: ASGIApp, token: str, hosts: frozenset[str]) -> None:
        """Store the application. hosts: the values of the header Host that name this server."""
        self.app, self.token, self.hosts = app, token, hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer 403, or pass the request on with the token removed from its path."""
        if scope["type"] != "http":
            if scope["type"] == "lifespan":
                await self.app(scope, receive, send)
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(HEADERS)
            await send(message)

        first, slash, rest = scope["path"].removeprefix("/").partition("/")
        if not (slash and self._has_token(first) and self._is_from_page(Headers(scope=scope))):
            return await PlainTextResponse(STRANGER, 403)(scope, receive, send_guarded)
        inner: dict[str, Any] = {**scope, "path": f"/{rest}", "raw_path": f"/{rest}".encode()}
        await self.app(inner, receive, send_guarded)

    def _has_token(self, token: str) -> bool:
        return secrets.compare_digest(token.encode(), self.token.encode())

    def _is_from_page(self, headers: Headers) -> bool:
        host, origin = headers.get("host", ""), headers.get("origin")
        if host not in self.hosts or origin not in (None, f"http://{host}"):
            return False
        return headers.get("sec-fetch-site", "none") in ("none", "same-origin")
