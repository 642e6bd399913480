"""Slots, queue, deadline: what is refused, what is waited for, what is freed."""

import asyncio
import gc
import threading
import time
import weakref
from collections.abc import Iterator

import numpy as np
import pytest

from service.errors import Busy
from service.inference.cancellation import Cancellation, Cancelled
from service.inference.worker import Worker


@pytest.fixture
def release() -> Iterator[threading.Event]:
    event = threading.Event()
    yield event
    event.set()


def add(_: Cancellation, one: int, other: int) -> int:
    return one + other


def hold(_: Cancellation, release: threading.Event) -> str:
    release.wait(10)
    return "held"


def obey(cancellation: Cancellation) -> None:
    while True:
        cancellation.check()
        time.sleep(0.005)


def want_all_memory(_: Cancellation) -> None:
    np.empty(2**60, np.uint8)


async def until_idle(worker: Worker) -> None:
    for _ in range(400):
        if worker.in_flight == 0:
            return
        await asyncio.sleep(0.005)
    raise AssertionError("a slot was never freed")


def test_work_returns_its_value_and_its_wait() -> None:
    worker = Worker(slots=1, queue_size=0, deadline_s=5)
    outcome = asyncio.run(worker.run(None, add, 2, 3))
    assert outcome.value == 5
    assert 0 <= outcome.wait_ms < 1000
    worker.close()


def test_work_that_finds_too_little_memory_may_come_back() -> None:
    worker = Worker(slots=1, queue_size=0, deadline_s=5)
    with pytest.raises(Busy, match="too little memory"):
        asyncio.run(worker.run(None, want_all_memory))
    assert worker.in_flight == 0
    worker.close()


def test_a_full_queue_is_refused_with_a_time_to_come_back(release: threading.Event) -> None:
    async def scenario() -> None:
        worker = Worker(slots=1, queue_size=1, deadline_s=5)
        running = [asyncio.create_task(worker.run(None, hold, release)) for _ in range(2)]
        await asyncio.sleep(0.02)
        with pytest.raises(Busy) as refused:
            await worker.run(None, add, 1, 1)
        assert refused.value.retry_after_s >= 1
        release.set()
        outcomes = await asyncio.gather(*running)
        assert [outcome.value for outcome in outcomes] == ["held", "held"]
        assert outcomes[1].wait_ms > outcomes[0].wait_ms
        assert (await worker.run(None, add, 1, 1)).value == 2
        worker.close()

    asyncio.run(scenario())


def test_the_deadline_answers_at_once_and_the_slot_is_held_until_the_thread_ends(
    release: threading.Event,
) -> None:
    async def scenario() -> None:
        worker = Worker(slots=1, queue_size=0, deadline_s=0.05)
        started = time.perf_counter()
        with pytest.raises(Busy, match=r"0\.05 s"):
            await worker.run(None, hold, release)
        assert time.perf_counter() - started < 2
        with pytest.raises(Busy):
            await worker.run(None, add, 1, 1)
        release.set()
        await until_idle(worker)
        assert (await worker.run(None, add, 1, 1)).value == 2
        worker.close()

    asyncio.run(scenario())


def test_the_deadline_stops_work_that_listens() -> None:
    async def scenario() -> None:
        worker = Worker(slots=1, queue_size=0, deadline_s=0.05)
        with pytest.raises(Busy):
            await worker.run(None, obey)
        await until_idle(worker)
        worker.close()

    asyncio.run(scenario())


def test_cancelling_the_waiting_task_frees_the_slot() -> None:
    async def scenario() -> None:
        worker = Worker(slots=1, queue_size=0, deadline_s=5)
        task = asyncio.create_task(worker.run(None, obey))
        await asyncio.sleep(0.02)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        await until_idle(worker)
        worker.close()

    asyncio.run(scenario())


def test_a_queued_request_that_is_cancelled_never_runs(release: threading.Event) -> None:
    async def scenario() -> None:
        ran: list[int] = []
        worker = Worker(slots=1, queue_size=1, deadline_s=5)
        first = asyncio.create_task(worker.run(None, hold, release))
        await asyncio.sleep(0.02)
        second = asyncio.create_task(worker.run(None, lambda _: ran.append(1)))
        await asyncio.sleep(0.02)
        second.cancel()
        await asyncio.wait([second])
        assert worker.in_flight == 1
        release.set()
        await first
        worker.close()
        assert ran == []

    asyncio.run(scenario())


