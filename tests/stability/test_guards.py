"""Guards of device functions, called where each is needed: without it, what comes out is not finite, or wrong.

Guards of what is differentiated stand in ``test_singular.py``, those of scattering models in ``tests/bsdf``,
those of samples that are not finite in ``tests/estimate/test_invalid.py``.
"""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.config_helpers import SIMPLE, changed, materials
from warp_psdr.kernels.boundary.detector import Walk, make_walk
from warp_psdr.kernels.boundary.edge_sampling.edge_tree import EdgeNode, lobe_estimate, node_importance
from warp_psdr.kernels.boundary.edge_sampling.ltc_line import (
    Lobes,
    line_integral,
    make_lobe,
    make_scattering_lobes,
    sample_line,
)
from warp_psdr.kernels.boundary.guiding.projective import nearest_fraction
from warp_psdr.kernels.boundary.guiding.stripe import CORNERS, Polygon, Stripe, cut, stripe_point, stripe_square
from warp_psdr.kernels.boundary.local_form import barycentrics_at
from warp_psdr.kernels.boundary.path_space.direction import Wedge, pdf_wedge, wedge_direction, wedge_square
from warp_psdr.kernels.boundary.specular.chain_edges import curve_crossing
from warp_psdr.kernels.boundary.specular.ray_differential import (
    PointDifferential,
    RayDifferential,
    scattered_differential,
)
from warp_psdr.kernels.boundary.specular.specular_chain import Block, Link
from warp_psdr.kernels.bsdf.microfacet import make_microfacet
from warp_psdr.kernels.constants import LOBE_DELTA_TRANSMISSION, TEXTURE_CONSTANT
from warp_psdr.kernels.emitter.area import area_density, make_area, pdf_area
from warp_psdr.kernels.emitter.spot import falloff
from warp_psdr.kernels.interaction import Frame, make_interaction
from warp_psdr.kernels.interior.factors.pullback import connection_vjp
from warp_psdr.kernels.interior.factors.tangents import log_geometry_jvp, make_frame_jvp
from warp_psdr.kernels.math import any_tangent
from warp_psdr.kernels.sampling import square_to_cosine_hemisphere
from warp_psdr.kernels.structs import Camera, Scene, Triangle
from warp_psdr.kernels.surface import interpolate, length_of_normals, normalize_vjp, unit_normal
from warp_psdr.kernels.vertex_motion import VertexTangent, normalize_jvp

from .sweeps import room

SAMPLE_VISIBLE = make_microfacet("ggx").sample_visible
DRAW_LIGHT = make_area((TEXTURE_CONSTANT,)).sample_point
METAL = changed(SIMPLE, **materials("roughconductor (ggx)"))
INTERACTION = make_interaction(METAL.surfaces, METAL.lights).record
SCATTERING_LOBES = make_scattering_lobes(METAL.surfaces, METAL.lights)
FRAME_JVP = make_frame_jvp(True)


@wp.func
def size(v: wp.vec3) -> wp.float32:
    """Sum of absolute values; NaN and infinity stay."""
    return wp.abs(v[0]) + wp.abs(v[1]) + wp.abs(v[2])


