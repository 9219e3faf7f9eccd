"""The wide BVH against ``wp.Mesh``, on random and adversarial rays, for every vector width."""

import functools

import numpy as np
import pytest
import warp as wp

from tests.rays.helpers import KINDS, MESHES, assert_same_hits, cube, make_rays, sphere, unit
from warp_psdr.kernels.bvh.wide import FLAT_PACKETS, WIDTHS, Accel, RayHit, make_intersect
from warp_psdr.scene.acceleration import REBUILD_FACTOR, Accelerator, host_width, set_ray_backend

#: Roundings of a distance or a barycentric coordinate between two ways of dividing, relative.
ROUNDING = 5.0e-7
FAR = 1.0e18


@functools.cache
def make_kernels(backend: str, width: int):
    closest_hit, any_hit = make_intersect(backend, width)

    @wp.kernel(module="unique", enable_backward=False)
    def query_kernel(
        # In:
        accel: Accel,
        origins: wp.array(dtype=wp.vec3),
        directions: wp.array(dtype=wp.vec3),
        t_max: wp.array(dtype=wp.float32),
        # Out:
        hits_out: wp.array(dtype=RayHit),
        any_out: wp.array(dtype=wp.bool),
    ):
        i = wp.tid()
        hits_out[i] = closest_hit(accel, origins[i], directions[i], t_max[i])
        any_out[i] = any_hit(accel, origins[i], directions[i], t_max[i])

    return query_kernel


class Tracer:
    """A mesh with one backend's acceleration structure."""

    def __init__(self, vertices, faces, backend="wide", width=None):
        self.points = wp.array(np.asarray(vertices, np.float32).reshape(-1, 3), dtype=wp.vec3, device="cpu")
        indices = wp.array(np.asarray(faces, np.int32).reshape(-1), dtype=wp.int32, device="cpu")
        self.accelerator = Accelerator(self.points, indices, "cpu", backend, width=width)
        self.kernel = make_kernels(backend, self.accelerator.width)

    def __call__(self, origins, directions, t_max=FAR):
        n = len(origins)
        limits = np.broadcast_to(np.asarray(t_max, np.float32), n)
        rays = [wp.array(np.asarray(a, np.float32), dtype=wp.vec3, device="cpu") for a in (origins, directions)]
        hits, found = wp.zeros(n, dtype=RayHit, device="cpu"), wp.zeros(n, dtype=wp.bool, device="cpu")
        inputs = [self.accelerator.data, *rays, wp.array(limits, dtype=wp.float32, device="cpu")]
        wp.launch(self.kernel, n, inputs, [hits, found], device="cpu")
        return hits.numpy(), found.numpy()


def test_the_comparison_notices_a_wrong_hit():
    vertices, faces = sphere()
    origins, directions = make_rays("random", vertices, faces, 1000)
    hits, _ = Tracer(vertices, faces)(origins, directions)
    i = np.nonzero(hits["face"] >= 0)[0][0]
    for change in ({"face": -1}, {"t": hits["t"][i] + 0.01}, {"t": 0.5 * hits["t"][i]}):
        wrong = hits.copy()
        for name, value in change.items():
            wrong[name][i] = value
        with pytest.raises(AssertionError, match="1 of 1000 rays differ"):
            assert_same_hits(vertices, faces, origins, directions, wrong, hits)


def compare(mesh, width, count, seed):
    vertices, faces = MESHES[mesh]()
    wide, warp = Tracer(vertices, faces, "wide", width), Tracer(vertices, faces, "warp")
    for kind in KINDS:
        origins, directions = make_rays(kind, vertices, faces, count, seed)
        hits, found = wide(origins, directions)
        reference, _ = warp(origins, directions)
        assert_same_hits(vertices, faces, origins, directions, hits, reference)
        assert (found == (hits["face"] >= 0)).all(), f"{kind}: any hit and closest hit disagree"


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("mesh", list(MESHES))
def test_same_hits_as_warp(mesh, width):
    compare(mesh, width, 10_000, 0)


