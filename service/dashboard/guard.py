"""What stands before the dashboard's application: who may ask, for what, how much, and within which time.

The page is for people at this machine, but not everybody who can reach its port is one of them: a page from elsewhere
in the same browser can send requests here, and so can other users of the machine. Refused, in this order:

host     another host name than this machine's (421): a foreign name that points here (DNS rebinding)
origin   a request from a page of another origin (403), whatever it asks for
token    a request that changes something without the token in the header TOKEN (403). Only who has started the server
         knows the token: it is in the address that the command prints. A foreign page cannot send the header (CORS)
body     more than LARGEST_BODY bytes (413), counted as they come, or not complete within BODY_TIME (408)

`LIMITS` are for uvicorn: connections that send no complete request head within HEAD_TIME are closed, and so is each
beyond MOST_CONNECTIONS.
"""

from __future__ import annotations

import asyncio
import hmac
import secrets
from typing import Any

import h11
from starlette.datastructures import Headers
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

LOCAL = ("localhost", "127.0.0.1", "[::1]")
"""Names of this machine in an address."""
TOKEN = "x-upright-token"
READING = ("GET", "HEAD")
"""Methods of requests that change nothing."""
LARGEST_BODY = 10_000
"""Bytes."""
BODY_TIME = 10.0
"""s from the end of a request's head to the end of its body."""
HEAD_TIME = 10.0
"""s from the beginning of a connection, or of a request on it, to the end of the request's head."""
MOST_CONNECTIONS = 64
"""A browser has six at a time."""


def new_token() -> str:
    """A token that nobody can guess."""
    return secrets.token_urlsafe(24)


class Guard:
    """Refuses requests as stated above, and adds headers to every response. `policy` is the content security policy."""

    def __init__(self, app: ASGIApp, policy: str, token: str) -> None:
        self._app = app
        self._token = token
        self._headers = {
            b"content-security-policy": policy.encode(),
            b"cross-origin-opener-policy": b"same-origin",
            b"cross-origin-resource-policy": b"same-origin",
            b"x-content-type-options": b"nosniff",
            b"referrer-policy": b"no-referrer",
            b"cache-control": b"no-cache",
        }

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        changes = scope["method"] not in READING
        refusal = _foreign(scope, headers)
        if refusal is None and changes and not has_token(headers, self._token):
            refusal = _refusal(403, "this needs the page's token: open the page by the address that was printed.")
        if refusal is None and changes:
            body = await _body(headers, receive)
            if isinstance(body, JSONResponse):
                refusal = body
            else:
                receive = _given(body, receive)

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                there = {name for name, _ in message["headers"]}
                message["headers"] += [(name, value) for name, value in self._headers.items() if name not in there]
            await send(message)

        await (refusal or self._app)(scope, receive, with_headers)


def has_token(headers: Headers, token: str) -> bool:
    """Whether a request has this token; compared in constant time."""
    return hmac.compare_digest(headers.get(TOKEN, "").encode(), token.encode())


def _foreign(scope: Scope, headers: Headers) -> JSONResponse | None:
    """The refusal of a request to another host or from another origin."""
    host = headers.get("host", "").lower()
    name, colon, port = host.rpartition(":")
    if (name if colon and port.isdecimal() else host) not in LOCAL:
        return _refusal(421, "this page is served as localhost only: reach it from elsewhere through an SSH tunnel.")
    origin = headers.get("origin")
    if origin is not None and origin.lower() != f"{scope['scheme']}://{host}":
        return _refusal(403, "a page from elsewhere may not use this one.")
    return None


async def _body(headers: Headers, receive: Receive) -> bytes | JSONResponse:
    """The body of a request, or why it is refused. What its head says about its length is not relied upon."""
    body, more = b"", True
    try:
        async with asyncio.timeout(BODY_TIME):
            while more:
                message = await receive()
                if message["type"] == "http.disconnect":
                    return _refusal(400, "the request has ended early.")
                body += message.get("body", b"")
                more = message.get("more_body", False)
                if len(body) > LARGEST_BODY or int(headers.get("content-length", "0")) > LARGEST_BODY:
                    return _refusal(413, f"a request has at most {LARGEST_BODY} bytes.")
    except TimeoutError:
        return _refusal(408, f"the request was not complete within {BODY_TIME:g} s.")
    return body


def _given(body: bytes, receive: Receive) -> Receive:
    """A `receive` that gives the body, and then what comes after it."""
    waiting: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

    async def given() -> Message:
        return waiting.pop() if waiting else await receive()

    return given


def _refusal(status: int, text: str) -> JSONResponse:
    """The connection ends with it: what else the client has sent is not read."""
    return JSONResponse({"error": text}, status, {"connection": "close"})


class Bounded(H11Protocol):
    """uvicorn's protocol, with a time limit for the head of a request and a limit of the number of connections."""

    _patience: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        if len(self.connections) > MOST_CONNECTIONS:
            transport.abort()
        else:
            self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        if self._patience is not None:
            self._patience.cancel()
        super().connection_lost(exc)

    def handle_events(self) -> None:
        super().handle_events()
        self._watch()

    def _watch(self) -> None:
        """The time runs while a head is waited for, and not any longer for the bytes that come meanwhile."""
        waits = self.conn.their_state is h11.IDLE
        if waits and self._patience is None:
            self._patience = self.loop.call_later(HEAD_TIME, self.transport.abort)
        elif not waits and self._patience is not None:
            self._patience.cancel()
            self._patience = None


LIMITS: dict[str, Any] = {
    "http": Bounded,
    "ws": "none",
    "proxy_headers": False,
    "log_level": "warning",
    "access_log": False,
}
"""Options of uvicorn."""
