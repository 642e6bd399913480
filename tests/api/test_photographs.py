"""``POST /photographs/preview``: a photograph of any kind, upright and small, as a JPEG."""

import numpy as np
import pytest
from httpx2 import Response
from numpy.typing import NDArray
from starlette.testclient import TestClient

from service.opencv import cv2
from tests.inference.heics import heic
from tests.inference.photographs import corners, jpeg, png, tiff
from tests.inference.raws import dng

PATH = "/photographs/preview"


def preview(client: TestClient, data: bytes, **query: int) -> Response:
    return client.post(PATH, params=query, content=data, headers={"Content-Type": "application/octet-stream"})


def shown(answer: Response) -> NDArray[np.uint8]:
    assert (answer.status_code, answer.headers["content-type"]) == (200, "image/jpeg"), answer.text
    return np.asarray(cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_COLOR_RGB), np.uint8)


@pytest.mark.parametrize(
    ("data", "upright"),
    [
        (png(corners()), corners()),
        (tiff(corners()), corners()),
        (heic(), corners()),
        (heic(3), np.rot90(corners(), -1)),
        (jpeg(corners(), orientation=6), np.rot90(corners(), -1)),
    ],
    ids=["png", "tiff", "heic", "heic-turned", "jpeg-turned"],
)
def test_a_photograph_of_any_kind_is_shown_upright(client: TestClient, data: bytes, upright: NDArray[np.uint8]) -> None:
    picture = shown(preview(client, data))
    assert picture.shape == upright.shape
    for rows in (slice(8, 16), slice(-16, -8)):
        for columns in (slice(8, 16), slice(-16, -8)):
            difference = picture[rows, columns].mean((0, 1)) - upright[rows, columns].mean((0, 1))
            assert np.abs(difference).max() < 12


def test_a_raw_file_is_shown(client: TestClient) -> None:
    assert shown(preview(client, dng())).std() > 1


def test_it_is_made_small_but_never_larger(client: TestClient) -> None:
    assert shown(preview(client, png(corners(300, 400)), longest_px=100)).shape == (75, 100, 3)
    assert shown(preview(client, png(corners(900, 90)), longest_px=16)).shape[:2] == (16, 2)
    assert shown(preview(client, png(corners()), longest_px=4096)).shape == (48, 64, 3)


def test_what_is_no_photograph_is_refused(client: TestClient) -> None:
    for content, kind, query, status in (
        (b"x", "image/jpeg", {}, 415),
        (b"{}", "application/json", {}, 415),
        (jpeg(corners())[:300], "image/jpeg", {}, 422),
        (b"x" * 2_100_000, "image/jpeg", {}, 413),
        (png(corners()), "image/png", {"longest_px": 5000}, 422),
    ):
        answer = client.post(PATH, params=query, content=content, headers={"Content-Type": kind})
        assert (answer.status_code, answer.headers["content-type"]) == (status, "application/problem+json"), status
