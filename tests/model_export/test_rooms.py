"""Rooms are what they say: rays meet solids where geometry has them, and q - 1 is that of what is drawn."""

import numpy as np
import pytest
from numpy.typing import NDArray

from model_export.rooms import OVERSAMPLE, Solid, View, _painted, draw_room

VIEW = View(64, 80.0, (31.5, 31.5))
FULL = slice(0, VIEW.size)
UPRIGHT = np.eye(3)


def grey(size: int) -> NDArray[np.float32]:
    return np.full((size, size, 3), 0.5, np.float32)


def stripes(size: int) -> NDArray[np.float32]:
    texture = grey(size)
    texture[:, ::2] = 0
    return texture


@pytest.mark.parametrize("kind", ["box", "ellipsoid", "cylinder"])
def test_a_solid_ahead_is_met_at_its_front_facing_the_camera(kind: str) -> None:
    depth, half = 3.0, 0.5
    hits = Solid(kind, np.array([0, 0, depth]), np.full(3, half), UPRIGHT).meet(VIEW.rays(FULL, FULL))
    middle = VIEW.size * OVERSAMPLE // 2
    assert hits.z[middle, middle] == pytest.approx(depth - half, abs=2e-3)
    np.testing.assert_allclose(hits.normals[middle, middle], (0, 0, -1), atol=0.05)
    assert np.isinf(hits.z[0, 0])


def test_an_ellipsoid_covers_what_its_outline_does() -> None:
    depth, half = 4.0, 0.4
    hits = Solid("ellipsoid", np.array([0, 0, depth]), np.full(3, half), UPRIGHT).meet(VIEW.rays(FULL, FULL))
    outline_px = VIEW.focal_px * half / np.sqrt(depth**2 - half**2)
    assert np.isfinite(hits.z).mean() * VIEW.size**2 == pytest.approx(np.pi * outline_px**2, rel=0.01)


def test_points_met_lie_on_a_turned_box() -> None:
    turned = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))[0]
    extent = np.array([0.3, 0.5, 0.8])
    box = Solid("box", np.array([0.2, -0.1, 4.0]), extent, turned)
    rays = VIEW.rays(FULL, FULL)
    hits = box.meet(rays)
    met = np.isfinite(hits.z)
    local = (rays[met] * hits.z[met][:, None] - box.middle) @ turned.T
    assert met.sum() > 100
    np.testing.assert_allclose((np.abs(local) / extent).max(1), 1, atol=1e-4)


def test_a_ray_beside_a_box_misses_it() -> None:
    box = Solid("box", np.array([0, 0, 3.0]), np.ones(3), UPRIGHT)
    beside, before = np.array([[[0.6, 0, 1]]], np.float32), np.array([[[0.4, 0, 1]]], np.float32)
    assert np.isinf(box.meet(beside).z).all()
    assert box.meet(before).z == pytest.approx(2)


def test_a_texture_reduced_is_its_mean_and_goes_on_mirrored() -> None:
    places = np.stack(np.meshgrid(np.arange(40.0), np.arange(40.0)), 2).astype(np.float32)
    sharp = _painted(stripes(32), places, np.zeros((40, 40), np.float32))
    reduced = _painted(stripes(32), places, np.full((40, 40), 2, np.float32))
    np.testing.assert_allclose(sharp[:, 33:], sharp[:, 31:24:-1], atol=1e-6)
    np.testing.assert_allclose(reduced, 0.25, atol=1e-6)


@pytest.mark.parametrize("seed", range(12))
def test_a_room_is_a_stack_of_layers_within_bounds_on_an_opaque_ground(seed: int) -> None:
    surfaces = draw_room(
        np.random.default_rng(seed), grey, ends=(-0.4, 0.8), bounds=(-0.5, 1.5), focal_px=90.0, count=5, size=64
    )
    *solids, backdrop = surfaces
    assert (backdrop.alpha == 1).all()
    for surface in surfaces:
        assert 0 <= surface.alpha.min() <= surface.alpha.max() <= 1 + 1e-6
        assert -0.5 <= surface.excess.min() <= surface.excess.max() <= 1.5
        assert (surface.color <= surface.alpha[..., None] + 1e-5).all()
    nearness = [float((s.excess * s.alpha).sum() / s.alpha.sum()) for s in solids]
    assert nearness == sorted(nearness, reverse=True)


def test_a_bare_ground_is_a_plane_in_inverse_depth() -> None:
    v, u = np.indices((64, 64)).reshape(2, -1)
    columns = np.stack([u, v, np.ones_like(u)], 1)
    farthest_off = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        *_, ground = draw_room(rng, grey, ends=(-0.4, 0.8), bounds=(-0.9, 3), focal_px=90.0, count=0, size=64)
        excess = ground.excess.ravel()
        plane = columns @ np.linalg.lstsq(columns, excess)[0]
        farthest_off.append(float(np.abs(plane - excess).max()))
    assert sum(off < 1e-3 for off in farthest_off) >= 3  # the others have a wall
    assert sum(off > 0.02 for off in farthest_off) >= 3
