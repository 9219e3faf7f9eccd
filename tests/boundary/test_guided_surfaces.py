"""Guiding where segments touch shapes without triangles: guided estimates equal unguided ones, of less variance."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from warp_psdr.estimate.boundary import terms
from warp_psdr.estimate.boundary.drivers import launch_forward
from warp_psdr.plan.motion import motion

from . import test_neuralsdf, test_sdfgrid, test_sdfgrid_cubic, test_tubes
from .measure import assert_transposes
from .scenes import diffuse, floor, load, panel, register
from .test_exact_kinds import NAME as SHAPE
from .test_exact_sphere import VIEW, entry, moved_light

SMALL = {
    "kdtree": psdr.guiding.KdTree(max_leaves=512),
    "octree": psdr.guiding.Octree(max_leaves=512),
    "grid": psdr.guiding.Grid(shape=(64, 4, 4), photons=2000, importons=2000),
}
BATCHES = 24
#: Of a block's mean: a right estimate is farther off once in three thousand blocks.
MOST_SIGMAS, MOST_RMS = 4.5, 1.5


def crowd():
    """Twenty balls far from what the camera sees, and one whose shadow it sees."""
    balls = {
        f"far{k}": {"type": "sphere", "exact": True, "center": [3.0 + k % 5, 3.0 + k // 5, 0.5], "radius": 0.3}
        for k in range(20)
    }
    near = {"type": "sphere", "exact": True, "center": [0.1, 0.0, 0.75], "radius": 0.4, "bsdf": diffuse(0.5)}
    light = panel((0.8, -0.8, 2.5), 0.4)
    return {"sensor": VIEW, "floor": floor(half=8.0), "shape": near, **balls, "light": light}


register({"exact, crowd": crowd})
#: They register scenes.
SCENES = (test_neuralsdf, test_sdfgrid, test_sdfgrid_cubic, test_tubes)
SILHOUETTES = "secondary_silhouette"


def batches(name: str, parameter: str, tangent, boundary, *, term: str = SILHOUETTES, depth=2, spp=16) -> np.ndarray:
    """Return independent estimates (BATCHES, 4, 4) of a boundary term's derivative image, summed over blocks."""
    scene, params = load(name)
    plan = psdr.plan(scene, names=[parameter], integrator=psdr.PathIntegrator(max_depth=depth, boundary=boundary))
    values = params[parameter].numpy().astype(np.float64)
    flat = np.zeros(scene.values.shape, np.float32)
    p = scene.parameters[parameter]
    flat[p.offset : p.offset + p.size] = tangent(values).reshape(-1)
    tangents = wp.array(flat, dtype=wp.float32)
    request = terms.Request(scene, plan, motion(scene, [parameter]), "forward", 0, spp, 0)
    found = []
    for seed in range(BATCHES):
        launched = terms.launches(terms.named(term), replace(request, seed=seed))
        out = launch_forward(scene, launched, tangents, (request.camera.crop_height, request.camera.crop_width))
        found.append(out.numpy().astype(np.float64).sum(axis=2).reshape(4, out.shape[0] // 4, 4, -1).sum(axis=(1, 3)))
    return np.array(found)


def assert_equal(a: np.ndarray, b: np.ndarray) -> None:
    """Assert that two sets of independent estimates have one mean, which is not zero."""
    spread = np.sqrt((a.var(axis=0, ddof=1) + b.var(axis=0, ddof=1)) / BATCHES)
    assert (np.abs(a.mean(axis=0)) > 4.0 * a.std(axis=0, ddof=1) / BATCHES**0.5).any()
    seen = spread > 0.0
    z = (a.mean(axis=0) - b.mean(axis=0))[seen] / spread[seen]
    assert np.abs(z).max() < MOST_SIGMAS and np.sqrt((z**2).mean()) < MOST_RMS


def radii(points):
    """All radii of curves grow."""
    r = 0.0 * points
    r[3::4] = 1.0
    return r


def guided(method) -> psdr.boundary.PathSpace:
    return psdr.boundary.PathSpace(guiding=method)


ROWS = [
    ("exact, three kinds", "tube.to_world", entry(0, 3), 2),
    ("exact cylinder, lamp", SHAPE, entry(2, 3), 2),
    ("exact disk, lamp", SHAPE, entry(0, 3), 2),
    ("exact disk, point", SHAPE, entry(0, 3), 2),
    ("exact cylinder, sun", SHAPE, entry(0, 3), 2),
    ("exact disk, sky", SHAPE, entry(0, 3), 3),
    ("exact, three kinds", "ball.to_world", entry(0, 3), 4),
    ("exact, wall", "ball.to_world", entry(0, 3), 4),
    ("exact, lamp", "light.vertex_positions", moved_light, 2),
]


def of_methods(found: list[tuple]) -> list:
    """Return rows by each method; the first with the k-d tree is fast."""
    products = list(itertools.product(found, SMALL))
    names = [f"{row[0]}, {row[1]}, depth {row[3]}-{method}" for row, method in products]
    marks = [[], *[[pytest.mark.slow]] * (len(products) - 1)]
    return [pytest.param(*row, m, id=n, marks=k) for (row, m), n, k in zip(products, names, marks, strict=True)]


@pytest.mark.slow_rows("exact, three kinds, tube.to_world, depth 2-kdtree")
@pytest.mark.parametrize(("name", "parameter", "tangent", "depth", "method"), of_methods(ROWS))
def test_guided_estimates_equal_others(name, parameter, tangent, depth, method) -> None:
    psdr.guiding.reset(load(name)[0])
    plain = batches(name, parameter, tangent, psdr.boundary.PathSpace(), depth=depth)
    assert_equal(plain, batches(name, parameter, tangent, guided(SMALL[method]), depth=depth))


@pytest.mark.slow
def test_it_lowers_the_variance_where_most_shapes_are_out_of_sight() -> None:
    case = ("exact, crowd", SHAPE, entry(0, 3))
    psdr.guiding.reset(load(case[0])[0])
    plain = batches(*case, psdr.boundary.PathSpace())
    found = batches(*case, guided(SMALL["kdtree"]))
    assert_equal(plain, found)
    assert found.var(axis=0).sum() < 0.1 * plain.var(axis=0).sum()


SURFACES = [
    ("grid, lamp", "body.grid", np.ones_like, 2, "secondary_grid"),
    ("cubic, lamp", "body.grid", np.ones_like, 2, "secondary_cubic"),
    ("network, lamp", "body.to_world", entry(0, 3), 2, "secondary_network"),
    ("helix tube, lamp", "body.control_points", radii, 2, "secondary_tubes"),
    ("helix cones, lamp", "body.control_points", radii, 2, "secondary_tubes"),
    ("grid, wall", "body.grid", np.ones_like, 4, "secondary_grid"),
    ("cubic, sky", "body.to_world", entry(0, 3), 2, "secondary_cubic"),
    ("helix tube, wall", "body.control_points", radii, 4, "secondary_tubes"),
    ("grid, point", "body.grid", np.ones_like, 2, "secondary_grid"),
    ("helix tube, sun", "body.to_world", entry(0, 3), 2, "secondary_tubes"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "parameter", "tangent", "depth", "term", "method"), of_methods(SURFACES))
def test_guided_estimates_on_grids_networks_and_curves_equal_others(
    name, parameter, tangent, depth, term, method
) -> None:
    psdr.guiding.reset(load(name)[0])
    options = {"term": term, "depth": depth}
    plain = batches(name, parameter, tangent, psdr.boundary.PathSpace(), **options)
    assert_equal(plain, batches(name, parameter, tangent, guided(SMALL[method]), **options))


@pytest.mark.slow
def test_masses_follow_voxels_that_come_and_go() -> None:
    """After a step of a fifth of a voxel the structure still serves, for other voxels, and is still right."""
    name, term = "grid, lamp", "secondary_grid"
    scene, params = load(name)
    before = params["body.grid"].numpy().copy()
    psdr.guiding.reset(scene)
    case = (name, "body.grid", np.ones_like)
    batches(*case, guided(SMALL["kdtree"]), term=term, spp=1)
    (kept,) = psdr.guiding.structures(scene)
    old = {t: i.names for t, i in kept.intervals.items()}
    try:
        params["body.grid"] = before - 0.2 / 23.0
        params.update()
        found = batches(*case, guided(SMALL["kdtree"]), term=term)
        assert kept.builds == 1
        for technique, intervals in kept.intervals.items():
            stay = np.isin(intervals.names, old[technique])
            assert 0.5 < stay.mean() < 1.0
        assert_equal(batches(*case, psdr.boundary.PathSpace(), term=term), found)
    finally:
        params["body.grid"] = before
        params.update()


@pytest.mark.slow
def test_the_modes_are_transposes_of_each_other() -> None:
    scene, params = load("exact, three kinds")
    psdr.guiding.reset(scene)
    options = {"integrator": psdr.PathIntegrator(max_depth=2, boundary=guided(SMALL["kdtree"])), "spp": 8}
    assert_transposes(scene, params, ["tube.to_world", "ball.to_world"], options)


@pytest.mark.slow
def test_workers_and_what_is_kept() -> None:
    scene, params = load("exact, three kinds")
    name, move = "tube.to_world", entry(2, 3)
    before = params[name].numpy().copy()
    case = (ROWS[0][0], name, ROWS[0][2], guided(SMALL["kdtree"]))
    results = []
    try:
        for workers in (1, 3):
            psdr.set_workers(workers)
            psdr.guiding.reset(scene)
            results.append(batches(*case, spp=1))
        np.testing.assert_array_equal(*results)
        (kept,) = psdr.guiding.structures(scene)
        evaluations = kept.evaluations
        assert kept.builds == 1 and kept.leaf_count > 256 and kept.guide.light.floor > 0.0
        np.testing.assert_array_equal(batches(*case, spp=1), results[0])
        assert kept.evaluations == evaluations
        for way, builds in ((0.005, 1), (2.0, 2)):
            params[name] = before + way * scene.radius * move(before)
            params.update()
            batches(*case, spp=1)
            assert kept.builds == builds and kept.evaluations > evaluations
            evaluations = kept.evaluations
    finally:
        psdr.set_workers(None)
        params[name] = before
        params.update()
