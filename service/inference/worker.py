"""A bounded pool of threads for the heavy work: slots, a queue, a deadline and cancellation.

A slot is held until its thread really ends, so that work nobody waits for any more still counts. Who shares the queue
with others has a line of its own, which takes no more of it than it leaves free, so that another always finds room.
"""

import asyncio
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Concatenate, Generic, ParamSpec, TypeVar

from service.errors import Busy
from service.inference.cancellation import Cancellation, Cancelled

P = ParamSpec("P")
T = TypeVar("T")

FIRST_GUESS_S = 1.0
MEMORY_OF_DURATION = 0.8


@dataclass(frozen=True, slots=True)
class Outcome(Generic[T]):
    """What the work returned, and how long it waited for a slot, in milliseconds."""

    value: T
    wait_ms: float


class Worker:
    """Runs functions that take a ``Cancellation`` first, those of each line in their order, and the lines in turn.

    Made and closed with the app. ``tell_wait`` is told the seconds each waited for its slot, from the slot's thread.
    """

    def __init__(
        self, *, slots: int, queue_size: int, deadline_s: float, tell_wait: Callable[[float], None] | None = None
    ) -> None:
        if slots < 1 or queue_size < 0 or not deadline_s > 0:
            raise ValueError("a worker needs at least one slot, no negative queue and a positive deadline")
        self.slots = slots
        self.queue_size = queue_size
        self.deadline_s = deadline_s
        self._tell_wait = tell_wait or (lambda _: None)
        self._pool = ThreadPoolExecutor(max_workers=slots, thread_name_prefix="inference")
        self._lock = threading.Lock()
        self._live: dict[Cancellation, str | None] = {}  # each in its line
        self._lines: dict[str | None, deque[Callable[[], None]]] = {}
        self._typical_s = FIRST_GUESS_S

    @property
    def in_flight(self) -> int:
        """Running and queued together."""
        return len(self._live)

    @property
    def slots_in_use(self) -> int:
        """Running now."""
        return min(self.in_flight, self.slots)

    @property
    def queue_depth(self) -> int:
        """Waiting for a slot."""
        return max(0, self.in_flight - self.slots)

    def require_room(self, line: str | None) -> None:
        """Raise ``Busy`` where ``run`` would, so that nobody sends a photograph for nothing; no place is kept."""
        with self._lock:
            self._require_room(line)

    async def run(
        self, line: str | None, work: Callable[Concatenate[Cancellation, P], T], *args: P.args, **kwargs: P.kwargs
    ) -> Outcome[T]:
        """Run the work in a slot; cancelling the awaiting task asks the work to stop.

        ``line`` is whose it is, None where there is no other. Raises ``Busy`` when the queue is full, the line has its
        share of it, the deadline passes, memory is short or the service stops, and whatever the work raises.
        """
        cancellation = self._admit(line)
        future = self._submit(line, cancellation, lambda: work(cancellation, *args, **kwargs))
        try:
            async with asyncio.timeout(self.deadline_s) as deadline:
                return await asyncio.wrap_future(future)
        except TimeoutError as exc:
            if not deadline.expired():
                raise
            raise Busy(
                f"No answer within {self.deadline_s:g} s: try again later or send a smaller photograph.",
                retry_after_s=self._retry_after_s(),
            ) from exc
        except Cancelled as exc:
            raise Busy("The service is stopping.") from exc
        except MemoryError as exc:
            raise Busy(
                "There is too little memory for this photograph: try again later or send a smaller one.",
                retry_after_s=self._retry_after_s(),
            ) from exc
        finally:
            cancellation.cancel()

    def close(self) -> None:
        """Ask everything to stop, and wait until it has."""
        for cancellation in tuple(self._live):
            cancellation.cancel()
        self._pool.shutdown(wait=True)

    def _admit(self, line: str | None) -> Cancellation:
        cancellation = Cancellation()
        with self._lock:
            self._require_room(line)
            self._live[cancellation] = line
        return cancellation

    def _require_room(self, line: str | None) -> None:
        """Raise ``Busy``; the lock is held."""
        taken = tuple(self._live.values())
        own, room = taken.count(line), self.slots + self.queue_size - len(taken)
        if room <= 0:
            reason = f"{len(taken)} requests run or wait, with room for no more"
        elif line is not None and len(taken) >= self.slots and own >= room:
            reason = f"{own} photographs of this owner run or wait, and the room left is for others"
        else:
            return
        raise Busy(f"{reason}: try again later.", retry_after_s=self._retry_after_s())

    def _submit(self, line: str | None, cancellation: Cancellation, work: Callable[[], T]) -> Future[Outcome[T]]:
        submitted = time.perf_counter()
        future: Future[Outcome[T]] = Future()

        def timed() -> Outcome[T]:
            started = time.perf_counter()
            self._tell_wait(started - submitted)
            cancellation.check()
            value = work()
            self._remember(time.perf_counter() - started)
            return Outcome(value, (started - submitted) * 1e3)

        def settle() -> None:
            if not future.set_running_or_notify_cancel():
                return
            try:
                future.set_result(timed())
            except BaseException as exc:
                future.set_exception(exc)

        def leave(_: Future[Outcome[T]]) -> None:
            with self._lock:
                self._live.pop(cancellation, None)
                waiting = self._lines.get(line, deque())
                if settle in waiting:  # what nobody waits for any more holds its photograph no longer
                    waiting.remove(settle)
                if not waiting:
                    self._lines.pop(line, None)

        with self._lock:
            self._lines.setdefault(line, deque()).append(settle)
        future.add_done_callback(leave)
        try:
            self._pool.submit(self._work_next)
        except RuntimeError as exc:
            self._live.pop(cancellation, None)
            raise Busy("The service is stopping.") from exc
        return future

    def _work_next(self) -> None:
        """The first of the next line, which then goes behind the others; nothing where that one left."""
        with self._lock:
            if not self._lines:
                return
            line = next(iter(self._lines))
            waiting = self._lines.pop(line)
            settle = waiting.popleft()
            if waiting:
                self._lines[line] = waiting
        settle()

    def _remember(self, duration_s: float) -> None:
        self._typical_s = MEMORY_OF_DURATION * self._typical_s + (1 - MEMORY_OF_DURATION) * duration_s

    def _retry_after_s(self) -> int:
        """When a slot is likely free: the queue's length in typical durations, in whole seconds."""
        return max(1, math.ceil(self._typical_s * len(self._live) / self.slots))
