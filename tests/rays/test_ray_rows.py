"""Rays of any directions in rows against the same rays traced one by one, for every vector width."""

import functools

import numpy as np
import pytest
import warp as wp

from tests.rays.helpers import KINDS, assert_same_hits, box36, cube, make_rays, soup
from warp_psdr.kernels.bvh.each import make_each
from warp_psdr.kernels.bvh.wide import WIDTHS, Accel, RayHit, make_intersect
from warp_psdr.kernels.lanes.lanes import make_fetch, make_record, stride_of, word_of, words
from warp_psdr.kernels.structs import Triangle
from warp_psdr.scene.acceleration import Accelerator, host_width

#: Of the processor's width; the others are slow.
each_width = pytest.mark.parametrize(
    "width", [pytest.param(w, marks=() if w == host_width() else pytest.mark.slow) for w in WIDTHS]
)

FAR = 1.0e18


@wp.struct
class Row:
    """A ray, whether it is traced, and what it finds."""

    o: wp.vec3
    d: wp.vec3
    t_max: wp.float32
    wanted: wp.int32
    hit: RayHit
    blocked: wp.int32


@functools.cache
def make_kernel(width):
    closest_hit, any_hit = make_intersect("wide", width)
    closest_of_each, any_of_each = make_each(width)
    get, put = make_record(Row, width)
    rows_of = {name: word_of(Row, name) for name in ("o", "wanted", "hit", "blocked")}
    size = (word_of(Row, "blocked") + 1) * width

    @wp.kernel(module="unique", enable_backward=False)
    def trace(
        # In:
        accel: Accel,
        values: wp.array(dtype=Row),
        # Out:
        single_out: wp.array(dtype=RayHit),
        single_any_out: wp.array(dtype=wp.int32),
        rows_out: wp.array(dtype=Row),
    ):
        rows = wp.zeros(shape=(wp.static(size),), dtype=wp.uint32)
        first = wp.tid() * wp.static(width)
        for i in range(wp.static(width)):
            ray = values[first + i]
            put(rows, 0, i, ray)
            single_out[first + i] = closest_hit(accel, ray.o, ray.d, ray.t_max)
            single_any_out[first + i] = wp.where(any_hit(accel, ray.o, ray.d, ray.t_max), 1, 0)
        o = wp.static(rows_of["o"])
        wanted = wp.static(rows_of["wanted"])
        closest_of_each(accel, rows, o, wanted, wp.static(rows_of["hit"]))
        any_of_each(accel, rows, o, wanted, wp.static(rows_of["blocked"]))
        for i in range(wp.static(width)):
            rows_out[first + i] = get(rows, 0, i, Row())

    return trace


def corner():
    """Return three sides of a cube."""
    vertices, faces = cube()
    return vertices, faces[:6]


def trace_both(vertices, faces, width, origins, directions, limits, wanted):
    """Return (hits, any) one by one, and the rows with what they found."""
    points = wp.array(vertices, dtype=wp.vec3, device="cpu")
    indices = wp.array(faces.reshape(-1), dtype=wp.int32, device="cpu")
    accelerator = Accelerator(points, indices, "cpu", "wide", width=width)
    assert accelerator.data.below_root > 0
    n = len(origins) // width * width
    values = np.zeros(n, Row.numpy_dtype())
    for name, column in (("o", origins), ("d", directions), ("t_max", limits), ("wanted", wanted)):
        values[name] = column[:n]
    out = [wp.zeros(n, dtype=dtype, device="cpu") for dtype in (RayHit, wp.int32, Row)]
    values_in = wp.array(values, dtype=Row, device="cpu")
    wp.launch(make_kernel(width), n // width, [accelerator.data, values_in], out, device="cpu")
    hits, found, rows = (a.numpy() for a in out)
    return values, hits, found, rows


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("width", "mesh"),
    [(4, corner), (4, soup), (8, corner), (8, cube), (8, box36), (8, soup), (16, cube), (16, box36), (16, soup)],
)
def test_rays_in_rows_meet_what_they_meet_alone(width, mesh, kind):
    vertices, faces = soup(width + 3) if mesh is soup else mesh()
    origins, directions = make_rays(kind, vertices, faces, 8000, 5)
    rng = np.random.default_rng(6)
    size = np.ptp(vertices, axis=0).max()
    limits = np.where(rng.random(8000) < 0.5, FAR, size * 10.0 ** rng.uniform(-2.0, 1.0, 8000))
    wanted = rng.random(8000) < 0.8
    rays, hits, found, rows = trace_both(vertices, faces, width, origins, directions, limits, wanted)
    on = rays["wanted"] == 1
    np.testing.assert_array_equal(rows["blocked"], np.where(on, found, 0))
    np.testing.assert_array_equal(rows["hit"]["t"], np.where(on, hits["t"], rays["t_max"]))
    assert (rows["hit"]["face"][~on] == -1).all()
    # At ties in a tree the order decides.
    same = on & (rows["hit"]["face"] == hits["face"])
    np.testing.assert_array_equal(rows["hit"][same], hits[same])
    assert_same_hits(vertices, faces, rays["o"][on], rays["d"][on], rows["hit"][on], hits[on])
    assert 0.0 < found[on].mean() < 1.0


