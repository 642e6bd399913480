"""Around every request, in pure ASGI: an id, one log event, metrics, limits on what is received, HEAD.

From the outside in: ``access.AllowOrigins``, ``ObserveRequests``, ``AnswerHead``, ``access.Authenticate``,
``LimitRequests``, ``compression.Compress``, then the routes. ``EndConnections`` is the server's, around all of them.
"""

import asyncio
import re
import time
from collections.abc import Mapping, MutableMapping
from contextlib import suppress
from dataclasses import dataclass, field
from urllib.parse import parse_qs
from uuid import uuid4

import structlog
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.api.handlers import log_fault
from service.api.metrics import Metrics
from service.api.problems import PROBLEM_KEY, problem_response
from service.errors import CamindError, ReceiveTimeout, TooLarge, UnsupportedKind
from service.tracing import STAGES_KEY, Trace, Tracing

REQUEST_ID = "X-Request-Id"
SANE_REQUEST_ID = re.compile(r"[A-Za-z0-9._:-]{1,128}")
CLIENT_GONE = 499
WITH_BODY = ("POST", "PUT")
LEAST_BYTES_PER_S = 32_000  # of a body that may take longer than its deadline: a quarter of a megabit

log = structlog.stdlib.get_logger("camind.request")


@dataclass(slots=True)
class _Exchange:
    """What is known of one request by its end."""

    request_id: str
    started_s: float = field(default_factory=time.perf_counter)
    status: int | None = None

    def stamp(self, message: Message) -> None:
        """Note the status, and put the request's id on the answer, which no other page may frame or take for a page."""
        if message["type"] == "http.response.start":
            self.status = message["status"]
            headers = MutableHeaders(scope=message)
            headers[REQUEST_ID] = self.request_id
            headers.setdefault("Content-Security-Policy", "frame-ancestors 'none'")
            headers.setdefault("X-Content-Type-Options", "nosniff")


