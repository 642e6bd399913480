"""API keys: nobody gets in without one, nobody sees another's things, and nobody but its user has a key's secret."""

import json
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta, timezone
from ipaddress import IPv4Address
from pathlib import Path
from threading import Semaphore
from typing import Any

import pytest
import structlog
from fastapi import FastAPI
from httpx2 import Response
from sqlalchemy import Connection, Engine, event, update
from starlette.testclient import TestClient

from model_export.started_server import serving
from service.access import is_public, needed_scope
from service.api.clients import Followers
from service.app import create_app
from service.config import Settings
from service.errors import BadRequest, NotFound
from service.principal import SCOPES, Scope
from service.storage.engine import writing
from service.storage.keys import Keys
from service.storage.tables import ApiKeyRow
from tests.fake_calibration import SETTINGS, FakeCalibration
from tests.inference.photographs import corners, png
from tests.test_cli import at_once, camind

PROBLEM = "application/problem+json"
NOWHERE = "/no-such-thing"
PAGE = {"/", "/web/app.js"}
OPEN = {"/health/live", "/health/ready"} | PAGE
Part = tuple[str, tuple[str | None, bytes | str, str]]
CAMERA = {"name": "bench", "image_width_px": 4, "image_height_px": 3, "focus_distance_m": 1.0, "k_cam_px": 2.0}


@pytest.fixture
def settings(settings: Settings) -> Settings:
    return settings.model_copy(update={"api_keys": "on", "key_requests_per_minute": 200})


@pytest.fixture
def app(settings: Settings, fake: FakeCalibration) -> FastAPI:
    return create_app(settings, fake)


@pytest.fixture
def keys(client: TestClient, app: FastAPI) -> Keys:
    assert client.get("/health/live").status_code == 200
    found: Keys = app.state.keys
    return found


@pytest.fixture
def followed(monkeypatch: pytest.MonkeyPatch) -> Semaphore:
    """Released once for every request that has begun to wait for changes."""
    begun = Semaphore(0)
    counted = Followers.counted

    @contextmanager
    def told(followers: Followers, owner: str) -> Iterator[None]:
        with counted(followers, owner):
            begun.release()
            yield

    monkeypatch.setattr(Followers, "counted", told)
    return begun


def bearer(keys: Keys, owner: str, *scopes: Scope, **more: Any) -> dict[str, str]:
    return {"Authorization": f"Bearer {keys.create(owner, owner, scopes or SCOPES, **more)[1]}"}


def refused(answer: Response, status: int, kind: str) -> None:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == PROBLEM
    assert answer.json()["type"] == f"urn:camind:problem:{kind}"
    assert answer.headers["x-request-id"]


def operations(app: FastAPI) -> Iterator[tuple[str, str, list[str]]]:
    """Every method, path and the scopes its description asks for."""
    for path, item in app.openapi()["paths"].items():
        for method, operation in item.items():
            scopes = operation["security"][0]["apiKey"] if operation["security"] else []
            yield method.upper(), path, scopes


@pytest.mark.parametrize(
    ("headers", "is_refused"),
    [
        ({"Sec-Fetch-Site": "cross-site"}, True),
        ({"Sec-Fetch-Site": "same-site", "Origin": "http://testserver:9"}, True),
        ({"Origin": "http://elsewhere.example"}, True),
        ({"Origin": "null"}, True),
        ({"Origin": "http://["}, True),
        ({"Sec-Fetch-Site": "same-origin", "Origin": "http://behind-a-proxy.example"}, False),
        ({"Sec-Fetch-Site": "none"}, False),
        ({"Origin": "http://testserver"}, False),
        ({}, False),
    ],
)
def test_without_keys_another_site_s_page_changes_nothing(
    settings: Settings, headers: dict[str, str], is_refused: bool
) -> None:
    app = create_app(settings.model_copy(update={"api_keys": "off"}), FakeCalibration())
    with TestClient(app) as client:
        made = client.post("/cameras", json=CAMERA, headers=headers)
        if is_refused:
            refused(made, 403, "cross-origin")
            assert client.get("/cameras", headers=headers).json()["items"] == []
        else:
            assert made.status_code == 201