@each_width
def test_rays_that_are_no_rays_meet_nothing(width):
    vertices, faces = corner()
    bad = np.array([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, 0]])
    origins, directions = np.zeros((3 * width, 3)), np.tile([0.0, 0.0, 1.0], (3 * width, 1))
    origins[::3] = bad[0]
    directions[1::3] = bad[1]
    directions[2::3] = bad[2]
    n = len(origins)
    _rays, hits, found, rows = trace_both(vertices, faces, width, origins, directions, np.full(n, FAR), np.ones(n))
    assert (hits["face"] == -1).all() and not found.any()
    assert (rows["hit"]["face"] == -1).all() and not rows["blocked"].any()
    np.testing.assert_array_equal(rows["hit"]["t"], np.float32(FAR))


@each_width
def test_rays_in_rows_follow_a_moved_mesh(width):
    vertices, faces = corner()
    points = wp.array(vertices, dtype=wp.vec3, device="cpu")
    accelerator = Accelerator(points, wp.array(faces.reshape(-1), dtype=wp.int32, device="cpu"), "cpu", width=width)
    values = np.zeros(width, Row.numpy_dtype())
    values["o"], values["d"], values["t_max"], values["wanted"] = [-5.0, 0.1, 0.2], [1.0, 0.0, 0.0], FAR, 1
    for shift in (0.0, 2.0):
        points.assign(vertices + np.float32([shift, 0.0, 0.0]))
        accelerator.update()
        out = [wp.zeros(width, dtype=dtype, device="cpu") for dtype in (RayHit, wp.int32, Row)]
        wp.launch(
            make_kernel(width), 1, [accelerator.data, wp.array(values, dtype=Row, device="cpu")], out, device="cpu"
        )
        np.testing.assert_allclose(out[2].numpy()["hit"]["t"], 4.0 + shift, rtol=1.0e-6)


@each_width
def test_records_are_fetched_into_lanes(width):
    fetch = make_fetch(Triangle, width, words(Triangle))
    get, _put = make_record(Triangle, width)
    _get, put_index = make_record(RayHit, width)
    size = 20 * width

    @wp.kernel(module="unique", enable_backward=False)
    def fetch_all(records: wp.array(dtype=Triangle), index: wp.array(dtype=RayHit), out: wp.array(dtype=Triangle)):
        rows = wp.zeros(shape=(wp.static(size),), dtype=wp.uint32)
        for j in range(wp.static(width)):
            put_index(rows, 16, j, index[j])
        fetch(records, rows, 19, 0)
        for j in range(wp.static(width)):
            out[j] = get(rows, 0, j, Triangle())

    rng = np.random.default_rng(4)
    raw = rng.integers(-(2**31), 2**31, size=(50, 16)).astype(np.int32)
    index = np.zeros(width, RayHit.numpy_dtype())
    index["face"] = rng.integers(0, 50, width)
    index["face"][1] = -1
    records = wp.array(raw.view(Triangle.numpy_dtype()).reshape(50), dtype=Triangle, device="cpu")
    out = wp.zeros(width, dtype=Triangle, device="cpu")
    wp.launch(fetch_all, 1, [records, wp.array(index, dtype=RayHit, device="cpu")], [out], device="cpu")
    np.testing.assert_array_equal(out.numpy().view(np.int32).reshape(width, 16), raw[np.maximum(index["face"], 0)])


@each_width
def test_records_of_any_number_of_words_are_fetched(width):
    """No row behind the last one is written."""
    count, stride = 6, stride_of(6)
    fetch = make_fetch(wp.uint32, width, count)

    @wp.kernel(module="unique", enable_backward=False)
    def fetch_some(records: wp.array(dtype=wp.uint32), rows: wp.array(dtype=wp.uint32)):
        fetch(records, rows, count + 1, 0)

    rng = np.random.default_rng(4)
    raw = rng.integers(0, 2**32, size=(50, stride)).astype(np.uint32)
    rows = np.zeros((count + 2, width), np.uint32)
    rows[-1] = numbers = rng.integers(0, 50, width)
    out = wp.array(rows.reshape(-1), dtype=wp.uint32, device="cpu")
    wp.launch(fetch_some, 1, [wp.array(raw.reshape(-1), dtype=wp.uint32, device="cpu")], [out], device="cpu")
    rows[:count] = raw[numbers, :count].T
    np.testing.assert_array_equal(out.numpy().reshape(rows.shape), rows)
