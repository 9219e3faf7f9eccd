"""What runs through curves, against dense rows of points along them, in float64."""

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.kernels.primitive.curves_overlap import TOUCHING
from warp_psdr.scene.kinds.bsplinecurve import coefficients
from warp_psdr.topology.kinds.exact_shapes import least_distance
from warp_psdr.topology.kinds.tube_overlaps import tube_overlaps
from warp_psdr.topology.tube_contacts import pierced_segments, pierced_tubes

#: Points of a segment in the rows, and how far these may miss the largest depth, over the radius.
POINTS, COARSE = 40, 0.1


def load(plugin: str, *curves: np.ndarray, split: bool = False) -> psdr.Scene:
    """Curves (N, 4), of one shape or of one each."""
    parts = [[c] for c in curves] if split else [list(curves)]
    scene = {"type": "scene", "sensor": {"type": "perspective"}, "sky": {"type": "constant"}}
    for i, part in enumerate(parts):
        starts = np.cumsum([0, *(len(c) for c in part[:-1])]).tolist()
        points = np.concatenate(part).astype(np.float32)
        scene[f"body_{i}"] = {"type": plugin, "control_points": points, "curve_starts": starts}
    return psdr.load_dict(scene)


def row(plugin: str, points: np.ndarray) -> np.ndarray:
    """Spheres (N, 4) along a curve."""
    points = points.astype(np.float32).astype(np.float64)
    v = np.linspace(0.0, 1.0, POINTS)[:, None, None]
    if plugin == "linearcurve":
        return np.moveaxis((1.0 - v) * points[:-1] + v * points[1:], 0, 1).reshape(-1, 4)
    a = coefficients(points, np.arange(len(points) - 3))
    return np.moveaxis(a[0] + v * (a[1] + v * (a[2] + v * a[3])), 0, 1).reshape(-1, 4)


def depth(plugin: str, a: np.ndarray, b: np.ndarray) -> float:
    """How deep two curves run into each other, over the smaller radius."""
    p, q = row(plugin, a), row(plugin, b)
    apart = np.linalg.norm(p[:, None, :3] - q[None, :, :3], axis=2)
    smaller = np.minimum(p[:, None, 3], q[None, :, 3])
    return float(((p[:, None, 3] + q[None, :, 3] - apart) / smaller).max())


def wander(rng: np.random.Generator, radius: float) -> np.ndarray:
    steps = np.cumsum(rng.normal([0.0, 0.0, 0.3], 0.08, (6, 3)), axis=0)
    return np.column_stack([steps - steps.mean(axis=0) + rng.normal(0.0, 0.2, 3), radius * rng.uniform(0.5, 1.5, 6)])


@pytest.mark.parametrize("plugin", ["bsplinecurve", "linearcurve"])
def test_all_that_run_through_each_other_are_found_and_no_others(plugin: str) -> None:
    rng = np.random.default_rng(3)
    counts = {True: 0, False: 0}
    for radius in (0.1, 0.03, 0.008):
        for trial in range(8):
            a, b = wander(rng, radius), wander(rng, radius)
            # Move one so that they nearly touch, this side or the other.
            p, q = row(plugin, a), row(plugin, b)
            apart = np.linalg.norm(p[:, None, :3] - q[None, :, :3], axis=2)
            i, j = np.unravel_index((apart - p[:, None, 3] - q[None, :, 3]).argmin(), apart.shape)
            way = (p[i, :3] - q[j, :3]) / max(apart[i, j], 1e-9)
            b[:, :3] += (apart[i, j] - (p[i, 3] + q[j, 3]) * rng.choice([0.85, 1.15])) * way
            deep = depth(plugin, a, b)
            if abs(deep - TOUCHING) < COARSE or depth_of_itself(plugin, a) or depth_of_itself(plugin, b):
                continue
            found = tube_overlaps(load(plugin, a, b, split=bool(trial % 2)), 0, True)
            assert (found is not None) == (deep > TOUCHING), (radius, trial, deep)
            counts[deep > TOUCHING] += 1
    assert min(counts.values()) > 4


def depth_of_itself(plugin: str, points: np.ndarray) -> bool:
    """Whether a curve may run through itself: parts that are not next to each other along it come near."""
    spheres = row(plugin, points)
    apart = np.linalg.norm(spheres[:, None, :3] - spheres[None, :, :3], axis=2)
    along = np.cumsum(np.linalg.norm(np.diff(spheres[:, :3], axis=0, prepend=spheres[:1, :3]), axis=1))
    far = along[None] - along[:, None] > 3.5 * spheres[:, 3].max()
    return bool((far & (apart < 1.1 * (spheres[:, None, 3] + spheres[None, :, 3]))).any())


@pytest.mark.parametrize("plugin", ["bsplinecurve", "linearcurve"])
def test_a_curve_that_runs_through_itself_is_found(plugin: str) -> None:
    turn = np.linspace(0.0, 2.0 * np.pi, 14)
    for rise, runs_through in ((0.25, False), (0.15, True)):
        loop = np.column_stack([np.cos(turn), np.sin(turn), rise * turn / (2.0 * np.pi), 0.1 + 0.0 * turn])
        loop = np.concatenate([loop, np.add(loop[1:6], [0.0, 0.0, rise, 0.0])])
        assert (tube_overlaps(load(plugin, loop), 0, True) is not None) == runs_through


@pytest.mark.parametrize("plugin", ["bsplinecurve", "linearcurve"])
def test_triangles_that_run_through_curves_are_found_and_no_others(plugin: str) -> None:
    rng = np.random.default_rng(4)
    counts = {True: 0, False: 0}
    for radius in (0.1, 0.02):
        for trial in range(12):
            points = wander(rng, radius)
            spheres = row(plugin, points)
            triangle = rng.normal(0.0, rng.choice([0.05, 0.5, 5.0]), (3, 3)).astype(np.float32)
            # Move it so that it nearly touches, this side or the other.
            for _round in range(8):
                gap = least_distance(triangle - spheres[:, None, :3]) / spheres[:, 3]
                k = gap.argmin()
                middle = triangle.mean(axis=0) - spheres[k, :3]
                step = ((0.9 if trial % 2 else 1.1) - gap[k]) * spheres[k, 3] / np.linalg.norm(middle)
                triangle = (triangle + step * middle).astype(np.float32)
            gap = least_distance(triangle - spheres[:, None, :3]) / spheres[:, 3]
            deep = 1.0 - min(gap)
            if abs(deep - TOUCHING) < 0.05:
                continue
            scene = {"type": "scene", "sensor": {"type": "perspective"}, "sky": {"type": "constant"}}
            scene["body"] = {"type": plugin, "control_points": points.astype(np.float32)}
            scene["plate"] = {"type": "mesh", "vertices": triangle, "faces": np.array([[0, 1, 2]], np.int32)}
            loaded = psdr.load_dict(scene)
            found = pierced_segments(loaded, 0, triangle[None])
            assert (len(found) > 0) == (deep > TOUCHING), (radius, deep)
            assert set(map(tuple, found)) <= set(map(tuple, pierced_segments(loaded, 0, triangle[None], nearly=True)))
            assert pierced_tubes(loaded, None) is None
            counts[deep > TOUCHING] += 1
    assert min(counts.values()) > 3