@pytest.mark.parametrize(
    ("host", "is_known"),
    [
        ("localhost:8000", True),
        ("127.0.0.1:8000", True),
        ("[::1]:8000", True),
        ("10.1.2.3", True),
        ("camind:8000", True),
        ("rig.local", True),
        ("camind.lab.svc.cluster.local:8000", True),
        ("camind.example.org", True),
        ("CAMIND.example.org.:443", True),
        ("stranger.example:8000", False),
        ("camind.example.org.stranger.example", False),
        ("localhost.stranger.example", False),
        ("rig.local.stranger.example", False),
        ("127.0.0.1.stranger.example:8000", False),
        ("127.0.0.1@stranger.example", False),
        ("stranger.example#.local", False),
        ("localhost:1.stranger.example", False),
        ("x@localhost", False),
        ("localhost/stranger.example", False),
        ("[stranger.example", False),
    ],
)
def test_without_keys_a_stranger_s_name_for_this_machine_opens_nothing(
    settings: Settings, host: str, is_known: bool
) -> None:
    told = {"api_keys": "off", "hosts": "camind.example.org, depth.example.org"}
    app = create_app(settings.model_copy(update=told), FakeCalibration())
    with TestClient(app) as client:
        asked = {"Host": host, "Origin": f"http://{host}", "Sec-Fetch-Site": "same-origin"}
        answers = [client.get("/cameras", headers=asked), client.post("/cameras", json=CAMERA, headers=asked)]
        if is_known:
            assert [answer.status_code for answer in answers] == [200, 201]
        else:
            for answer in answers:
                refused(answer, 421, "unknown-host")
        assert client.get("/health/ready", headers=asked).status_code == 200


def test_with_a_key_any_name_will_do(client: TestClient, keys: Keys) -> None:
    asked = {"Host": "stranger.example"} | bearer(keys, "lab", "cameras:read")
    assert client.get("/cameras", headers=asked).status_code == 200


def test_every_path_but_health_and_the_page_asks_for_a_key(app: FastAPI, client: TestClient) -> None:
    asked = {(method, path.format(name="x", id="0" * 32)) for method, path, _ in operations(app)}
    others = {("GET", path) for path in ("/docs", "/openapi.json", "/webx", NOWHERE)}
    for method, path in sorted(asked | others | {("GET", path) for path in PAGE}):
        answer = client.request(method, path)
        if path in OPEN:
            assert answer.status_code == 200
            continue
        refused(answer, 401, "unauthorized")
        assert answer.headers["www-authenticate"] == "Bearer"


@pytest.mark.parametrize("words", ["", "Bearer", "Bearer x", "Basic eDp5", "Bearer camind_0123456789ab_" + "x" * 43])
def test_what_is_no_key_lets_nobody_in(client: TestClient, words: str) -> None:
    for more in ({}, ASKED_BEFOREHAND):
        refused(client.get("/cameras", headers={"Authorization": words, **more}), 401, "unauthorized")


def test_a_scheme_may_be_written_in_any_way(client: TestClient, keys: Keys) -> None:
    key = bearer(keys, "lab")["Authorization"].removeprefix("Bearer ")
    assert client.get("/cameras", headers={"Authorization": f"bearer  {key}"}).status_code == 200


def test_a_key_opens_what_its_scope_names_and_nothing_else(app: FastAPI, client: TestClient, keys: Keys) -> None:
    for method, path, scopes in operations(app):
        if path in OPEN:
            continue
        url = path.format(name="x", id="0" * 32)
        others = [scope for scope in SCOPES if scope not in scopes]
        answer = client.request(method, url, headers=bearer(keys, "lab", *others))
        if not scopes:
            assert answer.status_code not in (401, 403), (method, path)
            continue
        refused(answer, 403, "forbidden")
        assert scopes[0] in answer.headers["www-authenticate"]
        with_it = client.request(method, url, headers=bearer(keys, "lab", *[s for s in SCOPES if s in scopes]))
        assert with_it.status_code not in (401, 403), (method, path)


@pytest.mark.parametrize(
    ("method", "path", "scope"),
    [
        ("POST", "/depth", "depth"),
        ("GET", "/cameras", "cameras:read"),
        ("HEAD", "/cameras/a/curve", "cameras:read"),
        ("POST", "/cameras", "cameras:write"),
        ("POST", "/cameras/preview", "cameras:read"),
        ("PUT", "/cameras/preview", "cameras:write"),
        ("DELETE", "/cameras/preview", "cameras:write"),
        ("GET", "/cameras/a/revisions", "cameras:read"),
        ("PUT", "/cameras/a", "cameras:write"),
        ("DELETE", "/cameras/a", "cameras:write"),
        ("POST", "/calibrate", "calibrate"),
        ("POST", "/calibrate/look", "calibrate"),
        ("POST", "/calibrations/a/accept", "calibrate"),
        ("GET", "/calibrations/a/events", "calibrate"),
        ("DELETE", "/calibrations/a", "calibrate"),
        ("GET", "/metrics", "admin"),
        ("GET", "/calibrate/target.pdf", None),
        ("GET", "/model", None),
        ("POST", "/photographs/preview", None),
        ("GET", "/camerasx", None),
    ],
)
def test_the_scope_of_a_path(method: str, path: str, scope: str | None) -> None:
    assert needed_scope(method, path) == scope