@wp.kernel(module="unique", enable_backward=False)
def guards(scene: Scene, zero: wp.vec3, out: wp.array(dtype=wp.float32)):
    """One number a guard; ``zero`` is not known to the compiler."""
    nil = zero[0]
    x = wp.vec3(1.0, nil, nil)
    y = wp.vec3(nil, 1.0, nil)
    z = wp.vec3(nil, nil, 1.0)
    # Vertex normals that cancel: the fallback.
    sum_of_normals = interpolate(x, -x, nil * x, 0.5, 0.0)
    out[0] = size(unit_normal(sum_of_normals, length_of_normals(sum_of_normals), z) - z)
    # A connection of no length has no direction that could turn.
    out[1] = size(normalize_vjp(zero, nil, x))
    out[2] = size(normalize_jvp(zero, nil, x))
    out[3] = wp.abs(log_geometry_jvp(z, x, x, y, 1.0))  # in the plane of its light
    link = connection_vjp(zero, zero, z, x, x, 1.0, 1.0)
    out[4] = size(link.x) + size(link.c)
    link = connection_vjp(zero, x, z, x, nil * x, 1.0, 1.0)
    out[5] = size(link.x) + size(link.c)
    link = connection_vjp(zero, x, zero, x, nil * x, 1.0, 1.0)
    out[6] = size(link.x) + size(link.c)
    # A triangle without an area.
    flat = Triangle()
    flat.p1 = x
    flat.p2 = x
    out[7] = wp.length(barycentrics_at(flat, x))
    # A wedge without a width, and its ends.
    wedge = Wedge()
    wedge.t = x
    wedge.a = y
    wedge.b = z
    out[8] = 0.0 * pdf_wedge(wedge)
    out[9] = wp.abs(size(wedge_direction(wedge, wp.vec2(1.0 + 1.2e-7, nil))) - 1.0)
    # A spot light's falloff of no width: a step.
    out[10] = wp.abs(falloff(-z, z, 20.0, 20.0 + nil) - 1.0) + falloff(-z, wp.normalize(x + z), 20.0, 20.0 + nil)
    # A segment that runs along the line it is nearest to.
    out[11] = wp.abs(nearest_fraction(x, 3.0 * x, y, x) - 0.5)
    # A light that is met in its plane, at once; a face of it without an area.
    out[12] = 0.0 * pdf_area(scene, scene.emitters[0], scene.emitters[0].first_face, x, nil)
    out[17] = area_density(scene, scene.emitters[0], scene.emitters[0].first_face + 1)
    corner = scene.triangles[scene.emitters[0].first_face].p0
    face = scene.emitters[0].first_face
    u = wp.vec2(zero[1], zero[2])
    out[18] = DRAW_LIGHT(scene, scene.emitters[0], face, scene.triangles[face], corner, u).pdf
    # An edge that points at the one who sees it, behind a lobe and in it.
    lobe = make_lobe(z, x, 1.0, 1.0, 1.0)
    end_on = line_integral(lobe, z, z)
    out[13] = end_on.integral + 0.0 * (end_on.psi + end_on.u_z + end_on.w_z + end_on.reach)
    # A mirror direction along the normal: the lobe has any axes.
    metal = INTERACTION()
    metal.material.alpha_u = 0.1
    metal.material.alpha_v = 0.1
    frame = Frame()
    frame.n = z
    frame.s = x
    frame.t = y
    metal.frame = frame
    metal.wi = z
    lobes = SCATTERING_LOBES(metal)
    out[14] = wp.abs(wp.length(lobes.glossy.x) - 1.0)
    # An edge around the one who sees it: a node that is no farther away than it is large.
    node = EdgeNode()
    node.center = 1.0e-20 * z
    node.half = z
    node.n_half = wp.vec3(1.0, 1.0, 1.0)
    node.d_low = -2.0
    node.d_high = 2.0
    node.weight = 1.0
    both = Lobes()
    both.cosine = lobe
    out[15] = 0.0 * node_importance(node, both, zero)
    # A ray at the critical angle.
    glass = Link()
    glass.lobe = LOBE_DELTA_TRANSMISSION
    glass.n = z
    glass.eta = 1.0
    ray = RayDifferential()
    out[16] = size(scattered_differential(glass, x, ray, PointDifferential()).d)
    # The stripe of an edge that is a silhouette for no point of a light.
    stripe = Stripe()
    stripe.above.count = 3
    stripe.below.count = 3
    at = stripe_point(stripe, wp.float64(nil), wp.float64(0.5))
    out[19] = wp.abs(at[0]) + wp.abs(at[1])
    at = stripe_square(stripe, nil, nil)
    out[20] = wp.abs(at[0]) + 0.0 * at[1]
    # A stripe whose fan begins with a triangle without an area: the place of a point in its second one.
    m = CORNERS()
    m[2, 1] = 1.0
    m[3, 0] = 1.0
    stripe.above.count = 4
    stripe.above.corners = m
    stripe.above.area = 1.0
    stripe.below.count = 0
    stripe.share = 1.0
    at = stripe_square(stripe, 0.2, 0.3)
    at = stripe_point(stripe, wp.float64(at[0]), wp.float64(at[1]))
    out[21] = wp.abs(at[0] - 0.2) + wp.abs(at[1] - 0.3)
    # Corners that rounding puts on alternate sides of a line: no more than there is room for.
    crossed = Polygon()
    crossed.count = 5
    m[0, 0] = 1.0
    m[1, 0] = -1.0
    m[2, 0] = 1.0
    m[3, 0] = -1.0
    m[4, 0] = 1.0
    crossed.corners = m
    out[22] = wp.float32(wp.max(cut(crossed, x, 1.0).count - 5, 0))
    crossed = cut(crossed, y, 1.0)
    out[22] += wp.float32(wp.max(crossed.count - 5, 0))
    # A tangent along the normal does not turn: what reverse mode makes of it.
    vertex = VertexTangent()
    vertex.n = x
    vertex.tangent = y
    out[23] = size(FRAME_JVP(frame, 2.0 * z, vertex).s)
    # A lobe of a mirror's width: all of an edge across it is in it.
    metal.material.alpha_u = nil
    metal.material.alpha_v = nil
    lobes = SCATTERING_LOBES(metal)
    out[24] = wp.where(line_integral(lobes.glossy, z - x, 2.0 * x).integral > 1.0, 0.0, 1.0)
    # A direction in the plane of a wedge without a width is not in it.
    out[25] = wp.abs(wedge_square(wedge, y)[1] - 2.0)
    # A cone straight behind a lobe, by a rounding more than that.
    out[26] = lobe_estimate(lobe, -1.0000001 * z, 0.6, 0.8)
    # Two triangles in one plane do not meet in a curve.
    block = Block()
    block.film = 1
    one = Link()
    one.face = scene.emitters[0].first_face
    one.x = z
    one.ng = z
    other = Link()
    other.face = one.face
    other.x = z
    other.ng = -z
    out[27] = wp.float32(curve_crossing(scene, block, one, other, x, ray, ray, 0, 1, 0, False).valid)


