"""uvicorn with what it lacks: a deadline for headers that never end, targets in every form, no bodies in crumbs, and
problem+json for what is no HTTP."""

import asyncio
import errno
import os
import re
import resource
import signal
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from types import FrameType
from typing import cast

import h11
import structlog
import uvicorn
from fastapi import FastAPI
from starlette.datastructures import Headers
from uvicorn.protocols.http.h11_impl import H11Protocol

from service.api.problems import PROBLEM_TYPE, problem
from service.config import Settings
from service.errors import BadRequest, CamindError, ReceiveTimeout
from service.memory import keep_freed_memory
from service.middleware import REQUEST_ID, EndConnections, request_id_of

GRACE_S = 1.0
KEEP_ALIVE_S = 75  # longer than what proxies keep: who closes last is never asked on a connection just closed
BACKLOG = 2048
LET_IN = 16  # connections at a time, before one of them is looked at
MOST_HEADER_BYTES = 65_536
# a body may have this many chunks, and one more for so many of its bytes: each costs 10 microseconds, however small
MOST_CRUMBS = 1_000
CRUMB_BYTES = 256
ABSOLUTE_FORM = re.compile(rb"https?://([^/?#]+)(.*)", re.IGNORECASE)
SPARE_FILES = 256  # of those the process may open: for the database, photographs, decoders, and a burst of connections
STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT)
UNANSWERED = (h11.IDLE, h11.SEND_RESPONSE)
PORTS_FAULTS = (errno.EADDRINUSE, errno.EACCES)
SIGNALLED = 128  # what a shell adds to the signal that ended a process


log = structlog.stdlib.get_logger("camind.request")


class CannotListenError(OSError):
    """The address cannot be bound; the message says which and what to do."""


class MalformedRequest(BadRequest):
    """What came is no HTTP/1.1 request."""

    status = 400
    code = "malformed-request"
    title = "Malformed request"


class HeadersTooLarge(BadRequest):
    """The headers alone are larger than anybody's need."""

    status = 431
    code = "headers-too-large"
    title = "Headers too large"


class Crumbs(h11.RemoteProtocolError):
    """A body in so many small chunks that taking them in would hold up everybody."""


class Connection(h11.Connection):
    """Takes targets in every form (RFC 9112, 3.2), and no body in crumbs."""

    _crumbs = 0.0

    def next_event(self) -> h11.Event | type[h11.NEED_DATA] | type[h11.PAUSED]:
        event = super().next_event()
        if isinstance(event, h11.Request):
            self._crumbs = 0
            return in_origin_form(event)
        if isinstance(event, h11.Data):
            self._crumbs = max(0, self._crumbs + event.chunk_start - len(event.data) / CRUMB_BYTES)
            if self._crumbs > MOST_CRUMBS:
                raise Crumbs(f"The body comes in chunks of less than {CRUMB_BYTES} bytes: send it in larger ones.")
        return event


def in_origin_form(request: h11.Request) -> h11.Request:
    """The request with a path as its target: a host named there is the one, and what asks of all asks of the page."""
    if found := ABSOLUTE_FORM.fullmatch(request.target):
        host, rest = found.groups()
        target = rest if rest.startswith(b"/") else b"/" + rest
        headers = [(b"Host", host), *(pair for pair in request.headers if pair[0] != b"host")]
    elif (request.method, request.target) == (b"OPTIONS", b"*"):
        target, headers = b"/", list(request.headers)
    else:
        return request
    return h11.Request(method=request.method, target=target, headers=headers, http_version=request.http_version)