@pytest.mark.parametrize("path", ["//", "//cameras", "//web/app.js", "/webcameras", "/healthy", ""])
def test_a_path_that_is_like_a_public_one_is_not(path: str) -> None:
    assert not is_public(path)


def test_cameras_belong_to_an_owner(client: TestClient, keys: Keys) -> None:
    mine, theirs = bearer(keys, "lab"), bearer(keys, "shop")
    assert client.post("/cameras", json=CAMERA, headers=mine).status_code == 201
    for method, path in (("GET", ""), ("GET", "/curve"), ("GET", "/revisions"), ("DELETE", "")):
        refused(client.request(method, f"/cameras/bench{path}", headers=theirs), 404, "not-found")
    body = {field: value for field, value in CAMERA.items() if field != "name"}
    refused(client.put("/cameras/bench", json=body, headers=theirs), 404, "not-found")
    photograph = client.post(
        "/depth?camera=bench", content=png(corners(4, 3)), headers=theirs | {"Content-Type": "image/png"}
    )
    refused(photograph, 404, "not-found")
    assert client.get("/cameras", headers=theirs).json()["items"] == []
    # the name is free for others, and what they do with it changes nothing here
    assert client.post("/cameras", json=CAMERA | {"k_cam_px": 3.0}, headers=theirs).status_code == 201
    assert client.delete("/cameras/bench", headers=theirs).status_code == 204
    assert client.get("/cameras/bench", headers=mine).json()["k_cam_px"] == 2.0


def calibrated(client: TestClient, headers: dict[str, str]) -> Response:
    files: list[Part] = [
        ("settings", (None, json.dumps({**SETTINGS, "register": True}), "application/json")),
        ("defocused", ("near.png", png(corners()), "image/png")),
    ]
    return client.post("/calibrate?camera=bench", files=files, headers=headers)


def test_calibrations_belong_to_an_owner_with_the_camera_they_make(client: TestClient, keys: Keys) -> None:
    mine, theirs = bearer(keys, "lab"), bearer(keys, "shop")
    answer = calibrated(client, mine | {"Prefer": "wait=20"})
    assert (answer.status_code, answer.json()["state"]) == (200, "succeeded")
    path = answer.headers["location"]
    for method, end in (("GET", ""), ("GET", "/events"), ("GET", "/plot.svg"), ("DELETE", "")):
        refused(client.request(method, path + end, headers=theirs), 404, "not-found")
    refused(client.post(f"{path}/accept", json={}, headers=theirs), 404, "not-found")
    assert client.get("/calibrations", headers=theirs).json()["items"] == []
    assert len(client.get("/calibrations", headers=mine).json()["items"]) == 1
    assert client.get("/cameras/bench", headers=mine).json()["source"] == "calibration"
    refused(client.get("/cameras/bench", headers=theirs), 404, "not-found")


def test_a_new_key_takes_the_place_of_a_revoked_one(client: TestClient, keys: Keys) -> None:
    key, text = keys.create("first", "lab")
    old = {"Authorization": f"Bearer {text}"}
    assert client.post("/cameras", json=CAMERA, headers=old).status_code == 201
    keys.revoke(key.id)
    refused(client.get("/cameras/bench", headers=old), 401, "unauthorized")
    assert client.get("/cameras/bench", headers=bearer(keys, "lab")).status_code == 200


def test_a_revoked_key_is_told_no_more_of_what_it_follows(
    client: TestClient, keys: Keys, fake: FakeCalibration, followed: Semaphore
) -> None:
    fake.go.clear()
    key, text = keys.create("first", "lab")
    old, new = {"Authorization": f"Bearer {text}"}, bearer(keys, "lab")
    path = calibrated(client, new).headers["location"]
    with ThreadPoolExecutor(2) as pool:
        told, untold = (pool.submit(client.get, f"{path}/events", headers=headers) for headers in (new, old))
        assert all(followed.acquire(timeout=10) for _ in (new, old))
        keys.revoke(key.id)
        fake.go.set()
        assert '"succeeded"' in told.result().text
        assert '"succeeded"' not in untold.result().text


