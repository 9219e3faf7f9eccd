"""Rays that are traced together against the same rays traced one by one, for every vector width."""

import functools
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.rays.helpers import KINDS, MESHES, assert_same_hits, make_rays, unit
from warp_psdr.kernels.bvh.bundle import make_bundle, make_together
from warp_psdr.kernels.bvh.wide import WIDTHS, Accel, AnyHit, Ray, RayHit, make_intersect
from warp_psdr.kernels.lanes.lanes import make_record, words
from warp_psdr.scene.acceleration import Accelerator, host_width

#: Of the processor's width; the others are slow.
each_width = pytest.mark.parametrize(
    "width", [pytest.param(w, marks=() if w == host_width() else pytest.mark.slow) for w in WIDTHS]
)

SCENE = Path(__file__).resolve().parents[2] / "scenes" / "cornell_box.xml"
FAR = 1.0e18
#: Root mean square of an image's difference between ray queries that round differently, relative to its mean.
ROUNDING = 1.0e-5
#: Share of the diameter, or of the direction's length, by which the rays of a bundle differ.
SPREADS = (0.0, 1.0e-5, 1.0e-3, 0.1)


@functools.cache
def make_kernel(width):
    closest_hit, any_hit = make_intersect("wide", width)
    closest_hits, any_hits = make_bundle(width)
    closest_together, any_together = make_together(width)
    _get_ray, put_ray = make_record(Ray, width)
    get_hit, _put_hit = make_record(RayHit, width)
    get_any, _put_any = make_record(AnyHit, width)
    hit_row = words(Ray)
    any_row = hit_row + words(RayHit)
    size = (any_row + words(AnyHit)) * width

    @wp.kernel(module="unique", enable_backward=False)
    def trace(
        # In:
        accel: Accel,
        rays: wp.array(dtype=Ray),
        # Out:
        single_out: wp.array(dtype=RayHit),
        single_any_out: wp.array(dtype=wp.bool),
        hits_out: wp.array(dtype=RayHit),
        any_out: wp.array(dtype=wp.bool),
        together_out: wp.array(dtype=wp.bool),
    ):
        rows = wp.zeros(shape=(wp.static(size),), dtype=wp.uint32)
        first = wp.tid() * wp.static(width)
        for i in range(wp.static(width)):
            ray = rays[first + i]
            put_ray(rows, 0, i, ray)
            single_out[first + i] = closest_hit(accel, ray.o, ray.d, ray.t_max)
            single_any_out[first + i] = any_hit(accel, ray.o, ray.d, ray.t_max)
        together = closest_together(accel, rows, 0, hit_row)
        together_out[wp.tid()] = together and any_together(accel, rows, 0, any_row)
        closest_hits(accel, rows, 0, hit_row)
        any_hits(accel, rows, 0, any_row)
        for i in range(wp.static(width)):
            hits_out[first + i] = get_hit(rows, hit_row, i, RayHit())
            any_out[first + i] = get_any(rows, any_row, i, AnyHit()).hit != 0

    return trace


