"""Local factors that are differentiated, where their arguments are singular.

Everything that is differentiated goes through ``wp.grad`` of a named function. ``EVERY`` lists all of them, and whether
an argument with no derivative can be reached: a new one that is not listed fails.
"""

import ast
import math
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from warp_psdr.kernels.bsdf.microfacet import MIN_COSINE, make_reflection
from warp_psdr.kernels.bsdf.motion import make_reflection_motion
from warp_psdr.kernels.emitter.directional import directional_dot
from warp_psdr.kernels.emitter.point import point_dot
from warp_psdr.kernels.emitter.spot import spot_dot
from warp_psdr.kernels.fresnel import fresnel_conductor
from warp_psdr.kernels.interior.factors.pullback import tangent_frame_dot
from warp_psdr.kernels.sensor.camera import camera_dot, lens_dot, parallel_dot
from warp_psdr.kernels.shape.normals import normalized_dot, weighted_normal_dot
from warp_psdr.kernels.shape.transform import normal_dot
from warp_psdr.kernels.surface import tangent_dot

from .record import Case, parameters

KERNELS = Path(__file__).resolve().parents[2] / "kernels"
#: function: where its singular arguments are tested, or why there are none that a derivative is asked at.
EVERY = {
    "anchor": "the identity",
    "barycentrics_dot": "a ray in the plane of its triangle: no query returns such a hit, and if rounding makes one of "
    "a needle, its derivative is not finite, and the sample counted",
    "bilinear_dot": "linear in values, and in the position within a cell",
    "half_width": "an opening of 180 degrees, which loading refuses",
    "camera_dot": "here", "lens_dot": "here", "parallel_dot": "here",
    "distorted_dot": "as camera_dot; a lens that folds, which loading and each call refuse",
    "log_area": "a lens that folds: a point there is not seen",
    "directional_dot": "here", "point_dot": "here", "spot_dot": "here", "moved_point_dot": "linear",
    "projected_dot": "test_textured_spot.py", "projector_dot": "test_projector.py", "frame_dot": "test_projector.py",
    "tangent_dot": "here", "tangent_frame_dot": "here",
    "weighted_normal_dot": "here", "normalized_dot": "here", "normal_dot": "here",
    "eval_dot": "test_materials.py", "scatter_dot": "test_materials.py",
    "drawn_dot": "here", "log_density": "here",
    "tube_dot": "no radius, or no direction of the axis: no ray is found to enter", "tube_still": "as tube_dot",
    "cone_dot": "no radius, or points that coincide: no ray is found to enter", "cone_still": "as cone_dot",
    "film_form": "a point in the camera's plane, or a surface seen edge-on: no film point meets either",
}  # fmt: skip


def differentiated() -> set[str]:
    """Return the names of all functions that ``wp.grad`` is called with."""
    found = set()
    for file in KERNELS.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "wp.grad":
                found.add(ast.unparse(node.args[0]))
    return found


def test_everything_that_is_differentiated_is_listed() -> None:
    assert differentiated() == set(EVERY)


@wp.func
def total(v: wp.vec3) -> wp.float32:
    """Sum of absolute values; NaN and infinity stay."""
    return wp.abs(v[0]) + wp.abs(v[1]) + wp.abs(v[2])


@wp.func
def total_44(m: wp.mat44) -> wp.float32:
    r = wp.float32(0.0)
    for i in range(4):
        for j in range(4):
            r += wp.abs(m[i, j])
    return r


@wp.kernel(module="unique", enable_backward=False)
def triangles(
    p0: wp.array(dtype=wp.vec3),
    p1: wp.array(dtype=wp.vec3),
    p2: wp.array(dtype=wp.vec3),
    out: wp.array(dtype=wp.float32),
):
    i = wp.tid()
    a = wp.vec3(0.3, -0.7, 0.5)
    b0, b1, b2, _a0, _a1, _a2 = wp.grad(weighted_normal_dot)(p0[i], p1[i], p2[i], a, 2.0 * a, -a)
    uv = wp.vec2(0.2, 0.4)
    t0, t1, t2, h0, h1, h2, _g = wp.grad(tangent_dot)(p0[i], p1[i], p2[i], uv, uv, uv, a)
    c, _w = wp.grad(normalized_dot)(p1[i] - p0[i], a)
    out[i] = total(b0) + total(b1) + total(b2) + total(t0) + total(t1) + total(t2) + total(c)
    out[i] += wp.length(h0) + wp.length(h1) + wp.length(h2)