def test_who_follows_is_bounded_for_each_owner(
    client: TestClient, keys: Keys, fake: FakeCalibration, followed: Semaphore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.api.clients.MOST_FOLLOWERS", 2)
    fake.go.clear()
    mine, theirs = bearer(keys, "lab"), bearer(keys, "shop")
    own, other = (f"{calibrated(client, headers).headers['location']}/events" for headers in (mine, theirs))
    with ThreadPoolExecutor(3) as pool:
        following = [pool.submit(client.get, own, headers=mine) for _ in range(2)]
        assert all(followed.acquire(timeout=10) for _ in following)
        refused(client.get(own, headers=mine), 503, "busy")
        not_waited = calibrated(client, mine | {"Prefer": "wait=60"})
        assert (not_waited.status_code, "preference-applied" in not_waited.headers) == (202, False)
        following.append(pool.submit(client.get, other, headers=theirs))
        assert followed.acquire(timeout=10)
        fake.go.set()
        assert all('"succeeded"' in each.result().text for each in following)
    assert client.get(own, headers=mine).status_code == 200


def test_a_key_for_local_opens_what_was_made_without_keys(settings: Settings) -> None:
    with TestClient(create_app(settings.model_copy(update={"api_keys": "off"}))) as before:
        assert before.post("/cameras", json=CAMERA).status_code == 201
    app = create_app(settings)
    with TestClient(app) as after:
        assert after.get("/cameras/bench", headers=bearer(app.state.keys, "local")).status_code == 200
        refused(after.get("/cameras/bench", headers=bearer(app.state.keys, "lab")), 404, "not-found")


def test_the_log_says_why_keys_cannot_be_looked_up(client: TestClient, app: FastAPI, keys: Keys) -> None:
    headers = bearer(keys, "lab")
    with app.state.engine.begin() as connection:
        connection.exec_driver_sql("DROP TABLE api_keys")
    with structlog.testing.capture_logs() as events:
        refused(client.get("/cameras", headers=headers), 503, "not-ready")
    (cause,) = [event["cause"] for event in events if event["event"] == "unavailable"]
    assert "no such table: api_keys" in cause


def test_a_key_expires(client: TestClient, keys: Keys) -> None:
    soon = bearer(keys, "lab", expires_at=datetime.now(UTC) + timedelta(seconds=2))
    assert client.get("/cameras", headers=soon).status_code == 200
    time.sleep(2)
    refused(client.get("/cameras", headers=soon), 401, "unauthorized")


def test_a_key_has_its_own_quota(settings: Settings) -> None:
    app = create_app(settings.model_copy(update={"key_requests_per_minute": 3}))
    with TestClient(app) as client:
        busy, other = bearer(app.state.keys, "lab"), bearer(app.state.keys, "lab")
        assert [client.get("/cameras", headers=busy).status_code for _ in range(3)] == [200] * 3
        answer = client.get("/cameras", headers=busy)
        refused(answer, 429, "quota-exceeded")
        assert 1 <= int(answer.headers["retry-after"]) <= 60
        assert client.get("/cameras", headers=other).status_code == 200
        assert client.get("/health/ready").status_code == 200
        refused_anyway = bearer(app.state.keys, "lab", "depth")
        assert [client.get("/cameras", headers=refused_anyway).status_code for _ in range(4)] == [403, 403, 403, 429]


def test_who_waits_as_long_as_the_quota_says_is_let_in(settings: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = time.time()
    monkeypatch.setattr(time, "time", lambda: now_s)
    app = create_app(settings.model_copy(update={"key_requests_per_minute": 1}))
    with TestClient(app) as client:
        key = bearer(app.state.keys, "robot")
        assert client.get("/cameras", headers=key).status_code == 200
        now_s += 10.5
        now_s += int(client.get("/cameras", headers=key).headers["retry-after"])
        assert client.get("/cameras", headers=key).status_code == 200


def test_a_clock_that_is_set_back_keeps_nobody_out(settings: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    app = create_app(settings.model_copy(update={"key_requests_per_minute": 3}))
    with TestClient(app) as client:
        key = bearer(app.state.keys, "robot")
        assert [client.get("/cameras", headers=key).status_code for _ in range(4)] == [200, 200, 200, 429]
        true_time = time.time
        monkeypatch.setattr(time, "time", lambda: true_time() - 3600)
        assert [client.get("/cameras", headers=key).status_code for _ in range(4)] == [200, 200, 200, 429]


def test_a_body_is_not_received_for_nobody(client: TestClient) -> None:
    endless = (b"x" * 65536 for _ in range(1000))
    refused(client.post("/depth?camera=x", content=endless, headers={"Content-Type": "image/png"}), 401, "unauthorized")


def test_without_keys_a_key_is_no_matter(settings: Settings) -> None:
    with TestClient(create_app(settings.model_copy(update={"api_keys": "off"}))) as client:
        assert client.get("/cameras", headers={"Authorization": "Bearer x"}).status_code == 200


def test_the_secret_is_with_its_user_alone(engine: Engine) -> None:
    key, text = Keys(engine).create("robot", "lab")
    secret = text.rpartition(key.id + "_")[2]
    assert len(secret) == 43
    with engine.connect() as connection:
        stored = connection.exec_driver_sql("SELECT * FROM api_keys").all()
    assert key.id in str(stored)
    assert secret not in str(stored)
    assert secret not in repr(key)


def test_use_is_noted_once_a_minute(engine: Engine) -> None:
    keys = Keys(engine)
    _, text = keys.create("robot", "lab")
    assert keys.every()[0].last_used_at is None
    assert keys.find(text) is not None
    first = keys.every()[0].last_used_at
    assert first is not None
    assert keys.find(text) is not None
    assert keys.every()[0].last_used_at == first
    for earlier in (first - timedelta(seconds=61), first + timedelta(days=5000)):  # the clock was wrong, and is no more
        with writing(engine) as session:
            session.connection().execute(update(ApiKeyRow).values(last_used_at=earlier))
        assert keys.find(text) is not None
        assert first < (keys.every()[0].last_used_at or first) <= datetime.now(UTC)


def test_a_wrong_key_costs_what_an_unknown_one_does(engine: Engine) -> None:
    keys = Keys(engine)
    key, text = keys.create("robot", "lab")
    statements: list[str] = []

    def note(_c: Connection, _k: object, statement: str, *_: object) -> None:
        statements.append(statement)

    event.listen(engine, "before_cursor_execute", note)
    wrong = text[:-4] + ("AAAA" if not text.endswith("AAAA") else "BBBB")
    costs = []
    for attempt in (wrong, text.replace(key.id, "0" * 12), "nonsense"):
        statements.clear()
        assert keys.find(attempt) is None
        costs.append(list(statements))
    assert costs[0] == costs[1] == costs[2]
    assert costs[0]


def test_keys_are_found_named_and_revoked(engine: Engine) -> None:
    keys = Keys(engine)
    assert not keys.has_good()
    key, text = keys.create("robot", "lab", ["calibrate", "depth"])
    assert keys.has_good()
    assert keys.find(text) is not None
    assert keys.every()[0].scopes == {"depth", "calibrate"}
    revoked = keys.revoke(key.id)
    assert keys.revoke(key.id).revoked_at == revoked.revoked_at
    assert keys.find(text) is None
    assert not keys.has_good()
    tomorrow = datetime.now(timezone(timedelta(hours=5))) + timedelta(days=1)
    keys.create("other", "lab", expires_at=tomorrow)
    assert [(each.name, each.expires_at) for each in keys.every()] == [("robot", None), ("other", tomorrow)]
    with pytest.raises(NotFound):
        keys.revoke("0" * 12)
    for names in (("a b", "lab"), ("robot", "a b")):
        with pytest.raises(BadRequest):
            keys.create(*names)


def test_keys_from_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAMIND_DATA_DIR", str(tmp_path))
    made = at_once("keys", "create", "robot", "--scope", "depth", "--days", "2")
    assert made.exit_code == 0, made.stderr
    text = made.stdout.strip()
    listed = at_once("keys", "list").stdout
    key_id, name, owner, scopes, state, *_ = listed.strip().split("\t")
    assert (name, owner, scopes, state) == ("robot", "robot", "depth", "good")
    product, named, secret = text.split("_", maxsplit=2)
    assert (product, named) == ("camind", key_id)
    assert len(secret) >= 32
    assert secret not in listed
    assert at_once("keys", "revoke", key_id).exit_code == 0
    assert "\trevoked\t" in at_once("keys", "list").stdout
    wrong = at_once("keys", "create", "robot", "--scope", "all")
    assert (wrong.exit_code, wrong.stdout) == (2, "")
    assert at_once("keys", "revoke", "nobody").exit_code == 1


def test_the_log_names_the_key_but_not_its_secret(tmp_path: Path, tiny_model_dir: Path) -> None:
    data_dir = tmp_path / "data"
    text = camind(data_dir, "keys", "create", "robot").stdout.strip()
    on = {"CAMIND_API_KEYS": "on", "CAMIND_LOG_LEVEL": "debug"}
    with serving(data_dir, "--model", tiny_model_dir, settings=on) as server:
        assert server.ask("GET", "/cameras", headers={"Authorization": f"Bearer {text}"}).status == 200
        assert server.ask("GET", "/cameras", headers={"Authorization": f"Bearer {text}x"}).status == 401
        # the log has a request once its answer is out
        server.poll(lambda: '"status": 401' in server.log)
        seen = [json.loads(line) for line in server.log.splitlines() if line.startswith("{")]
        asked = [line for line in seen if line.get("path") == "/cameras" or line.get("status") == 401]
        _, named, secret = text.split("_", maxsplit=2)
        assert [(line["status"], line.get("key")) for line in asked] == [(200, named), (401, None)]
        assert secret not in server.log


def test_nobody_serves_others_without_keys_by_mistake(tmp_path: Path, tiny_model_dir: Path) -> None:
    serve = ("serve", "--host", str(IPv4Address(0)), "--port", "0", "--model", str(tiny_model_dir))
    done = camind(tmp_path, *serve)
    assert done.returncode == 2
    assert "camind keys create" in done.stderr
    assert "CAMIND_API_KEYS=off" in done.stderr
    assert "Traceback" not in done.stderr


ELSEWHERE = "https://app.example.org"
ASKED_BEFOREHAND = {"Origin": ELSEWHERE, "Access-Control-Request-Method": "POST"}


def documented_headers(app: FastAPI) -> set[str]:
    """Those that any answer may have."""
    answers = [
        each for item in app.openapi()["paths"].values() for way in item.values() for each in way["responses"].values()
    ]
    return {name for answer in answers for name in answer.get("headers", {})}


@pytest.mark.parametrize("origins", ["", f"https://other.example, {ELSEWHERE}"])
def test_a_page_of_an_origin_that_is_named_may_ask_with_a_key_and_no_other(settings: Settings, origins: str) -> None:
    is_named = bool(origins)
    app = create_app(settings.model_copy(update={"origins": origins}), FakeCalibration())
    with TestClient(app) as client:
        beforehand = client.options("/depth", headers=ASKED_BEFOREHAND)
        assert beforehand.status_code == 204
        refusal = client.get("/cameras", headers={"Origin": ELSEWHERE})
        refused(refusal, 401, "unauthorized")
        allowed = client.get("/cameras", headers={"Origin": ELSEWHERE, **bearer(app.state.keys, "web")})
        assert allowed.status_code == 200
        for answer in (beforehand, refusal, allowed):
            assert answer.headers.get("access-control-allow-origin") == (ELSEWHERE if is_named else None)
            assert ("Origin" in answer.headers.get("vary", "")) == is_named
        assert ("Authorization" in beforehand.headers.get("access-control-allow-headers", "")) == is_named
        exposed = beforehand.headers.get("access-control-expose-headers", "").split(", ")
        assert (documented_headers(app) <= set(exposed)) == is_named
        assert (
            "access-control-allow-origin"
            not in client.get("/cameras", headers={"Origin": "https://evil.example"}).headers
        )
        assert client.options("/depth", headers={"Origin": ELSEWHERE}).status_code == 401


def test_without_keys_a_page_of_an_origin_that_is_named_may_change_things(settings: Settings) -> None:
    open_to_all = settings.model_copy(update={"api_keys": "off", "origins": ELSEWHERE})
    with TestClient(create_app(open_to_all, FakeCalibration())) as client:
        headers = {"Origin": ELSEWHERE, "Sec-Fetch-Site": "cross-site"}
        assert client.post("/cameras", json=CAMERA, headers=headers).status_code == 201
        refused(
            client.post("/cameras", json=CAMERA, headers=headers | {"Origin": "https://evil.example"}),
            403,
            "cross-origin",
        )
