"""Line integrals of lobes, and the choice of silhouettes by trees: against quadrature and brute force."""

import functools

import numpy as np
import pytest
import trimesh
import warp as wp

import warp_psdr as psdr
from warp_psdr.kernels.boundary.edge_sampling.edge_tree import (
    EdgeTrees,
    edge_importance,
    make_choose,
    may_hold_silhouette,
)
from warp_psdr.kernels.boundary.edge_sampling.ltc_line import (
    Lobe,
    Lobes,
    line_integral,
    lobe_density,
    make_lobe,
    mixture_density,
    mixture_integral,
    sample_line,
    sample_mixture,
)
from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.kernels.math import any_tangent
from warp_psdr.kernels.rng import Sampler
from warp_psdr.kernels.structs import Scene
from warp_psdr.topology.edge_trees import edge_trees
from warp_psdr.topology.secondary_edges import secondary_edges

from .scenes import ball, box, camera, diffuse, mesh, sky

#: Significance of the tests, over all of their comparisons.
SIGNIFICANCE_SIGMAS = 4.5
#: Quadrature of float32 densities with 20,000 nodes, against float32 closed forms.
RELATIVE = 2e-3


@wp.kernel(module="unique", enable_backward=False)
def lines(
    z: wp.array(dtype=wp.vec3),
    scales: wp.array(dtype=wp.vec2),
    a: wp.array(dtype=wp.vec3),
    along: wp.array(dtype=wp.vec3),
    u: wp.array(dtype=wp.float32),
    integral_out: wp.array(dtype=wp.float32),
    fraction_out: wp.array(dtype=wp.float32),
):
    i = wp.tid()
    n = wp.normalize(z[i])
    lobe = make_lobe(n, any_tangent(n), scales[i][0], scales[i][1], 1.0)
    line = line_integral(lobe, a[i], along[i])
    integral_out[i] = line.integral
    if line.integral > 0.0:
        fraction_out[i] = sample_line(line, u[i])


@wp.kernel(module="unique", enable_backward=False)
def densities(lobe: Lobe, w: wp.array(dtype=wp.vec3), density_out: wp.array(dtype=wp.float32)):
    i = wp.tid()
    density_out[i] = lobe_density(lobe, w[i])


@wp.kernel(module="unique", enable_backward=False)
def mixture(
    lobes: Lobes,
    a: wp.vec3,
    along: wp.vec3,
    u: wp.array(dtype=wp.vec2),
    fraction_out: wp.array(dtype=wp.float32),
    ratio_out: wp.array(dtype=wp.float32),
):
    i = wp.tid()
    s = sample_mixture(lobes, a, along, u[i])
    p = a + s * along
    w = wp.normalize(p)
    q = mixture_density(lobes, w) * wp.length(wp.cross(along, w)) / wp.dot(p, p)
    fraction_out[i] = s
    ratio_out[i] = mixture_integral(lobes, a, along) / q


def axes(z):
    """The frame of ``any_tangent`` in double precision."""
    z = z / np.linalg.norm(z)
    sign = 1.0 if z[2] >= 0.0 else -1.0
    k = -1.0 / (sign + z[2])
    x = np.array([1.0 + sign * z[0] ** 2 * k, sign * z[0] * z[1] * k, -sign * z[0]])
    return x, np.cross(z, x), z


def integrand(z, scales, a, along, s):
    """q per fraction of the edge, from its definition."""
    x, y, z = axes(z)
    p = a + s[:, None] * along
    t = np.linalg.norm(p, axis=1)
    w = p / t[:, None]
    c = np.maximum(w @ z, 0.0)
    r2 = (w @ x / scales[0]) ** 2 + (w @ y / scales[1]) ** 2 + c**2
    density = c / (np.pi * scales[0] * scales[1] * np.maximum(r2, 1e-30) ** 2)
    return density * np.linalg.norm(np.cross(along, w), axis=1) / t**2