@wp.kernel(module="unique", enable_backward=False)
def poses(m: wp.array(dtype=wp.mat44), out: wp.array(dtype=wp.float32)):
    i = wp.tid()
    a = wp.vec3(0.3, -0.7, 0.5)
    g, b, _c = wp.grad(normal_dot)(m[i], wp.vec3(0.6, 0.0, 0.8), a)
    film = wp.vec2(0.5, 0.5)
    c, _film, _aspect, _o, _d = wp.grad(parallel_dot)(m[i], film, 1.0, a, a)
    d, fov, x, y, _s, _t, _z, _ao, _ad = wp.grad(camera_dot)(m[i], 40.0, 0.0, 0.0, 0.5, 0.5, 1.0, a, a)
    lens, fov_2, x_2, y_2, radius, focus, _f, _l, _w, _a1, _a2 = wp.grad(lens_dot)(
        m[i], 40.0, 0.0, 0.0, 0.0, 1.0e-6, film, wp.vec2(0.0, 0.0), 1.0, a, a
    )
    out[i] = total_44(g) + total(b) + total_44(c) + total_44(d) + total_44(lens)
    out[i] += wp.abs(fov + x + y) + wp.abs(fov_2 + x_2 + y_2 + radius + focus)


@wp.kernel(module="unique", enable_backward=False)
def lights(axis: wp.array(dtype=wp.vec3), cutoff: wp.array(dtype=wp.vec2), out: wp.array(dtype=wp.float32)):
    i = wp.tid()
    a = wp.vec3(0.3, -0.7, 0.5)
    x = wp.vec3(0.0, 0.0, 0.0)
    above = wp.vec3(0.0, 0.0, 2.0)
    d_x, d_p, d_axis, d_i, d_cutoff, d_beam, _w, _a = wp.grad(spot_dot)(
        x, above, axis[i], a, cutoff[i][0], cutoff[i][1], a, a
    )
    e, _f = wp.grad(directional_dot)(axis[i], a)
    p_x, p_p, p_i, _b, _c = wp.grad(point_dot)(x, 1.0e-6 * above, a, a, a)
    out[i] = total(d_x) + total(d_p) + total(d_axis) + total(d_i) + wp.abs(d_cutoff) + wp.abs(d_beam) + total(e)
    out[i] += total(p_x) + total(p_p) + total(p_i)


@wp.kernel(module="unique", enable_backward=False)
def frames(tangent: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.float32)):
    i = wp.tid()
    n = wp.vec3(0.0, 0.6, 0.8)
    w = wp.vec3(0.6, 0.0, 0.8)
    a = wp.vec3(0.3, -0.7, 0.5)
    g_n, g_t, g_wi, g_wo, _a, _b = wp.grad(tangent_frame_dot)(n, tangent[i], w, w, a, a)
    out[i] = total(g_n) + total(g_wi) + total(g_wo) + total(g_t)


def motions(distribution: str) -> float:
    """Directions drawn from a rough mirror, from along its normal to grazing, at the ends of the random numbers."""
    motion_of = make_reflection_motion(distribution)
    sample = make_reflection(distribution).sample

    @wp.kernel(module="unique", enable_backward=False)
    def drawn(at: wp.array(dtype=wp.vec3), numbers: wp.array(dtype=wp.vec2), out: wp.array(dtype=wp.float32)):
        i = wp.tid()
        wi = wp.vec3(wp.sin(at[i][0]), 0.0, wp.cos(at[i][0]))
        wo = sample(wi, at[i][1], at[i][2], numbers[i])
        if wo[2] > MIN_COSINE:
            m = motion_of(wi, wo, at[i][1], at[i][2], numbers[i])
            out[i] = total(m.by_u) + total(m.by_v) + wp.length(m.log_pdf) + total(m.log_pdf_wo)

    angles, alphas, ends = (
        np.radians([0.0, 1e-3, 45.0, 89.0, 89.99]),
        [1e-5, 1e-3, 0.3, 1.0],
        [0.0, 0.5, 1.0 - 2.0**-24],
    )
    rows = [(a, u, v, x, y) for a in angles for u in alphas for v in alphas for x in ends for y in ends]
    at, numbers = np.split(np.array(rows), [3], axis=1)
    return finite(drawn, at, numbers)


