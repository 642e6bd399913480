"""Any sequence of creating, replacing and deleting cameras leaves what a dictionary would hold."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any, ClassVar

import httpx2
import pytest
from fastapi import FastAPI
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test
from starlette.testclient import TestClient

from service.config import Settings
from service.storage.keys import Keys

LENS = {"focal_length_mm": 35, "f_number": 2.8, "pixel_pitch_um": 6.05, "sensor_width_px": 3872}
INTRINSICS = {"fx_px": 900.0, "fy_px": 901.0, "cx_px": 31.5, "cy_px": 23.5, "distortion": [0.1, -0.2, 0.0, 0.0]}
BODIES = st.fixed_dictionaries(
    {
        "image_width_px": st.integers(1, 9_000),
        "image_height_px": st.integers(1, 9_000),
        "focus_distance_m": st.floats(0.1, 50),
        "gamma_px": st.floats(0, 3),
    },
    optional={"description": st.text("abc ÄΩ\n", max_size=20), "intrinsics": st.just(INTRINSICS)},
)
BLURS = st.one_of(st.fixed_dictionaries({"k_cam_px": st.floats(0.1, 100)}), st.just({"lens": LENS}))
# few, so that rules meet on them
NAMES = st.sampled_from("abcd")
# what If-Match is: nothing, any, the revision that is there, one that is not, both, and the right one said weakly
MATCHES = st.sampled_from([None, "*", '"{now}"', '"{not_now}"', '"{not_now}", "{now}"', 'W/"{now}"', "nonsense"])
FITTING = {None, "*", '"{now}"', '"{not_now}", "{now}"'}


@dataclass
class Shelf:
    """What one owner should find: the cameras by name, and the last revision that each name ever had."""

    client: TestClient
    cameras: dict[str, dict[str, Any]] = field(default_factory=dict)
    revisions: dict[str, int] = field(default_factory=dict)

    def write(self, name: str, body: dict[str, Any]) -> dict[str, Any]:
        """The camera as it must now be read, as far as the body says."""
        self.revisions[name] = self.revisions.get(name, 0) + 1
        lens = {**LENS, "k_r": 4.0} if "lens" in body else None
        defaults = {"description": None, "intrinsics": None}
        source = "lens" if lens else "given"
        told = {"name": name, "lens": lens, "source": source, "revision": self.revisions[name]}
        self.cameras[name] = {**defaults, **body, **told}
        return self.cameras[name]


class CameraMachine(RuleBasedStateMachine):
    """Steps of one run; names are its own, for a name remembers its revisions for ever."""

    runs: ClassVar[Iterator[int]] = count()

    def __init__(self, clients: Sequence[TestClient]) -> None:
        super().__init__()
        self.prefix = f"run{next(self.runs):06d}-"
        self.shelves = [Shelf(client) for client in clients]
        self.owners = st.sampled_from(self.shelves)

    @rule(data=st.data(), letter=NAMES, body=BODIES, blur=BLURS)
    def create(self, data: st.DataObject, letter: str, body: dict[str, Any], blur: dict[str, Any]) -> None:
        shelf, name = data.draw(self.owners), self.prefix + letter
        answer = shelf.client.post("/cameras", json={"name": name, **body, **blur})
        if name in shelf.cameras:
            assert answer.status_code == 409
            return
        assert answer.status_code == 201
        assert answer.headers["location"] == f"/cameras/{name}"
        require_same(answer, shelf.write(name, {**body, **blur}))

    @rule(data=st.data(), letter=NAMES, match=MATCHES, body=BODIES, blur=BLURS)
    def replace(
        self, data: st.DataObject, letter: str, match: str | None, body: dict[str, Any], blur: dict[str, Any]
    ) -> None:
        shelf, name = data.draw(self.owners), self.prefix + letter
        headers = if_match(match, shelf.revisions.get(name, 0))
        answer = shelf.client.put(f"/cameras/{name}", json={**body, **blur}, headers=headers)
        assert answer.status_code == self.wanted_status(shelf, name, match, 200)
        if answer.status_code == 200:
            require_same(answer, shelf.write(name, {**body, **blur}))

    @rule(data=st.data(), letter=NAMES, match=MATCHES)
    def delete(self, data: st.DataObject, letter: str, match: str | None) -> None:
        shelf, name = data.draw(self.owners), self.prefix + letter
        headers = if_match(match, shelf.revisions.get(name, 0))
        answer = shelf.client.delete(f"/cameras/{name}", headers=headers)
        assert answer.status_code == self.wanted_status(shelf, name, match, 204)
        if answer.status_code == 204:
            del shelf.cameras[name]

    @rule(data=st.data(), letter=NAMES)
    def read(self, data: st.DataObject, letter: str) -> None:
        shelf, name = data.draw(self.owners), self.prefix + letter
        answer = shelf.client.get(f"/cameras/{name}")
        assert answer.status_code == (200 if name in shelf.cameras else 404)
        if answer.status_code == 200:
            require_same(answer, shelf.cameras[name])

    @rule(data=st.data(), limit=st.integers(1, 5))
    def turn_pages(self, data: st.DataObject, limit: int) -> None:
        shelf = data.draw(self.owners)
        found: list[dict[str, Any]] = []
        parameters: dict[str, Any] = {"limit": limit}
        while parameters:
            page = shelf.client.get("/cameras", params=parameters).json()
            assert len(page["items"]) <= limit
            found += page["items"]
            parameters = {"limit": limit, "cursor": page["next_cursor"]} if page["next_cursor"] else {}
        require_all(found, shelf)

    @invariant()
    def every_owner_finds_its_own(self) -> None:
        for shelf in self.shelves:
            require_all(shelf.client.get("/cameras", params={"limit": 200}).json()["items"], shelf)

    def teardown(self) -> None:
        for shelf in self.shelves:
            for name in shelf.cameras:
                shelf.client.delete(f"/cameras/{name}")

    @staticmethod
    def wanted_status(shelf: Shelf, name: str, match: str | None, done: int) -> int:
        if name not in shelf.cameras:
            return 404
        return done if match in FITTING else 412


def if_match(match: str | None, now: int) -> dict[str, str]:
    return {"If-Match": match.format(now=now, not_now=now + 1)} if match else {}


def require_same(answer: httpx2.Response, wanted: dict[str, Any]) -> None:
    """The answer is the camera, and its tag the revision."""
    assert answer.headers["etag"] == f'"{wanted["revision"]}"'
    read = answer.json()
    assert {name: read[name] for name in wanted} == wanted


def require_all(found: list[dict[str, Any]], shelf: Shelf) -> None:
    wanted = [camera for _, camera in sorted(shelf.cameras.items())]
    assert [{name: read[name] for name in camera} for read, camera in zip(found, wanted, strict=True)] == wanted


@pytest.fixture
def settings(settings: Settings) -> Settings:
    return settings.model_copy(update={"api_keys": "on", "key_requests_per_minute": 0})


@pytest.fixture
def clients(app: FastAPI) -> Iterator[list[TestClient]]:
    """A client for each of two owners, who use the same names."""
    with TestClient(app):
        keys: Keys = app.state.keys
        texts = [keys.create(owner, owner)[1] for owner in ("lab", "shop")]
        yield [TestClient(app, headers={"Authorization": f"Bearer {text}"}) for text in texts]


@pytest.mark.timeout(3600)
def test_any_sequence_leaves_what_a_dictionary_holds(clients: list[TestClient], is_soak: bool) -> None:
    class Machine(CameraMachine):
        def __init__(self) -> None:
            super().__init__(clients)

    run_state_machine_as_test(
        Machine,
        settings=hypothesis_settings(max_examples=300 if is_soak else 10, stateful_step_count=60 if is_soak else 20),
    )
