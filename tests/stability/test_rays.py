"""Rays against hard triangles: shared edges and vertices, needles, specks far away for their size.

A direction through a point of a triangle is known in double precision; what a float32 query may differ by is the
rounding of origin, direction and corners.
"""

import functools

import numpy as np
import pytest

from tests.rays.test_wide_bvh import Tracer

from .record import Case, parameters

RAYS = 20000


def moller_trumbore(o, d, corners) -> np.ndarray:
    """Return the distances (R,) of rays to one triangle in float32, NaN for a miss: the usual test with its epsilon."""
    a, b, c = np.float32(corners)
    o, d = np.float32(o), np.float32(d)
    e1, e2 = b - a, c - a
    p = np.cross(d, e2)
    det = p @ e1
    with np.errstate(all="ignore"):
        inverse = np.float32(1.0) / det
        s = o - a
        u = (s * p).sum(axis=1, dtype=np.float32) * inverse
        q = np.cross(s, e1)
        v = (d * q).sum(axis=1, dtype=np.float32) * inverse
        t = (q @ e2) * inverse
        hit = (np.abs(det) > 1e-8) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    return np.where(hit, t, np.nan)


def once_rounded(o, d, corners) -> np.ndarray:
    """Return distances as above by the watertight test without its second look in double precision."""
    o, d, p = np.float32(o), np.float32(d), np.float32(corners)
    z = np.abs(d).argmax(axis=1)
    x, y = (z + 1) % 3, (z + 2) % 3
    rows = np.arange(len(o))
    rel = p[None] - o[:, None]
    shear = d / d[rows, z][:, None]
    px = [rel[rows, i, x] - shear[rows, x] * rel[rows, i, z] for i in range(3)]
    py = [rel[rows, i, y] - shear[rows, y] * rel[rows, i, z] for i in range(3)]
    u, v, w = px[2] * py[1] - py[2] * px[1], px[0] * py[2] - py[0] * px[2], px[1] * py[0] - py[1] * px[0]
    det = u + v + w
    inside = ((np.minimum(np.minimum(u, v), w) >= 0) | (np.maximum(np.maximum(u, v), w) <= 0)) & (det != 0)
    with np.errstate(all="ignore"):
        t = (u * rel[rows, 0, z] + v * rel[rows, 1, z] + w * rel[rows, 2, z]) / det / d[rows, z]
    return np.where(inside & (t > 0), t, np.nan)


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


@functools.cache
def fan(count: int = 64):
    """Return a fan of triangles around a vertex, and rays at points of its spokes and at its centre."""
    rng = np.random.default_rng(1)
    angle = 2.0 * np.pi * np.arange(count) / count
    ring = np.stack([np.cos(angle), np.sin(angle), 0.02 * rng.standard_normal(count)], axis=1)
    vertices = np.float32(np.concatenate([[[0.1, 0.2, 0.3]], ring]))
    faces = np.stack([np.zeros(count, int), 1 + np.arange(count), 1 + (1 + np.arange(count)) % count], axis=1)
    share = np.float32(np.round(rng.random((RAYS, 1)) * 0.9, 1))
    target = vertices[0] + share * (vertices[1 + rng.integers(0, count, RAYS)] - vertices[0])
    origin = np.float32(rng.uniform(-3, 3, (RAYS, 3)) + np.array([0.0, 0.0, 6.0]))
    return vertices, faces, origin, np.float32(unit(target - origin))


def through_a_fan() -> float:
    """Return the share of rays through the inside of a closed fan that find no triangle."""
    vertices, faces, origin, direction = fan()
    return float((Tracer(vertices, faces)(origin, direction)[0]["face"] < 0).mean())


def beside_specks() -> float:
    """Return the share of rays that hit triangles of relative size 1e-5 to 1e-8 from a hundredth of the distance."""
    worst = 0.0
    for exponent in range(5, 9):
        corners, origin, direction = speck(10.0**-exponent)
        hits, found = Tracer(corners, [[0, 1, 2]])(origin, direction)
        worst = max(worst, float((hits["face"] >= 0).mean()), float(found.mean()))
    return worst