@pytest.mark.slow
@pytest.mark.parametrize("mesh", list(MESHES))
def test_same_hits_as_warp_ten_million_rays(mesh):
    batches = 10
    for seed in range(batches):
        compare(mesh, host_width(), 10_000_000 // (len(MESHES) * len(KINDS) * batches) + 1, 100 + seed)


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("offset", [0.0, 1000.0])
@pytest.mark.parametrize("mesh", ["cube", "sphere"])
def test_nothing_leaks_out_of_a_closed_mesh(mesh, offset, width):
    vertices, faces = MESHES[mesh]() if mesh == "cube" else sphere(bumps=0.0)
    vertices = vertices + np.float32(offset)
    rng = np.random.default_rng(5)
    trace, count = Tracer(vertices, faces, "wide", width), 30_000
    origins = (offset + 0.3 * unit(rng.normal(size=(count, 3)))).astype(np.float32)
    corners = vertices[faces[rng.integers(len(faces), size=count)]]
    share = rng.choice([0.0, 0.25, 0.5, 1.0], (count, 1)).astype(np.float32)
    for target in (corners[:, 0], corners[:, 0] + share * (corners[:, 1] - corners[:, 0]), corners.mean(1)):
        hits, found = trace(origins, target - origins)
        assert found.all() and (hits["face"] >= 0).all()
    origins[:] = offset  # from the center along the axes, through vertices, edges and diagonals
    directions = rng.integers(-1, 2, (count, 3)).astype(np.float32)
    directions[(directions == 0).all(1)] = 1.0
    hits, found = trace(origins, directions)
    assert found.all() and (hits["face"] >= 0).all()


@pytest.mark.parametrize("backend", ["wide", "warp"])
@pytest.mark.parametrize("mesh", ["box36", "sphere"])
def test_barycentrics_give_the_hit_point(mesh, backend):
    vertices, faces = MESHES[mesh]()
    origins, directions = make_rays("random", vertices, faces, 5000)
    hits, _ = Tracer(vertices, faces, backend)(origins, directions)
    hits, origins, directions = (a[hits["face"] >= 0] for a in (hits, origins, directions))
    assert len(hits) > 1000
    u, v, corner = hits["u"][:, None], hits["v"][:, None], vertices[faces[hits["face"]]]
    point = (1.0 - u - v) * corner[:, 0] + u * corner[:, 1] + v * corner[:, 2]
    np.testing.assert_allclose(point, origins + hits["t"][:, None] * directions, atol=2.0e-5)  # float32 at size 3
    assert (hits["u"] >= -1e-6).all() and (hits["v"] >= -1e-6).all() and (hits["u"] + hits["v"] <= 1 + 1e-6).all()


@pytest.mark.parametrize("mesh", ["box36", "sphere"])
def test_largest_distance_is_respected(mesh):
    vertices, faces = MESHES[mesh]()
    trace = Tracer(vertices, faces)
    origins, directions = make_rays("random", vertices, faces, 5000)
    hits, _ = trace(origins, directions)
    keep = hits["face"] >= 0
    origins, directions, t = origins[keep], directions[keep], hits["t"][keep]
    for t_max, expected in ((t * (1.0 - ROUNDING), False), (t * (1.0 + ROUNDING), True)):
        hits, found = trace(origins, directions, t_max)
        assert (found == expected).all() and ((hits["face"] >= 0) == expected).all()
    longer, _ = trace(origins, 2.0 * directions)
    np.testing.assert_allclose(longer["t"], 0.5 * t, rtol=1e-5)  # distances count in lengths of the direction


@pytest.mark.parametrize("width", WIDTHS)
def test_degenerate_triangles_are_never_hit(width):
    rng = np.random.default_rng(2)
    ends = rng.integers(-8, 9, (300, 2, 3)).astype(np.float32)
    corners = np.stack([ends[:, 0], ends[:, 1], 0.5 * (ends[:, 0] + ends[:, 1])], 1)  # exact in float32
    corners[::3, 1:] = corners[::3, :1]
    trace = Tracer(corners, np.arange(900).reshape(-1, 3), "wide", width)
    origins = rng.integers(-8, 9, (2000, 3)) + 0.25
    target = corners[rng.integers(300, size=2000), rng.integers(3, size=2000)]
    for directions in (target - origins, rng.normal(size=(2000, 3))):
        hits, found = trace(origins, directions)
        assert not found.any() and (hits["face"] == -1).all() and np.isfinite(hits["t"]).all()


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("count", [3, 300])
def test_rays_that_are_no_rays_meet_nothing(width, count):
    """Without a direction, or not finite: such rays walked into the empty lanes of nodes, and the process died."""
    corners = np.random.default_rng(1).normal(size=(count, 3, 3)).astype(np.float32)
    trace = Tracer(corners, np.arange(3 * count).reshape(-1, 3), "wide", width)
    sound, broken = [0.0, 0.1, -0.2], [[np.nan] * 3, [0.0, np.nan, 0.0], [np.inf, 0.0, 0.0], [0.0, 0.0, -np.inf]]
    origins = np.array([*broken, *([sound] * 5)], np.float32)
    directions = np.array([*([sound] * 4), *broken, [0.0, 0.0, 0.0]], np.float32)
    hits, found = trace(origins, directions)
    assert not found.any() and (hits["face"] == -1).all()


@pytest.mark.parametrize("backend", ["wide", "warp"])
def test_empty_mesh_is_always_missed(backend):
    trace = Tracer(np.zeros((0, 3)), np.zeros((0, 3)), backend)
    hits, found = trace(np.zeros((4, 3)), np.eye(4, 3) + 0.1)
    assert (hits["face"] == -1).all() and not found.any()
    trace.accelerator.update()


@pytest.mark.parametrize("width", WIDTHS)
def test_sizes_around_packet_borders(width):
    rng = np.random.default_rng(4)
    for count in sorted({1, 2, width - 1, width, width + 1, *(FLAT_PACKETS * width + k for k in (-1, 0, 1, 2))}):
        corners = rng.normal(size=(count, 3, 3)).astype(np.float32)
        faces = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
        wide, warp = Tracer(corners, faces, "wide", width), Tracer(corners, faces, "warp")
        origins, directions = rng.normal(size=(2000, 3)), unit(rng.normal(size=(2000, 3)))
        hits = wide(origins, directions)[0]
        assert_same_hits(corners.reshape(-1, 3), faces, origins, directions, hits, warp(origins, directions)[0])


@pytest.mark.parametrize("width", WIDTHS)
def test_trees_that_no_heuristic_splits(width):
    """Equal centroids and sizes that fall by powers of two: the depth, hence the stack, stays bounded."""
    one = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], np.float32)
    same = np.tile(one, (3000, 1, 1))
    scales = 2.0 ** -np.repeat(np.arange(60), 30)
    shrinking = scales[:, None, None] * (one + np.array([0.0, 0.0, 1.0]))
    for corners in (same, shrinking):
        corners = corners.astype(np.float32)
        trace = Tracer(corners, np.arange(3 * len(corners)), "wide", width)
        hits, found = trace([[0.1, 0.1, 5.0], [2.0, 2.0, 5.0]], [[0.0, 0.0, -1.0], [0.0, 0.0, -1.0]])
        assert found.tolist() == [True, False]
        np.testing.assert_allclose(hits["t"][0], 5.0 - corners[0, 0, 2], rtol=1e-6)