@wp.kernel(module="unique", enable_backward=False)
def lines(
    z: wp.array(dtype=wp.vec3),
    scale: wp.array(dtype=wp.float32),
    a: wp.array(dtype=wp.vec3),
    along: wp.array(dtype=wp.vec3),
    u: wp.array(dtype=wp.float32),
    out: wp.array(dtype=wp.vec3),
):
    """A lobe's integral over an edge, a fraction of the edge drawn by it, and the part of the integral up to there."""
    i = wp.tid()
    lobe = make_lobe(z[i], any_tangent(z[i]), scale[i], scale[i], 1.0)
    line = line_integral(lobe, a[i], along[i])
    s = wp.float32(0.0)
    part = wp.float32(0.0)
    if line.integral > 0.0:
        s = sample_line(line, u[i])
        part = line_integral(lobe, a[i], s * along[i]).integral / line.integral
    out[i] = wp.vec3(line.integral, s, part)


@wp.kernel(module="unique", enable_backward=False)
def rims(u: wp.array(dtype=wp.float32), out: wp.array(dtype=wp.float32)):
    """Sums over warps of points of the unit square's sides."""
    i = wp.tid()
    for k in range(4):
        end = wp.where(k % 2 == 0, 0.0, 0.99999994)
        v = wp.vec2(u[i], end)
        if k > 1:
            v = wp.vec2(end, u[i])
        out[i] = out[i] + size(square_to_cosine_hemisphere(v)) + size(SAMPLE_VISIBLE(wp.vec3(0.0, 0.0, 1.0), v))