@pytest.mark.slow
def test_line_integrals_and_their_inversion_against_quadrature(device) -> None:
    random = np.random.default_rng(3)
    count = 200
    z = random.normal(size=(count, 3))
    scales = 10.0 ** random.uniform(-1.5, 0.0, (count, 2))
    a = random.normal(size=(count, 3))
    # From short edges far away to long ones that pass closely.
    along = random.normal(size=(count, 3)) * 10.0 ** random.uniform(-3.0, 1.0, (count, 1))
    u = random.uniform(0.02, 0.98, count)
    integral, fraction = (wp.zeros(count, dtype=wp.float32, device=device) for _ in range(2))
    inputs = [wp.array(v, dtype=t, device=device) for v, t in ((z, wp.vec3), (scales, wp.vec2), (a, wp.vec3))]
    inputs += [wp.array(along, dtype=wp.vec3, device=device), wp.array(u, dtype=wp.float32, device=device)]
    wp.launch(lines, dim=count, inputs=inputs, outputs=[integral, fraction], device=device)
    integral, fraction = integral.numpy(), fraction.numpy()
    nodes = (np.arange(20000) + 0.5) / 20000
    seen = 0
    for i in range(count):
        q = integrand(z[i], scales[i], a[i], along[i], nodes)
        expected = q.mean()
        floor = 1e-5 * min(np.linalg.norm(along[i]), 1.0)
        assert integral[i] == pytest.approx(expected, rel=RELATIVE, abs=floor), i
        if expected > 10.0 * floor:
            seen += 1
            below = np.interp(fraction[i], nodes + 0.5 / len(nodes), np.cumsum(q) / q.sum())
            assert below == pytest.approx(u[i], abs=RELATIVE), i
    assert 60 < seen < count  # some lie behind their lobe


@pytest.mark.slow
@pytest.mark.parametrize("scales", [(1.0, 1.0), (0.3, 0.1)])
def test_lobes_integrate_to_one(scales, device) -> None:
    n = 700
    # Finer towards the lobe's axis.
    t = (np.arange(n) + 0.5) / n
    cosine = 1.0 - 2.0 * t**3
    angle = 2.0 * np.pi * (np.arange(n) + 0.5) / n
    c, phi = (v.reshape(-1) for v in np.meshgrid(cosine, angle))
    sine = np.sqrt(1.0 - c**2)
    w = np.stack([sine * np.cos(phi), sine * np.sin(phi), c], axis=1)
    lobe = Lobe()
    lobe.x, lobe.y, lobe.z = wp.vec3(1.0, 0.0, 0.0), wp.vec3(0.0, 1.0, 0.0), wp.vec3(0.0, 0.0, 1.0)
    lobe.sx, lobe.sy = scales
    out = wp.zeros(len(w), dtype=wp.float32, device=device)
    inputs = [lobe, wp.array(w, dtype=wp.vec3, device=device)]
    wp.launch(densities, dim=len(w), inputs=inputs, outputs=[out], device=device)
    weight = np.tile(12.0 * np.pi * t**2, n)
    assert (weight * out.numpy()).mean() == pytest.approx(1.0, rel=RELATIVE)


def lobe(z, sx, sy, share):
    r = Lobe()
    x, y, n = axes(np.asarray(z, float))
    r.x, r.y, r.z = wp.vec3(*x), wp.vec3(*y), wp.vec3(*n)
    r.sx, r.sy, r.share = sx, sy, share
    return r


def three_lobes():
    r = Lobes()
    r.cosine = lobe((0.1, 0.2, 1.0), 1.0, 1.0, 0.3)
    r.glossy = lobe((0.7, -0.3, 0.6), 0.3, 0.15, 0.3)
    r.light = lobe((-0.2, 0.6, 0.9), 0.1, 0.1, 0.4)
    return r


def of_a_medium():
    r = Lobes()
    r.light, r.sphere = three_lobes().light, 0.6
    return r


@pytest.mark.parametrize(
    ("lobes", "a", "along"),
    [
        (three_lobes, (-0.8, 0.2, 0.7), (1.5, 0.3, 0.2)),
        (of_a_medium, (-0.8, 0.2, 0.7), (1.5, 0.3, 0.2)),
        (of_a_medium, (0.3, -0.2, -0.7), (1.5, 0.3, -2.0)),  # behind the light's lobe, and to one side
    ],
    ids=["surface", "medium", "medium, behind"],
)
def test_the_mixture_has_the_density_that_is_divided_by(lobes, a, along, device) -> None:
    count = 40000
    u = wp.array(np.random.default_rng(5).uniform(size=(count, 2)), dtype=wp.vec2, device=device)
    fraction, ratio = (wp.zeros(count, dtype=wp.float32, device=device) for _ in range(2))
    inputs = [lobes(), wp.vec3(*a), wp.vec3(*along), u]
    wp.launch(mixture, dim=count, inputs=inputs, outputs=[fraction, ratio], device=device)
    s, r = fraction.numpy().astype(np.float64), ratio.numpy().astype(np.float64)
    # E[g / pdf] is the integral of g over the fraction of the edge: moments of a uniform variable.
    for power in range(4):
        values = s**power * r
        error = values.std() / np.sqrt(count)
        assert abs(values.mean() - 1.0 / (power + 1)) < SIGNIFICANCE_SIGMAS * error
        assert error < 0.01