@pytest.mark.parametrize("backend", ["wide", "warp"])
@pytest.mark.parametrize("amplitude", [0.01, 1.0])
def test_update_follows_moved_vertices(backend, amplitude):
    vertices, faces = sphere()
    trace = Tracer(vertices, faces, backend)
    rng = np.random.default_rng(6)
    moved = (vertices + amplitude * np.sin(3.0 * vertices[:, ::-1] + 1.0)).astype(np.float32)
    if amplitude == 1.0:
        moved = rng.permutation(moved)  # scrambled: a refitted tree would be useless
    trace.points.assign(moved)
    trace.accelerator.update()
    fresh = Tracer(moved, faces, backend)
    origins, directions = make_rays("random", moved, faces, 5000)
    assert_same_hits(moved, faces, origins, directions, trace(origins, directions)[0], fresh(origins, directions)[0])
    if backend == "wide":
        assert trace.accelerator.cost <= REBUILD_FACTOR * fresh.accelerator.cost


def test_update_follows_a_mesh_that_moves_far_away():
    vertices, faces = sphere()
    trace = Tracer(vertices, faces)
    moved = vertices + np.float32([3000.0, 0.0, -100.0])
    trace.points.assign(moved)
    trace.accelerator.update()
    origins, directions = make_rays("random", moved, faces, 5000)
    fresh = Tracer(moved, faces, "warp")
    assert_same_hits(moved, faces, origins, directions, trace(origins, directions)[0], fresh(origins, directions)[0])
    assert trace.accelerator.data.extent < 2.0  # bounds stay relative to the mesh's center


def test_degenerate_triangles_come_back_when_they_grow():
    vertices, faces = cube()
    trace = Tracer(np.zeros_like(vertices), faces)
    assert not trace([[0.0, 0.0, 0.0]], [[0.3, 0.2, 1.0]])[1][0]
    trace.points.assign(vertices)
    trace.accelerator.update()
    hits, _ = trace([[0.0, 0.0, 0.0]], [[0.3, 0.2, 1.0]])
    np.testing.assert_allclose(hits["t"], 1.0, rtol=1e-6)


def test_result_does_not_depend_on_the_width():
    vertices, faces = sphere()
    origins, directions = make_rays("random", vertices, faces, 20_000)
    hits = [Tracer(vertices, faces, "wide", width)(origins, directions)[0] for width in WIDTHS]
    for other in hits[1:]:  # the widest divides by way of an approximate reciprocal
        assert (other["face"] == hits[0]["face"]).all()
        for name in ("t", "u", "v"):
            np.testing.assert_allclose(other[name], hits[0][name], rtol=ROUNDING)


def test_memory():
    vertices, faces = sphere(100, 100)
    assert Tracer(vertices, faces).accelerator.nbytes <= 120 * len(faces)


def test_backend_switch():
    vertices, faces = cube()
    points = wp.array(vertices, dtype=wp.vec3, device="cpu")
    indices = wp.array(faces.reshape(-1), dtype=wp.int32, device="cpu")
    try:
        for name, expected in (("warp", "warp"), ("wide", "wide"), ("auto", "wide")):
            set_ray_backend(name)
            assert Accelerator(points, indices, "cpu").backend == expected
        with pytest.raises(ValueError, match="expected one of"):
            set_ray_backend("embree")
        with pytest.raises(ValueError, match="expected one of"):
            Accelerator(points, indices, "cpu", "embree")
        with pytest.raises(ValueError, match="expected one of"):
            Accelerator(points, indices, "cpu", "wide", width=5)
        with pytest.raises(ValueError, match="expected 'warp', or 'wide'"):
            make_intersect("wide", 5)
    finally:
        set_ray_backend("auto")