NAMES = (
    "normals that cancel", "normalize_vjp", "normalize_jvp", "light in its plane, forward", "no connection",
    "light in its plane, reverse", "light without an area", "flat triangle", "wedge without a width",
    "wedge beyond its end", "falloff without a width", "segment along the line", "light met in its plane",
    "edge end-on", "mirror along the normal", "node around the eye", "critical angle",
    "face of a light without an area", "light sampled from its own corner",
    "point of a stripe without an area", "place in a stripe without an area",
    "place in a stripe beside what has no area", "corners on alternate sides", "tangent along the normal, forward",
    "lobe without a width", "direction in a wedge without a width", "cone straight behind a lobe",
    "curve of parallel planes",
)  # fmt: skip


@pytest.fixture(scope="module")
def values() -> np.ndarray:
    scene = psdr.load_dict(room())
    params = psdr.traverse(scene)
    corners = params["lamp.vertex_positions"].numpy().copy()
    corners[3] = corners[2]  # its second triangle has collapsed
    params["lamp.vertex_positions"] = corners
    params.update()
    out = wp.full(len(NAMES), np.nan, dtype=wp.float32, device="cpu")
    wp.launch(guards, 1, [scene.data(), wp.vec3(0.0, 0.0, 0.0)], [out], device="cpu")
    return out.numpy()


@pytest.mark.parametrize("name", NAMES)
def test_guard(name: str, values: np.ndarray) -> None:
    assert abs(values[NAMES.index(name)]) < 1e-3


def test_points_of_the_rim_are_finite() -> None:
    u = np.linspace(0.0, 0.99999994, 1 << 16, dtype=np.float32)
    out = wp.zeros(len(u), dtype=wp.float32, device="cpu")
    wp.launch(rims, len(u), [wp.array(u, device="cpu")], [out], device="cpu")
    assert np.isfinite(out.numpy()).all()


@pytest.mark.parametrize("grazing", [False, True])
def test_edges_are_drawn_within_their_ends(grazing: bool) -> None:
    """Edges of all lengths, seen by lobes of all widths; ``grazing``: one end is in the plane that ends a lobe."""
    random, count = np.random.default_rng(1), 20000
    z, a, along = random.normal(size=(3, count, 3))
    z /= np.linalg.norm(z, axis=1)[:, None]
    along *= 10.0 ** random.uniform(-4.0, 4.0, (count, 1))
    if grazing:
        a -= (1.0 - 10.0 ** random.uniform(-9.0, -3.0, count))[:, None] * (a * z).sum(axis=1)[:, None] * z
    scale = 10.0 ** random.uniform(-3.0, 0.0, count)
    u = random.choice([0.0, 0.1, 0.5, 0.9, 0.999, 0.99999994], count)
    inputs = [wp.array(np.float32(v), dtype=wp.vec3, device="cpu") for v in (z, a, along)]
    inputs[1:1] = [wp.array(np.float32(scale), device="cpu")]
    out = wp.zeros(count, dtype=wp.vec3, device="cpu")
    wp.launch(lines, count, [*inputs, wp.array(np.float32(u), device="cpu")], [out], device="cpu")
    integral, fraction, part = out.numpy().T
    assert (integral >= 0.0).all() and (fraction >= 0.0).all() and (fraction <= 1.0).all()
    # Float32 fractions of an edge that is much longer than the lobe is wide.
    error = np.abs(part - u)[(integral > 0.0) & (not grazing)]
    assert error.max(initial=0.0) < 2e-2 and (error > 1e-3).sum() < 10