class DeadlineProtocol(H11Protocol):
    """HTTP/1.1 whose requests must have come whole by a deadline; a connection may not dawdle for ever.

    The app has the first word on slow bodies: this clock runs a little longer, and starts again while an
    answer is being made. An answer of which nothing is taken for that long is given up.
    """

    deadline_s: float
    count_problem: Callable[[str], None]
    _clock: asyncio.TimerHandle | None = None
    _is_refused = False
    _write_clock: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.conn = Connection(h11.SERVER, MOST_HEADER_BYTES)
        super().connection_made(cast(asyncio.Transport, transport))
        if len(self.connections) > most_connections():
            self.transport.abort()
        else:
            self._start_clock()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_clock()
        self._stop_write_clock()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        if self._is_refused:
            return
        super().data_received(data)
        if not self._is_receiving():
            self._stop_clock()
        elif self._clock is None:
            self._start_clock()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._watch_writing()

    def resume_writing(self) -> None:
        self._stop_write_clock()
        super().resume_writing()

    def send_400_response(self, msg: str) -> None:
        """Answer what is no HTTP in the service's own form, and close."""
        cause = sys.exception()
        if isinstance(cause, h11.RemoteProtocolError) and cause.error_status_hint == HeadersTooLarge.status:
            self._refuse(HeadersTooLarge(f"The request line and headers may have at most {MOST_HEADER_BYTES} bytes."))
        else:
            self._refuse(MalformedRequest(str(cause) if isinstance(cause, Crumbs) else msg))

    def _is_receiving(self) -> bool:
        has_part_of_headers = self.conn.their_state is h11.IDLE and bool(self.conn.trailing_data[0])
        return has_part_of_headers or self.conn.their_state is h11.SEND_BODY

    def _start_clock(self) -> None:
        self._clock = self.loop.call_later(self.deadline_s, self._ring)

    def _stop_clock(self) -> None:
        if self._clock is not None:
            self._clock.cancel()
            self._clock = None

    def _ring(self) -> None:
        self._clock = None
        if self.transport.is_closing():
            return
        if self.cycle is not None and not self.cycle.response_complete:
            self._start_clock()
        elif self.conn.our_state is h11.IDLE and self.conn.trailing_data[0]:
            self._refuse(ReceiveTimeout("The request's headers came too slowly."))
        else:
            self.transport.close()

    def _watch_writing(self) -> None:
        self._stop_write_clock()
        untaken_bytes = self.transport.get_write_buffer_size()
        self._write_clock = self.loop.call_later(self.deadline_s, self._require_taken, untaken_bytes)

    def _require_taken(self, untaken_bytes: int) -> None:
        self._write_clock = None
        if self.transport.get_write_buffer_size() < untaken_bytes:
            self._watch_writing()
        else:
            self.transport.abort()

    def _stop_write_clock(self) -> None:
        if self._write_clock is not None:
            self._write_clock.cancel()
            self._write_clock = None

    def _refuse(self, error: CamindError) -> None:
        """Answer and close; what still comes is thrown away for a moment, for a reset would take the answer along."""
        self.count_problem(error.code)
        request = self.scope if self.conn.our_state is h11.SEND_RESPONSE else None
        request_id = request_id_of(Headers(raw=list(request["headers"]) if request else []))
        is_answered = self.conn.our_state not in UNANSWERED
        log.info("refused", request_id=request_id, status=None if is_answered else error.status, problem=error.code)
        body = problem(error).model_dump_json(exclude_none=True).encode()
        headers = [
            ("Content-Type", PROBLEM_TYPE),
            ("Content-Length", str(len(body))),
            ("Connection", "close"),
            (REQUEST_ID, request_id),
        ]
        response = h11.Response(status_code=error.status, headers=headers, reason=error.title.encode())
        if not is_answered:
            data = h11.Data(data=b"" if request and request["method"] == "HEAD" else body)
            for event in (response, data, h11.EndOfMessage()):
                self.transport.write(self.conn.send(event) or b"")
        self._is_refused = True
        if self.cycle is not None:
            # to the app, the client is gone
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        self._stop_clock()
        self._clock = self.loop.call_later(GRACE_S, self.transport.close)
        self.transport.write_eof()


def most_connections() -> int:
    """How many may be open: without files to spare the event loop tries, and says so in the log, without end."""
    most_files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return max(most_files // 2, most_files - SPARE_FILES)


class StoppingServer(uvicorn.Server):
    """Stops in order: the app says so while it still answers, then nobody is let in, then answers are finished.

    Answers that wait for something end as soon as the app knows. A second signal ends the process at once.
    """

    def __init__(self, config: uvicorn.Config, app: FastAPI, drain_s: float) -> None:
        super().__init__(config)
        self._app = app
        self._drain_s = drain_s

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Take the signals to stop; the base class would raise them again at the end, and so not end with 0."""
        is_nohup = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
        numbers = STOP_SIGNALS if is_nohup else (*STOP_SIGNALS, signal.SIGHUP)
        before = {number: signal.signal(number, self.handle_exit) for number in numbers}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def handle_exit(self, sig: int, _frame: FrameType | None) -> None:
        if self.should_exit:
            # nothing that was acknowledged is lost by it
            os._exit(SIGNALLED + sig)
        self._app.state.is_stopping = True
        self.should_exit = True

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        for listener in sockets or ():
            listener.listen(BACKLOG)  # the event loop has only one number for both

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        await asyncio.sleep(self._drain_s)
        await super().shutdown(sockets)


def bind(host: str, port: int) -> socket.socket:
    """A listening socket. Raises ``CannotListenError``, before anything slow was loaded."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with ExitStack() as opened:
        try:
            # without the protocol's number asyncio leaves Nagle's delay on: 40 ms an answer
            listener = opened.enter_context(socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP))
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((host, port))
            listener.listen(BACKLOG)
        except OSError as exc:
            remedy = "--port or CAMIND_PORT" if exc.errno in PORTS_FAULTS else "--host or CAMIND_HOST"
            told = f"Cannot listen on {host}:{port} ({exc.strerror}): choose another {remedy}."
            raise CannotListenError(told) from exc
        opened.pop_all()
    return listener


def serve(app: FastAPI, settings: Settings, listener: socket.socket) -> bool:
    """Answer on the socket until told to stop; whether the app ever started."""
    keep_freed_memory()
    own = {"deadline_s": settings.receive_deadline_s + GRACE_S, "count_problem": app.state.metrics.count_problem}
    protocol = type("Protocol", (DeadlineProtocol,), own)
    config = uvicorn.Config(
        EndConnections(app, settings.receive_deadline_s),
        http=protocol,
        backlog=LET_IN,
        ws="none",
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_keep_alive=KEEP_ALIVE_S,
        timeout_graceful_shutdown=int(settings.deadline_s) + 1,
    )
    server = StoppingServer(config, app, settings.drain_s)
    # how the base class ends where the app does not start
    with suppress(SystemExit):
        server.run(sockets=[listener])
    return server.started