def trace_both(vertices, faces, width, origins, directions, limits):
    """Return (hits, any) one by one, (hits, any) in bundles, and which bundles were traced together."""
    points = wp.array(np.asarray(vertices, np.float32).reshape(-1, 3), dtype=wp.vec3, device="cpu")
    indices = wp.array(np.asarray(faces, np.int32).reshape(-1), dtype=wp.int32, device="cpu")
    accelerator = Accelerator(points, indices, "cpu", "wide", width=width)
    n = len(origins)
    rays = np.zeros(n, Ray.numpy_dtype())
    rays["o"], rays["d"], rays["t_max"] = origins, directions, limits
    inputs = [accelerator.data, wp.array(rays, dtype=Ray, device="cpu")]
    sizes = [(n, RayHit), (n, wp.bool), (n, RayHit), (n, wp.bool), (n // width, wp.bool)]
    out = [wp.zeros(size, dtype=dtype, device="cpu") for size, dtype in sizes]
    wp.launch(make_kernel(width), n // width, inputs, out, device="cpu")
    hits, found, hits_together, found_together, together = (a.numpy() for a in out)
    return (hits, found), (hits_together, found_together), together


def assert_equal(vertices, faces, origins, directions, alone, together):
    """Check that bundles change nothing: not a bit of distances and barycentrics, and faces at ties alone."""
    (hits, found), (bundled, bundled_found) = alone, together
    np.testing.assert_array_equal(bundled_found, found)
    np.testing.assert_array_equal(bundled["t"], hits["t"])
    same = bundled["face"] == hits["face"]
    np.testing.assert_array_equal(bundled[same], hits[same])
    assert_same_hits(vertices, faces, origins, directions, bundled, hits)


def bundles_of(kind, vertices, faces, width, count, seed, spread):
    """Return rays in groups of ``width``, each around one ray of a family."""
    origins, directions = make_rays(kind, vertices, faces, count, seed)
    rng = np.random.default_rng(seed + 1)
    size = np.ptp(vertices, axis=0).max()
    origins, directions = np.repeat(origins, width, 0), np.repeat(directions, width, 0)
    origins += spread * size * rng.uniform(-1.0, 1.0, origins.shape) * rng.integers(0, 2, (len(origins), 1))
    directions += spread * rng.uniform(-1.0, 1.0, directions.shape)
    # Distances on either side of what is hit, and none at all.
    limits = np.where(rng.random(len(origins)) < 0.5, FAR, size * 10.0 ** rng.uniform(-2.0, 1.0, len(origins)))
    return origins, directions, np.where(rng.random(len(origins)) < 0.02, 0.0, limits)


def compare(mesh, width, count, seed):
    vertices, faces = MESHES[mesh]()
    for kind in KINDS:
        for spread in SPREADS:
            rays = bundles_of(kind, vertices, faces, width, count, seed, spread)
            alone, bundled, together = trace_both(vertices, faces, width, *rays)
            assert_equal(vertices, faces, *rays[:2], alone, bundled)
            if spread <= SPREADS[1] and kind != "axis":  # else nothing is tested; zeros have two signs
                assert together.mean() > 0.2
            assert 0.0 < bundled[1].mean() < 1.0


@each_width
@pytest.mark.parametrize("mesh", list(MESHES))
def test_bundles_meet_what_their_rays_meet(mesh, width):
    compare(mesh, width, 600, 0)


@pytest.mark.slow
@pytest.mark.parametrize("mesh", list(MESHES))
def test_bundles_meet_what_their_rays_meet_ten_million_times(mesh):
    batches = 10
    width = host_width()
    for seed in range(batches):
        compare(mesh, width, 10_000_000 // (len(MESHES) * len(KINDS) * len(SPREADS) * batches * width) + 1, 100 + seed)


@each_width
@pytest.mark.parametrize("mesh", ["box36", "sphere", "far_sphere"])
@pytest.mark.parametrize("light", ["lamp", "sun"])
def test_shadow_rays_to_one_light(mesh, width, light):
    """Those to a lamp are followed from there, where they are close together; those to a sun have no end."""
    vertices, faces = MESHES[mesh]()
    rng = np.random.default_rng(7)
    low, high = vertices.min(0).astype(np.float64), vertices.max(0).astype(np.float64)
    size, count = (high - low).max(), 1000
    points = np.repeat(rng.uniform(low, high, (count, 3)), width, 0)
    points += 0.05 * size * rng.uniform(-1.0, 1.0, points.shape)
    if light == "lamp":
        lamp = 0.5 * (low + high) + size * np.array([0.4, 0.7, 1.1])
        lamps = np.repeat(lamp + 1.0e-3 * size * rng.uniform(-1.0, 1.0, (count, 3)), width, 0)
        rays = points, lamps - points, np.full(len(points), 0.999)
    else:
        rays = points, np.tile([[0.3, 0.2, -0.8]], (len(points), 1)), np.full(len(points), FAR)
    alone, bundled, together = trace_both(vertices, faces, width, *rays)
    assert_equal(vertices, faces, *rays[:2], alone, bundled)
    assert together.mean() > 0.3 and 0.1 < bundled[1].mean() < 0.99


@each_width
@pytest.mark.parametrize("distance", [1.0e2, 1.0e3, 1.0e4])
def test_shadow_rays_to_a_distant_lamp(distance, width):
    """Blockers are found behind vertices, on borders of boxes, where the rounding of the lamp's place counts."""
    vertices, faces = MESHES["sphere"]()
    rng = np.random.default_rng(8)
    count = 2000
    lamp = distance * unit(rng.normal(size=(count, 3)))
    corner = vertices[rng.integers(len(vertices), size=count)]
    start = corner + rng.uniform(0.01, 0.3, (count, 1)) * unit(corner - lamp)
    aside = np.zeros((count, width, 3))
    aside[np.arange(count), :, rng.integers(3, size=count)] = np.arange(width) * max(5.0e-6 * distance, 1.0e-3)
    points = (start[:, None] + aside).reshape(-1, 3)
    rays = points, np.repeat(lamp, width, 0) - points, np.full(len(points), 0.999)
    alone, bundled, together = trace_both(vertices, faces, width, *rays)
    assert_equal(vertices, faces, *rays[:2], alone, bundled)
    assert together.mean() > 0.3 and 0.3 < bundled[1].mean() <= 1.0


@each_width
def test_ties_without_a_tree(width):
    """Every triangle twice, in any order: alone or together, a ray meets the same one of the two."""
    rng = np.random.default_rng(9)
    corners = np.repeat(rng.uniform(-1.0, 1.0, (width + 1, 3, 3)), 2, 0)[rng.permutation(2 * width + 2)]
    faces = np.arange(corners.size // 3).reshape(-1, 3)
    origins, directions = rng.uniform(-1.0, 1.0, (2000, 3)), unit(rng.normal(size=(2000, 3)))
    rays = np.repeat(origins, width, 0), np.repeat(directions, width, 0) + 1.0e-3 * rng.normal(size=(2000 * width, 3))
    alone, bundled, together = trace_both(corners.reshape(-1, 3), faces, width, *rays, FAR)
    np.testing.assert_array_equal(bundled[0], alone[0])
    assert together.mean() > 0.5 and bundled[1].mean() > 0.1


@each_width
def test_an_end_beyond_all_floats(width):
    """In the middle of a bundle whose other ends are close together."""
    vertices, faces = MESHES["sphere"]()
    origins = np.stack([np.linspace(-0.5, 0.5, width), np.full(width, 0.1), np.full(width, -3.0)], -1)
    directions = np.array([0.6, 0.7, 3.0]) - origins
    directions[1] *= 4.0
    limits = np.where(np.arange(width) == 1, 3.0e38, 1.0)
    alone, bundled, _together = trace_both(vertices, faces, width, origins, directions, limits)
    assert_equal(vertices, faces, origins, directions, alone, bundled)


@each_width
def test_rays_that_are_no_rays_disturb_no_others(width):
    vertices, faces = MESHES["sphere"]()
    origins, directions = make_rays("random", vertices, faces, 200)
    origins, directions = np.repeat(origins, width, 0), np.repeat(directions, width, 0)
    broken = [[np.nan, 0.0, 1.0], [np.inf, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, -np.inf, np.nan]]
    for group in range(100):
        directions[group * width + group % width] = broken[group % len(broken)]
        origins[(100 + group) * width + group % width] = broken[group % 2]
    alone, bundled, together = trace_both(vertices, faces, width, origins, directions, FAR)
    for one, other in zip(alone, bundled, strict=True):
        np.testing.assert_array_equal(one, other)
    assert not together.any()
    assert alone[1].mean() > 0.1


@each_width
def test_an_empty_mesh_is_missed(width):
    nothing = np.zeros((0, 3))
    rays = np.zeros((2 * width, 3)), np.full((2 * width, 3), 0.1), FAR
    alone, bundled, _together = trace_both(nothing, nothing, width, *rays)
    assert (bundled[0]["face"] == -1).all() and not bundled[1].any() and not alone[1].any()


@pytest.mark.parametrize("spp", [1, 3, 19])
def test_images_are_those_of_single_rays(spp):
    """Any number of samples, a multiple of the lanes or not; the other backend traces one ray at a time."""
    images = []
    try:
        for backend in ("wide", "warp"):
            psdr.set_ray_backend(backend)
            scene = psdr.load_file(SCENE, resolution=24)
            images.append(psdr.render(scene, spp=spp, seed=3).numpy())
    finally:
        psdr.set_ray_backend("auto")
    assert images[0].mean() > 0.01
    assert np.sqrt(np.mean((images[0] - images[1]) ** 2)) < ROUNDING * images[0].mean()


def test_neighbours_are_traced_together():
    """What a camera sends through one pixel."""
    vertices, faces = MESHES["sphere"]()
    width = host_width()
    rng = np.random.default_rng(3)
    target = np.repeat(rng.uniform(-0.5, 0.5, (500, 3)), width, 0) + 2.0e-3 * rng.normal(size=(500 * width, 3))
    origins = np.tile([[0.3, 0.2, 4.0]], (len(target), 1))
    _alone, _bundled, together = trace_both(vertices, faces, width, origins, unit(target - origins), FAR)
    assert together.mean() > 0.9
