"""uvicorn with what it lacks: a deadline for headers that never end, and problem+json for what is no HTTP."""

import asyncio
import socket
from collections.abc import Callable
from typing import cast

import h11
import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.h11_impl import H11Protocol

from service.api.problems import PROBLEM_TYPE, problem
from service.config import Settings
from service.errors import BadRequest, CamindError, ReceiveTimeout
from service.memory import keep_freed_memory

GRACE_S = 1.0
BACKLOG = 2048


class PortTakenError(OSError):
    """The address cannot be bound; the message says which and what to do."""


class MalformedRequest(BadRequest):
    """What came is no HTTP/1.1 request."""

    status = 400
    code = "malformed-request"
    title = "Malformed request"


class DeadlineProtocol(H11Protocol):
    """HTTP/1.1 whose requests must have come whole by a deadline; a connection may not dawdle for ever.

    The app has the first word on slow bodies: this clock runs a little longer, and starts again while an
    answer is being made.
    """

    deadline_s: float
    count_problem: Callable[[str], None]
    _clock: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(cast(asyncio.Transport, transport))
        self._start_clock()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_clock()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if not self._is_receiving():
            self._stop_clock()
        elif self._clock is None:
            self._start_clock()

    def send_400_response(self, msg: str) -> None:
        """Answer what is no HTTP in the service's own form, and close."""
        self._refuse(MalformedRequest(msg))

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

    def _refuse(self, error: CamindError) -> None:
        self.count_problem(error.code)
        body = problem(error).model_dump_json(exclude_none=True).encode()
        headers = [
            ("Content-Type", PROBLEM_TYPE),
            ("Content-Length", str(len(body))),
            ("Connection", "close"),
        ]
        response = h11.Response(status_code=error.status, headers=headers, reason=error.title.encode())
        if self.conn.our_state is h11.IDLE:
            for event in (response, h11.Data(data=body), h11.EndOfMessage()):
                self.transport.write(self.conn.send(event) or b"")
        self.transport.close()


class StoppingServer(uvicorn.Server):
    """Tells the app that it stops before waiting for its answers: those that wait for something end then."""

    def __init__(self, config: uvicorn.Config, app: FastAPI) -> None:
        super().__init__(config)
        self._app = app

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self._app.state.is_stopping = True
        await super().shutdown(sockets)


def bind(host: str, port: int) -> socket.socket:
    """A listening socket. Raises ``PortTakenError``, before anything slow was loaded."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # without the protocol's number asyncio leaves Nagle's delay on: 40 ms an answer
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen(BACKLOG)
    except OSError as exc:
        listener.close()
        raise PortTakenError(f"Cannot listen on {host}:{port} ({exc.strerror}): choose another --port.") from exc
    return listener


def serve(app: FastAPI, settings: Settings, listener: socket.socket) -> bool:
    """Answer on the socket until told to stop; whether the app ever started."""
    keep_freed_memory()
    own = {"deadline_s": settings.receive_deadline_s + GRACE_S, "count_problem": app.state.metrics.count_problem}
    protocol = type("Protocol", (DeadlineProtocol,), own)
    config = uvicorn.Config(
        app,
        http=protocol,
        ws="none",
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=int(settings.deadline_s) + 1,
    )
    server = StoppingServer(config, app)
    server.run(sockets=[listener])
    return server.started
