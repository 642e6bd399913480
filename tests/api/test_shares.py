"""What owners share: whoever takes much leaves room for another, and who is alone has all of it."""

import asyncio
import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
from fastapi import FastAPI
from httpx2 import Response
from starlette.testclient import TestClient

from service.api.uploads import Arrivals
from service.app import create_app
from service.config import Settings
from service.errors import Busy
from service.inference.cancellation import Cancellation
from service.inference.worker import Outcome, Worker
from tests.fake_calibration import FakeCalibration, calibration_form
from tests.inference.photographs import corners, never_read, png
from tests.test_access import bearer

ROOM = 8


@pytest.fixture
def release() -> Iterator[threading.Event]:
    event = threading.Event()
    yield event
    event.set()


def hold(_: Cancellation, release: threading.Event) -> None:
    assert release.wait(5)


def taken(slots: int, queue_size: int, wanted: dict[str | None, int], release: threading.Event) -> Counter[str | None]:
    """How many places each owner gets, who ask one after another, and afterwards all are free again."""

    async def scenario() -> Counter[str | None]:
        worker = Worker(slots=slots, queue_size=queue_size, deadline_s=5)
        begun: dict[asyncio.Task[Outcome[None]], str | None] = {}
        for owner, count in wanted.items():
            begun |= {asyncio.create_task(worker.run(owner, hold, release)): owner for _ in range(count)}
            await asyncio.sleep(0.02)
        release.set()
        ends = await asyncio.gather(*begun, return_exceptions=True)
        worker.close()
        assert worker.in_flight == 0
        assert all(isinstance(end, Outcome | Busy) for end in ends)
        return Counter(owner for owner, end in zip(begun.values(), ends, strict=True) if isinstance(end, Outcome))

    return asyncio.run(scenario())


def test_an_owner_leaves_others_room_in_the_queue(release: threading.Event) -> None:
    assert taken(1, ROOM - 1, {"alice": 50, "bob": 50, "carol": 1}, release) == {"alice": 4, "bob": 2, "carol": 1}


def test_a_slot_that_nobody_uses_is_anybody_s(release: threading.Event) -> None:
    assert taken(3, 0, {"alice": 3}, release) == {"alice": 3}


def test_without_keys_the_whole_queue_is_one_s(release: threading.Event) -> None:
    assert taken(1, ROOM - 1, {None: ROOM}, release) == {None: ROOM}


def test_what_one_owner_s_photographs_leave_is_there_for_another_s() -> None:
    arrivals = Arrivals(100)
    with arrivals.counted("alice") as take_alice, arrivals.counted("bob") as take_bob:
        take_alice(40)
        with arrivals.counted("alice") as take_more, pytest.raises(Busy):
            take_more(21)
        take_bob(60)
    with arrivals.counted("alice") as take:
        take(100)


@pytest.fixture
def shared(settings: Settings, fake: FakeCalibration) -> Iterator[TestClient]:
    with_keys = settings.model_copy(update={"api_keys": "on", "queue_size": 1, "calibration_queue_size": 3})
    with TestClient(create_app(with_keys, fake)) as client:
        yield client


@pytest.fixture
def keys(shared: TestClient) -> list[dict[str, str]]:
    """What two owners send with a request."""
    assert isinstance(shared.app, FastAPI)
    return [bearer(shared.app.state.keys, owner) for owner in ("alice", "bob")]


def test_an_owner_who_sends_many_photographs_is_refused_before_another(
    shared: TestClient, keys: list[dict[str, str]], release: threading.Event
) -> None:
    assert isinstance(shared.app, FastAPI)
    assert shared.portal is not None
    state = shared.app.state
    shared.portal.start_task_soon(state.worker.run, "alice", hold, release)
    with ThreadPoolExecutor() as pool:
        picture = png(corners())
        for path in ("/photographs/preview", "/depth?camera=x", "/calibrate/look"):
            refused = shared.post(path, content=never_read(), headers=keys[0])
            assert (refused.status_code, refused.headers["retry-after"]) == (503, "1")
        answer = pool.submit(shared.post, "/photographs/preview", content=picture, headers=keys[1])
        release.set()
        assert answer.result().status_code == 200


def test_an_owner_who_sends_many_calibrations_waits_for_another_s(
    shared: TestClient, keys: list[dict[str, str]], fake: FakeCalibration
) -> None:
    fake.go.clear()
    form = calibration_form(png(corners()))

    def send(number: int) -> Response:
        headers = {"Content-Type": form.headers["Content-Type"], **keys[number]}
        return shared.post("/calibrate", params={"camera": "bench"}, content=form.content, headers=headers)

    first = send(0)
    assert fake.has_begun.wait(5)
    second, third, fourth = send(0), send(0), send(0)
    another = send(1)
    assert [answer.status_code for answer in (first, second, third, fourth, another)] == [202, 202, 202, 503, 202]
    fake.go.set()

    def ended_at(answer: Response, number: int) -> str:
        path = answer.headers["location"]
        while (body := shared.get(path, headers=keys[number]).json())["state"] != "succeeded":
            time.sleep(0.02)
        return str(body["updated_at"])

    assert ended_at(first, 0) < ended_at(another, 1) < ended_at(second, 0) < ended_at(third, 0)