class ObserveRequests:
    """Gives every request an id, answers what nothing else caught, counts, logs and traces once."""

    def __init__(self, app: ASGIApp, metrics: Metrics, tracing: Tracing | None) -> None:
        self._app = app
        self._metrics = metrics
        self._tracing = tracing

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        exchange = _Exchange(request_id_of(Headers(scope=scope)))

        async def stamped(message: Message) -> None:
            exchange.stamp(message)
            await send(message)

        with structlog.contextvars.bound_contextvars(request_id=exchange.request_id):
            try:
                with self._metrics.in_progress.track_inprogress():
                    await self._answered(exchange, scope, receive, stamped)
            finally:
                self._report(exchange, scope)

    async def _answered(self, exchange: _Exchange, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await self._app(scope, receive, send)
        except ClientDisconnect:
            pass  # nobody is there to be answered; the report says so
        except Exception as exc:
            if exchange.status is not None:
                raise
            if isinstance(exc, CamindError):
                log_fault(exc)
            else:
                log.exception("request_failed")
                exc = CamindError("Something went wrong here; the log has it under this X-Request-Id.")
            await problem_response(exc)(scope, receive, send)

    def _report(self, exchange: _Exchange, scope: Scope) -> None:
        duration_s = time.perf_counter() - exchange.started_s
        status = exchange.status or CLIENT_GONE
        path = getattr(scope.get("route"), "path", None)
        self._metrics.count(scope["method"], path, status, duration_s)
        problem = scope.get(PROBLEM_KEY)
        if problem is not None:
            self._metrics.count_problem(problem)
        log.info(
            "request",
            method=scope["method"],
            path=path,
            status=status,
            duration_ms=round(duration_s * 1e3, 1),
            **({"problem": problem} if problem else {}),
            **_camera(scope, path),
            **_key(scope),
        )
        if self._tracing is not None:
            stages_ms = scope.get(STAGES_KEY, {})
            trace = Trace(exchange.request_id, scope["method"], path, status, duration_s, problem, stages_ms)
            self._tracing.record(trace, Headers(scope=scope))


class AnswerHead:
    """Answers HEAD as GET without the body, as RFC 9110 asks of every server."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return

        is_answered = False

        async def bodiless(message: Message) -> None:
            nonlocal is_answered
            if message["type"] == "http.response.body":
                # at once: the body of an event stream may take minutes to end
                message = {**message, "body": b"", "more_body": False}
            if not is_answered:
                await send(message)
            is_answered = message["type"] == "http.response.body"

        inner = {**scope, "method": "GET"}
        try:
            await self._app(inner, receive, bodiless)
        finally:
            _hand_back(inner, scope)


class EndConnections:
    """Ends a connection where what comes next on it could be taken wrongly, and ends none before the answer is through.

    An answer says ``Connection: close`` where the body had two lengths (RFC 9112, 6.1), where the client waits for
    ``100 Continue`` and may send the body or another request, and where the service stops. What still comes of the body
    is thrown away before a connection is closed, for ``deadline_s`` at most: a reset would take the answer along.
    """

    def __init__(self, app: ASGIApp, deadline_s: float) -> None:
        self._app = app
        self._deadline_s = deadline_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        is_last = scope["http_version"] == "1.0" or "close" in headers.get("connection", "").lower()
        is_unclear = "transfer-encoding" in headers and "content-length" in headers
        is_waiting = headers.get("expect", "").lower() == "100-continue"
        is_whole = "transfer-encoding" not in headers and "content-length" not in headers
        is_answered = False

        async def followed() -> Message:
            nonlocal is_waiting, is_whole
            is_waiting = False
            message = await receive()
            is_whole = not message.get("more_body", False)
            return message

        async def ending(message: Message) -> None:
            nonlocal is_last, is_answered
            is_stopping = scope["app"].state.is_stopping
            if message["type"] == "http.response.start" and (is_unclear or is_waiting or is_stopping):
                is_last = True
                MutableHeaders(scope=message)["Connection"] = "close"
            elif message["type"] == "http.response.body" and is_last and not is_whole:
                is_answered = not message.get("more_body", False)
                message = {**message, "more_body": True}
            await send(message)

        await self._app(scope, followed, ending)
        if is_answered:
            with suppress(TimeoutError):
                async with asyncio.timeout(self._deadline_s):
                    while not is_whole:
                        await followed()
            await send({"type": "http.response.body"})


@dataclass(frozen=True, slots=True)
class BodyLimits:
    """The most bytes a body may have, and the longest it may take to arrive where it is slower than the least rate."""

    max_bytes: int
    deadline_s: float


class LimitRequests:
    """Refuses bodies that are too large, by their stated length or by what comes, that come too slowly, or compressed.

    ``limits_by_path`` overrides ``limits`` for single paths. Raises ``TooLarge``, ``ReceiveTimeout``,
    ``UnsupportedKind``.
    """

    def __init__(self, app: ASGIApp, limits: BodyLimits, limits_by_path: Mapping[str, BodyLimits]) -> None:
        self._app = app
        self._limits = limits
        self._limits_by_path = limits_by_path

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        limits = self._limits_by_path.get(scope["path"], self._limits)
        headers = Headers(scope=scope)
        coding, stated = headers.get("content-encoding", "identity"), headers.get("content-length", "")
        if scope["method"] in WITH_BODY and coding.lower() != "identity":
            raise UnsupportedKind(f"Send the body as it is, without Content-Encoding: {coding[:40]}.")
        if stated.isdecimal() and int(stated[:20]) > limits.max_bytes:
            raise _too_large(limits.max_bytes)
        await self._app(scope, _LimitedBody(receive, limits), send)


class _LimitedBody:
    """``receive`` with a count and a clock; both end with the body, for later messages mean a disconnect.

    The clock starts anew whenever as much has come as the least rate brings in that time: a slow line gets through, who
    sends a byte now and then, or stops, is cut at the deadline.
    """

    def __init__(self, receive: Receive, limits: BodyLimits) -> None:
        self._receive = receive
        self._limits = limits
        self._received = 0
        self._start_clock()
        self._is_whole = False

    async def __call__(self) -> Message:
        if self._is_whole:
            return await self._receive()
        try:
            async with asyncio.timeout(self._ends_at_s - time.monotonic()):
                message = await self._receive()
        except TimeoutError as exc:
            least = f"less than {LEAST_BYTES_PER_S // 1000} kB/s for {self._limits.deadline_s:g} s"
            raise ReceiveTimeout(f"The request body came too slowly: {least}.") from exc
        self._received += len(message.get("body", b""))
        self._is_whole = not message.get("more_body", False)
        if self._received >= self._enough:
            self._start_clock()
        if self._received > self._limits.max_bytes:
            raise _too_large(self._limits.max_bytes)
        return message

    def _start_clock(self) -> None:
        self._ends_at_s = time.monotonic() + self._limits.deadline_s
        self._enough = self._received + LEAST_BYTES_PER_S * self._limits.deadline_s


def _too_large(limit: int) -> TooLarge:
    return TooLarge(f"The request body may have at most {limit} bytes.")


def request_id_of(headers: Headers) -> str:
    """The id that a request came with, or a new one."""
    given = headers.get(REQUEST_ID, "")
    return given if SANE_REQUEST_ID.fullmatch(given) else uuid4().hex


def _camera(scope: Scope, path: str | None) -> dict[str, str]:
    """The camera a request is about, for the log."""
    if path and path.startswith("/cameras/{name}"):
        return {"camera": str(scope["path_params"]["name"])[:64]}
    names = parse_qs(scope["query_string"].decode("ascii", "replace")).get("camera", [])
    return {"camera": names[0][:64]} if names else {}


def _key(scope: Scope) -> dict[str, str]:
    """The API key a request came with, by its public half, for the log."""
    principal = scope.get("state", {}).get("principal")
    return {"key": principal.key_id} if principal and principal.key_id else {}


def _hand_back(inner: MutableMapping[str, object], scope: Scope) -> None:
    """Let the outer middleware see which route answered."""
    for key in ("route", "path_params", "state", PROBLEM_KEY):
        if key in inner:
            scope[key] = inner[key]