def launched(kernel: wp.Kernel, *columns: np.ndarray) -> np.ndarray:
    kinds = {(3,): wp.vec3, (2,): wp.vec2, (4, 4): wp.mat44}
    inputs = [wp.array(np.float32(c), dtype=kinds[np.shape(c)[1:]], device="cpu") for c in columns]
    out = wp.zeros(len(columns[0]), dtype=wp.float32, device="cpu")
    wp.launch(kernel, len(columns[0]), inputs, [out], device="cpu")
    return out.numpy()


@wp.kernel(module="unique", enable_backward=False)
def metals(at: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.float32)):
    i = wp.tid()
    by_cosine, by_eta, by_k = wp.grad(fresnel_conductor)(at[i][0], at[i][1], at[i][2])
    out[i] = fresnel_conductor(at[i][0], at[i][1], at[i][2]) + wp.abs(by_cosine) + wp.abs(by_eta) + wp.abs(by_k)


#: Triangles without an area: a point, a side, corners in line; and such that are nearly so.
FLAT = [
    [[0, 0, 0], [0, 0, 0], [0, 0, 0]], [[0, 0, 0], [1, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 0, 0], [1, 0, 0]],
    [[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 0, 0], [1, 0, 0], [-1, 0, 0]], [[0, 0, 0], [1, 0, 0], [2, 1e-7, 0]],
]  # fmt: skip
SINGULAR = [np.zeros((4, 4)), np.diag([1.0, 1.0, 0.0, 1.0]), np.diag([1.0, 0.0, 0.0, 1.0]), 1e-13 * np.eye(4),
            np.diag([1e13, 1e13, 1e13, 1.0])]  # fmt: skip
#: Axes of a light above, towards what is lit, away from it, and none; cutoff and beam, degrees.
AXES = [[0, 0, -1], [0, 0, 1], [0, 0, 0], [0, 0, -1], [1, 0, 0], [0, 0, -1e-6]]
ANGLES = [[20, 10], [20, 10], [20, 10], [20, 20], [90, 90], [1e-6, 0]]
#: Cosine, and complex index eta + i k.
INDICES = [[1, 0, 0], [1, 1e-20, 0], [1, 0, 1e-20], [1e-20, 1, 0], [0.8, 0.6, 0], [0.6, 0.8, 0], [1, 1, 0]]
#: Surface tangents along the normal (0, 0.6, 0.8), nearly so, and none.
ALONG = [[0, 0, 0], [0, 0.6, 0.8], [0, -3.0, -4.0], [1e-9, 0.6, 0.8]]


def finite(kernel: wp.Kernel, *columns) -> float:
    return 0.0 if np.isfinite(launched(kernel, *columns)).all() else math.inf


def case(name: str, measure, hard: str, naive: str) -> Case:
    return Case(family="singular", name=name, bound=0.0, measure=measure, hard=hard, naive=naive)


CASES = [
    case("triangles without an area", lambda: finite(triangles, *np.swapaxes(FLAT, 0, 1)),
         "neither a normal, nor an angle, nor a direction of texture",
         "the derivative of a root or of acos at its end: NaN"),
    case("poses and cameras without a volume", lambda: finite(poses, np.array(SINGULAR)),
         "the inverse of a singular matrix; determinants beyond float32", "0 / 0; normals are NaN already"),
    case("lights seen along their axis", lambda: finite(lights, np.array(AXES), np.array(ANGLES)),
         "the angle to the axis has a kink at 0, falloff none of a width", "acos of 1: an infinite derivative"),
    case("metals without indices, or at the critical angle", lambda: finite(metals, np.array(INDICES)),
         "the root of a complex number that is 0", "a root's derivative at 0; 0 / 0"),
    case("directions that move with a roughness, GGX", lambda: motions("ggx"),
         "seen along the normal there is no azimuth; the last random number lies at the rim of a cap", "0 / 0"),
    case("directions that move with a roughness, Beckmann", lambda: motions("beckmann"),
         "a cumulative distribution that is flat at its ends", "0 / 0 of a Newton step"),
    case("tangents along the normal", lambda: finite(frames, np.array(ALONG)),
         "no part of the tangent lies in the surface", "0 / 0"),
]  # fmt: skip


@pytest.mark.parametrize("case", parameters(CASES))
def test_singular(case, check) -> None:
    check(case)