def speck(size: float):
    """Return a small triangle, and rays that pass it by more than a hundredth of their way."""
    rng = np.random.default_rng(2)
    corners = np.float32(np.array([1.3, -0.7, 0.4]) + size * rng.standard_normal((3, 3)))
    origin = rng.uniform(-5, 5, (RAYS, 3))
    aside = unit(rng.standard_normal((RAYS, 3))) * np.linalg.norm(corners[0] - origin, axis=1)[:, None]
    direction = unit(corners[0] + rng.uniform(0.02, 0.5, (RAYS, 1)) * aside - origin)
    near = np.linalg.norm(np.cross(corners[0] - origin, direction), axis=1)
    clear = near > 0.01 * np.linalg.norm(corners[0] - origin, axis=1)
    return corners, np.float32(origin[clear]), np.float32(direction[clear])


def needle(width: float):
    """Return a needle of length 2, rays to points of it, and their distances."""
    rng = np.random.default_rng(3)
    corners = np.array([[-1.0, 0.1, 0.2], [1.0, -0.3, 0.5], [1.0, -0.3, 0.5]])
    corners[2] += width * unit(np.array([0.2, 1.0, 0.3]))
    corners = np.float32(corners)
    weights = rng.dirichlet((1.0, 1.0, 1.0), RAYS)
    target = weights @ corners.astype(np.float64)
    normal = unit(np.cross(corners[1].astype(np.float64) - corners[0], [0.2, 1.0, 0.3]))
    origin = np.float32(target + rng.uniform(0.5, 3.0, (RAYS, 1)) * unit(normal + rng.uniform(-0.4, 0.4, (RAYS, 3))))
    distance = np.linalg.norm(target - origin, axis=1)
    return corners, origin, np.float32((target - origin) / distance[:, None]), distance


def needles() -> float:
    """Return the largest error of a distance to needles of aspect 1e2 to 1e7, relative."""
    worst = 0.0
    for exponent in range(2, 8):
        corners, origin, direction, distance = needle(2.0 * 10.0**-exponent)
        hits, _ = Tracer(corners, [[0, 1, 2]])(origin, direction)
        found = hits["face"] >= 0
        assert found.any()
        worst = max(worst, float(np.abs(hits["t"][found] / distance[found] - 1.0).max()))
    return worst


CASES = (
    Case(
        family="rays", name="shared edges and vertices of a fan", bound=0.0, measure=through_a_fan,
        hard="a ray through a vertex meets 64 triangles at a corner; rounding may put it outside of each",
        naive="[Moeller and Trumbore] loses 5 % of such rays",
    ),
    Case(
        family="rays", name="beside specks of 1e-5 .. 1e-8", bound=0.0, measure=beside_specks,
        hard="edge functions of a triangle that is small for its distance vanish by rounding, and 0 counts as inside",
        naive="a watertight test in float32 alone hits such triangles from far beside them",
    ),
    Case(
        family="rays", name="distance to needles of aspect 1e2 .. 1e7", bound=1e-6, measure=needles,
        hard="the edge functions weigh the corners' distances, and are noise on a needle",
        naive="a watertight test in float32 alone is wrong by up to a tenth of the distance",
    ),
)  # fmt: skip


@pytest.mark.parametrize("case", parameters(CASES))
def test_rays(case, check) -> None:
    check(case)


def test_naive_queries_lose_rays_through_vertices() -> None:
    vertices, faces, origin, direction = fan()
    found = np.zeros(len(origin), bool)
    for face in faces:
        found |= np.isfinite(moller_trumbore(origin, direction, vertices[face]))
    assert (~found).mean() > 0.01


def test_naive_queries_hit_specks_beside_them() -> None:
    corners, origin, direction = speck(1e-7)
    assert np.isfinite(once_rounded(origin, direction, corners)).mean() > 1e-3


def test_naive_queries_miss_the_distance_to_needles() -> None:
    corners, origin, direction, distance = needle(2e-7)
    t = once_rounded(origin, direction, corners)
    assert np.nanmax(np.abs(t / distance - 1.0)) > 0.1