def test_a_vertex_met_along_its_surface_is_dropped() -> None:
    """Its interpolated normal scatters light that arrives in the plane of the triangle: over a cosine of zero."""
    description = room()
    del description["floor"]["face_normals"]
    description["floor"]["normals"] = np.tile([0.0, 0.2, 0.98], (4, 1))
    scene = psdr.load_dict(description)
    connect, extend = make_walk(psdr.plan(scene, integrator=psdr.PathIntegrator(max_depth=3)).config)

    @wp.kernel(module="unique", enable_backward=False)
    def met(scene: Scene, camera: Camera, height: wp.array(dtype=wp.float32), out: wp.array2d(dtype=wp.float32)):
        i = wp.tid()
        tri = scene.triangles[0]
        walk = Walk()
        walk.u = 0.3
        walk.v = 0.3
        walk.x = 0.4 * tri.p0 + 0.3 * tri.p1 + 0.3 * tri.p2
        walk.to = wp.vec3(0.0, 1.0, height[i])
        walk.weight = wp.vec3(1.0, 1.0, 1.0)
        out[i, 0] = connect(scene, camera, walk, wp.vec2(0.0, 0.0)).weight[0]
        out[i, 1] = extend(scene, walk, wp.vec4(0.5, 0.5, 0.3, 0.7), 1.0e3, False).weight[0]

    out = wp.zeros((2, 2), dtype=wp.float32, device="cpu")
    height = wp.array([0.0, 0.1], dtype=wp.float32, device="cpu")
    wp.launch(met, 2, [scene.data(), scene.camera(0), height], [out], device="cpu")
    along, above = out.numpy()
    assert not along.any() and above[0] > 0.0


@pytest.mark.slow
def test_a_mesh_without_usable_normals_is_flat() -> None:
    """Vertex normals of nearly no length: the triangles' own are used, and the others have no derivative."""
    found = {}
    for kind in ("none", "zero"):
        scene = room()
        if kind == "zero":
            scene["box"] |= {"face_normals": False, "normals": np.ones_like(scene["box"]["vertices"])}
        loaded = psdr.load_dict(scene)
        params = psdr.traverse(loaded)
        if kind == "zero":
            params["box.vertex_normals"] = 1e-12 * scene["box"]["vertices"]
            params.update()
        names = ["box.vertex_positions", "box.vertex_normals"][: 1 + (kind == "zero")]
        params.requires_grad(*names)
        options = {"integrator": psdr.PathIntegrator(max_depth=3, boundary=None), "spp": 4}
        image = psdr.render(loaded, **options).numpy()
        psdr.render_backward(loaded, params, np.ones_like(image), **options)
        velocity = {name: np.ones_like(params[name].numpy()) for name in names[-1:]}
        forward = psdr.render_forward(loaded, params, velocity, **options).numpy()
        assert not any(psdr.invalid_samples(loaded).values())
        found[kind] = (image, params["box.vertex_positions"].grad.numpy().copy(), forward)
        assert kind == "none" or not (params["box.vertex_normals"].grad.numpy().any() or forward.any())
    np.testing.assert_allclose(found["zero"][0], found["none"][0], rtol=1e-5)
    assert all(np.isfinite(value).all() for value in found["zero"])


def test_computed_normals_that_cancel_do_not_turn() -> None:
    """Both sides of a sheet share its vertices: the normals' sums are zero, and have no direction to differentiate."""
    scene = room()
    del scene["box"]["face_normals"]
    scene["box"] |= {"vertices": scene["box"]["vertices"][:3], "faces": np.array([[0, 1, 2], [0, 2, 1]])}
    loaded = psdr.load_dict(scene)
    params = psdr.traverse(loaded)
    velocity = {"box.vertex_positions": np.float32([[0.3, 0.0, 0.1], [0.0, 0.2, 0.0], [0.1, 0.0, -0.4]])}
    options = {"integrator": psdr.PathIntegrator(max_depth=3, boundary=None), "spp": 16}
    image = psdr.render_forward(loaded, params, velocity, **options).numpy()
    assert np.isfinite(image).all() and image.any() and not any(psdr.invalid_samples(loaded).values())