def test_what_left_the_queue_is_held_no_longer(release: threading.Event) -> None:
    class Photograph:
        pass

    async def leave(worker: Worker) -> "weakref.ref[Photograph]":
        photograph = Photograph()
        waiting = asyncio.create_task(worker.run("a", lambda _, photograph: photograph, photograph))
        await asyncio.sleep(0.02)
        waiting.cancel()
        await asyncio.wait([waiting])
        return weakref.ref(photograph)

    async def scenario() -> None:
        worker = Worker(slots=1, queue_size=1, deadline_s=5)
        first = asyncio.create_task(worker.run("b", hold, release))
        await asyncio.sleep(0.02)
        left = [await leave(worker) for _ in range(3)]
        gc.collect()
        assert [photograph() for photograph in left] == [None] * 3
        another = asyncio.create_task(worker.run("a", add, 1, 1))
        release.set()
        assert ((await first).value, (await another).value) == ("held", 2)
        worker.close()

    asyncio.run(scenario())


def test_lines_take_turns(release: threading.Event) -> None:
    async def scenario() -> list[str]:
        ran: list[str] = []
        worker = Worker(slots=1, queue_size=9, deadline_s=5)
        begun = [asyncio.create_task(worker.run(None, hold, release))]
        for name in ("a1", "a2", "a3", "b1", "b2", "c1"):
            await asyncio.sleep(0)
            begun.append(asyncio.create_task(worker.run(name[0], lambda _, name=name: ran.append(name))))
        await asyncio.sleep(0.02)
        release.set()
        await asyncio.gather(*begun)
        worker.close()
        return ran

    assert asyncio.run(scenario()) == ["a1", "b1", "c1", "a2", "b2", "a3"]


def test_closing_ends_those_that_wait() -> None:
    async def scenario() -> None:
        worker = Worker(slots=1, queue_size=1, deadline_s=5)
        tasks = [asyncio.create_task(worker.run(None, obey)) for _ in range(2)]
        await asyncio.sleep(0.02)
        await asyncio.to_thread(worker.close)
        for end in await asyncio.gather(*tasks, return_exceptions=True):
            assert isinstance(end, Busy)

    asyncio.run(scenario())


def test_errors_of_the_work_come_through() -> None:
    def fail(_: Cancellation) -> None:
        raise TimeoutError("its own")

    worker = Worker(slots=1, queue_size=0, deadline_s=5)
    with pytest.raises(TimeoutError, match="its own"):
        asyncio.run(worker.run(None, fail))
    worker.close()


def test_closing_stops_running_work() -> None:
    async def scenario() -> None:
        worker = Worker(slots=1, queue_size=0, deadline_s=5)
        task = asyncio.create_task(worker.run(None, obey))
        await asyncio.sleep(0.02)
        await asyncio.to_thread(worker.close)
        with pytest.raises(Busy, match="stopping"):
            await task
        with pytest.raises(Busy, match="stopping"):
            await worker.run(None, add, 1, 1)
        assert worker.in_flight == 0

    asyncio.run(scenario())


def test_a_callback_is_called_once_and_only_while_inside() -> None:
    calls: list[str] = []
    cancellation = Cancellation()
    with cancellation.calling(lambda: calls.append("over")):
        pass
    with cancellation.calling(lambda: calls.append("inside")):
        cancellation.cancel()
        cancellation.cancel()
    assert calls == ["inside"]
    with pytest.raises(Cancelled), cancellation.calling(lambda: calls.append("late")):
        pass


@pytest.mark.parametrize(("slots", "queue_size", "deadline_s"), [(0, 1, 1.0), (1, -1, 1.0), (1, 1, 0.0)])
def test_senseless_bounds_are_refused(slots: int, queue_size: int, deadline_s: float) -> None:
    with pytest.raises(ValueError, match="slot"):
        Worker(slots=slots, queue_size=queue_size, deadline_s=deadline_s)