@functools.cache
def choosing(tree: bool):
    choose = make_choose(tree, 16)

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(
        scene: Scene,
        edges: Edges,
        trees: EdgeTrees,
        lobes: Lobes,
        x: wp.vec3,
        chosen_out: wp.array(dtype=wp.int32),
        scale_out: wp.array(dtype=wp.float32),
    ):
        i = wp.tid()
        sampler = Sampler()
        sampler.pixel = wp.uint32(i)
        chosen = choose(scene, edges, trees, lobes, x, sampler, 0)
        chosen_out[i] = chosen.edge
        scale_out[i] = chosen.scale

    return kernel


@wp.kernel(module="unique", enable_backward=False)
def weigh(
    scene: Scene,
    edges: Edges,
    trees: EdgeTrees,
    lobes: Lobes,
    x: wp.array(dtype=wp.vec3),
    importance_out: wp.array2d(dtype=wp.float32),
    held_out: wp.array2d(dtype=wp.int32),
):
    i, j = wp.tid()
    if j < importance_out.shape[1]:
        importance_out[i, j] = edge_importance(scene, edges, trees, lobes, x[i], j)
    if may_hold_silhouette(trees.nodes[j], x[i]):
        held_out[i, j] = 1


@functools.cache
def meshes():
    """A closed ball and an open sheet of triangles: edges of both trees."""
    sheet = trimesh.creation.icosphere(subdivisions=1)
    upper = sheet.faces[sheet.triangles_center[:, 2] > 0.3]
    return psdr.load_dict(
        {
            "type": "scene",
            "sensor": camera(),
            "sky": sky(),
            "ball": ball((0.3, 0.1, 1.0), 0.5, diffuse(0.5), subdivisions=2),
            "sheet": mesh(0.6 * np.asarray(sheet.vertices) + [-0.9, 0.2, 0.8], upper, diffuse(0.5), face_normals=True),
        }
    )


def prepared():
    scene = meshes()
    edges = secondary_edges(scene, {0})
    return scene, edges, edge_trees(scene, edges)


def test_trees_hold_every_edge_once() -> None:
    _scene, edges, trees = prepared()
    nodes, count = trees.nodes.numpy(), edges.cdf.shape[0] - 1
    leaves = nodes["left"] < 0
    np.testing.assert_array_equal(np.sort(-1 - nodes["left"][leaves]), np.arange(count))
    children = np.concatenate([nodes["left"][~leaves], nodes["right"][~leaves]])
    np.testing.assert_array_equal(np.sort(children), np.arange(1, len(nodes)))
    assert (np.diff(edges.first.numpy()) == 1).any() and (np.diff(edges.first.numpy()) == 2).any()


def test_no_silhouette_is_left_out_and_much_else_is() -> None:
    scene, edges, trees = prepared()
    nodes, count = trees.nodes.numpy(), edges.cdf.shape[0] - 1
    random = np.random.default_rng(4)
    x = np.concatenate([random.uniform(-2.0, 2.0, (200, 3)), random.normal(size=(50, 3)) * 20.0])
    # Also points on the surfaces, where planes pass through the point.
    triangles = scene.triangles.numpy()
    x = np.concatenate([x, (triangles["p0"] + triangles["p1"] + triangles["p2"])[::7] / 3.0])
    # And far away in these planes, where rounding decides.
    e1, e2 = triangles["p1"] - triangles["p0"], triangles["p2"] - triangles["p0"]
    far = random.uniform(-50.0, 50.0, (2, len(triangles), 1))
    x = np.concatenate([x, triangles["p0"] + far[0] * e1 + far[1] * e2])
    importance = wp.zeros((len(x), count), dtype=wp.float32)
    held = wp.zeros((len(x), len(nodes)), dtype=wp.int32)
    lobes = Lobes()
    # A lobe of every direction but one plane's.
    lobes.cosine = lobe((0.0, 0.0, 1.0), 1.0, 1.0, 1.0)
    lobes.light = lobe((0.0, 0.0, -1.0), 1.0, 1.0, 1.0)
    inputs = [scene.data(), edges, trees, lobes, wp.array(x, dtype=wp.vec3)]
    wp.launch(weigh, dim=(len(x), len(nodes)), inputs=inputs, outputs=[importance, held])
    silhouette, held = importance.numpy() > 0.0, held.numpy() > 0
    parent = np.full(len(nodes), -1)
    for side in ("left", "right"):
        inner = nodes["left"] >= 0
        parent[nodes[side][inner]] = np.flatnonzero(inner)
    for node in np.flatnonzero(nodes["left"] < 0):
        seen_from = silhouette[:, -1 - nodes["left"][node]]
        while parent[node] > 0:  # the root's own bounds are not asked
            assert held[seen_from, node].all()
            node = parent[node]
    leaves = nodes["left"] < 0
    assert silhouette.any(axis=1).all()
    assert held[:, leaves].mean() < 0.5  # most of what is no silhouette is left out


def test_from_a_face_no_edge_in_its_plane_is_a_silhouette() -> None:
    scene = psdr.load_dict(
        {
            "type": "scene",
            "sensor": camera(),
            "sky": sky(),
            "ball": ball((0.3, 0.1, 1.0), 0.5, diffuse(0.5), subdivisions=2),
            "box": box((-1.2, 0.2, 0.7), (0.3, 0.25, 0.3), diffuse(0.5), 0.3),
        }
    )
    edges = secondary_edges(scene, {0, 1})
    trees = edge_trees(scene, edges)
    triangles = scene.triangles.numpy()
    random = np.random.default_rng(7)
    # Points of faces, most of them close to a side: where roundings pass for a silhouette, it passes closely.
    near = 10.0 ** random.uniform(-5.0, -0.5, (50, len(triangles), 1))
    along = random.uniform(0.0, 1.0, (50, len(triangles), 1)) * (1.0 - near)
    p0, e1, e2 = triangles["p0"], triangles["p1"] - triangles["p0"], triangles["p2"] - triangles["p0"]
    x = np.roll([p0, p0 + e1, p0 + e2], random.integers(3), axis=0)
    x = x[0] + along * (x[1] - x[0]) + near * (x[2] - x[0])
    count = edges.cdf.shape[0] - 1
    lobes = Lobes()
    lobes.cosine = lobe((0.0, 0.0, 1.0), 1.0, 1.0, 0.5)
    lobes.light = lobe((0.0, 0.0, -1.0), 1.0, 1.0, 0.5)

    def weights(x: np.ndarray) -> np.ndarray:
        importance = wp.zeros((x.shape[0] * x.shape[1], count), dtype=wp.float32)
        held = wp.zeros((importance.shape[0], len(trees.nodes)), dtype=wp.int32)
        inputs = [scene.data(), edges, trees, lobes, wp.array(x.reshape(-1, 3), dtype=wp.vec3)]
        wp.launch(weigh, dim=held.shape, inputs=inputs, outputs=[importance, held])
        return importance.numpy().reshape(*x.shape[:2], count)

    # Edges with both ends in the plane of a face.
    ends = edges.points.numpy()
    height = np.abs(np.einsum("fk,ecfk->ecf", triangles["normal"], ends[:, :, None] - p0)).max(axis=1).T
    in_plane = height < 1e-5
    assert (in_plane.sum(axis=1) >= 3).all() and (in_plane.sum(axis=1) == 4).any()
    assert not weights(x)[:, in_plane].any()
    # Just above the face they are, but where that is in front of the next face, too.
    assert (weights(x + 1e-4 * triangles["normal"])[:, in_plane] > 0.0).mean() > 0.6


@pytest.mark.slow_rows("False")
@pytest.mark.parametrize("tree", [True, False])
def test_the_choice_has_the_probabilities_that_it_divides_by(tree) -> None:
    scene, edges, trees = prepared()
    count, samples = edges.cdf.shape[0] - 1, 200_000
    x = np.array([[0.1, -0.2, -0.4]])
    importance = wp.zeros((1, count), dtype=wp.float32)
    held = wp.zeros((1, len(trees.nodes)), dtype=wp.int32)
    inputs = [scene.data(), edges, trees, three_lobes(), wp.array(x, dtype=wp.vec3)]
    wp.launch(weigh, dim=(1, len(trees.nodes)), inputs=inputs, outputs=[importance, held])
    q = importance.numpy()[0].astype(np.float64)
    chosen, scale = wp.zeros(samples, dtype=wp.int32), wp.zeros(samples, dtype=wp.float32)
    inputs = [scene.data(), edges, trees, three_lobes(), wp.vec3(*x[0])]
    wp.launch(choosing(tree), dim=samples, inputs=inputs, outputs=[chosen, scale])
    chosen, scale = chosen.numpy(), scale.numpy().astype(np.float64)
    assert np.isin(chosen[chosen >= 0], np.flatnonzero(q > 0.0)).all()
    # For every silhouette e: E[scale 1[e] / Q(e)] = 1. Rare edges are left to the sum over all.
    taken = chosen[chosen >= 0]
    values = np.bincount(taken, scale[chosen >= 0] / q[taken], count) / samples
    squares = np.bincount(taken, (scale[chosen >= 0] / q[taken]) ** 2, count) / samples
    often = (q > 0.0) & (np.bincount(taken, minlength=count) >= 50)
    error = np.sqrt((squares - values**2) / samples)
    assert often.sum() > 20
    assert (np.abs(values - 1.0)[often] < SIGNIFICANCE_SIGMAS * error[often]).all()
    assert abs(scale.mean() - q.sum()) < SIGNIFICANCE_SIGMAS * scale.std() / np.sqrt(samples)
    if tree:  # 0.5; without it 2.0
        assert scale.std() < 0.7 * q.sum()
