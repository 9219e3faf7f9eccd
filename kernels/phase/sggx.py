"""Microflakes with the normals of an ellipsoid (Mitsuba's ``sggx``) [Heitz et al. 2015].

A symmetric, positive definite matrix S describes the orientation of flakes. Towards w each has the projected area A(w)
= sqrt(w^T S w), and their normals have the density D(h) = 1 / (pi sqrt|S| (h^T S^-1 h)^2). Flakes are mirrors, so with
h the half vector of -d and wo, f_p = D(h) / (4 A(d)), and a ray along d meets sigma_t A(d) flakes a unit length.
Homogeneous media therefore take A(d) t for the length t of a flight (``flake_length``). S is six numbers, S_xx, S_yy,
S_zz, S_xy, S_xz, S_yz. Normals are drawn from those visible from -d: with S = L L^T, the normalised L m has their
density if m is drawn about L^T (-d) by the cosine. ``microflakes.py`` has grids of S, and derivatives by S.

Derivation: ``docs/theory/media.md#microflakes``.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import FAR, INV_PI, PHASE_SGGX, TWO_PI
from warp_psdr.kernels.math import any_tangent, to_world
from warp_psdr.kernels.medium.coefficients import Coefficients, coefficients_of
from warp_psdr.kernels.reading import load_float
from warp_psdr.kernels.structs import Medium, Scene

#: Least square of a half vector before it is normalised; a ray that is not turned has none.
SAME_DIRECTION = 1.0e-24
#: Least projected area, squared, relative to nothing: only a direction that rounding has left without any has less.
NO_AREA = 1.0e-30


@wp.struct
class Flakes:
    """S by its rows."""

    x: wp.vec3
    y: wp.vec3
    z: wp.vec3


@wp.func
def flakes_of(scene: Scene, offset: wp.int32) -> Flakes:
    s = Flakes()
    xy = load_float(scene.values, offset + 3)
    xz = load_float(scene.values, offset + 4)
    yz = load_float(scene.values, offset + 5)
    s.x = wp.vec3(load_float(scene.values, offset), xy, xz)
    s.y = wp.vec3(xy, load_float(scene.values, offset + 1), yz)
    s.z = wp.vec3(xz, yz, load_float(scene.values, offset + 2))
    return s


@wp.func
def flake_area(s: Flakes, w: wp.vec3) -> wp.float32:
    """A(w)."""
    across = wp.vec3(wp.dot(s.x, w), wp.dot(s.y, w), wp.dot(s.z, w))
    return wp.sqrt(wp.max(wp.dot(w, across), NO_AREA))


@wp.func
def flake_area_slope(s: Flakes, w: wp.vec3) -> wp.vec3:
    """The derivative of ln A(w) by w: S w / A^2."""
    across = wp.vec3(wp.dot(s.x, w), wp.dot(s.y, w), wp.dot(s.z, w))
    return across / wp.max(wp.dot(w, across), NO_AREA)


@wp.func
def half_vector(d: wp.vec3, wo: wp.vec3) -> wp.vec3:
    """h, unit; any normal that is seen edge-on where the ray is not turned."""
    v = wo - d
    squared = wp.dot(v, v)
    if squared < SAME_DIRECTION:
        return any_tangent(d)
    return v / wp.sqrt(squared)


@wp.func
def adjugate_times(s: Flakes, w: wp.vec3) -> wp.vec3:
    """|S| S^-1 w."""
    return wp.vec3(
        wp.dot(wp.cross(s.y, s.z), w),
        wp.dot(wp.cross(s.z, s.x), w),
        wp.dot(wp.cross(s.x, s.y), w),
    )


@wp.func
def sggx_eval(s: Flakes, d: wp.vec3, wo: wp.vec3) -> wp.float32:
    """Value and density, 1/sr."""
    h = half_vector(d, wo)
    determinant = wp.dot(s.x, wp.cross(s.y, s.z))
    stretch = wp.dot(h, adjugate_times(s, h)) / determinant  # h^T S^-1 h
    return 0.25 * INV_PI / (wp.sqrt(determinant) * stretch * stretch * flake_area(s, d))


@wp.func
def sggx_slopes(s: Flakes, d: wp.vec3, wo: wp.vec3) -> tuple[wp.vec3, wp.vec3]:
    """Derivatives of the value by d and by wo; 0 where the ray is not turned."""
    value = sggx_eval(s, d, wo)
    a_d = -value * flake_area_slope(s, d)
    a_wo = wp.vec3(0.0, 0.0, 0.0)
    v = wo - d
    squared = wp.dot(v, v)
    if squared >= SAME_DIRECTION:
        b = adjugate_times(s, v)
        a_wo = (4.0 * value) * (v / squared - b / wp.dot(v, b))
        a_d -= a_wo
    return a_d, a_wo


@wp.func
def sggx_sample(s: Flakes, d: wp.vec3, u: wp.vec2) -> wp.vec3:
    """A new direction: mirrored by a normal of those that are seen."""
    # ---- L, S = L L^T ----
    xx = wp.sqrt(s.x[0])
    yx = s.x[1] / xx
    zx = s.x[2] / xx
    yy = wp.sqrt(wp.max(s.y[1] - yx * yx, NO_AREA))
    zy = (s.y[2] - zx * yx) / yy
    zz = wp.sqrt(wp.max(s.z[2] - zx * zx - zy * zy, 0.0))
    # ---- m about L^T (-d), by the cosine ----
    c = -wp.normalize(wp.vec3(xx * d[0] + yx * d[1] + zx * d[2], yy * d[1] + zy * d[2], zz * d[2]))
    a = any_tangent(c)
    r = wp.sqrt(u[0])
    phi = TWO_PI * u[1]
    cosine = wp.sqrt(wp.max(0.0, 1.0 - u[0]))
    m = to_world(a, wp.cross(c, a), c, wp.vec3(r * wp.cos(phi), r * wp.sin(phi), cosine))
    h = wp.normalize(wp.vec3(xx * m[0], yx * m[0] + yy * m[1], zx * m[0] + zy * m[1] + zz * m[2]))
    return wp.normalize(d - 2.0 * wp.dot(d, h) * h)


@functools.cache
def make_flake_length(kinds: tuple[int, ...]):
    """Return ``flake_length(scene, m, d, length) -> float32``: A(d) times a length; the length without microflakes."""
    one = len(kinds) == 1

    @wp.func
    def flake_length(scene: Scene, m: Medium, d: wp.vec3, length: wp.float32) -> wp.float32:
        if (wp.static(one) or m.phase == PHASE_SGGX) and length < FAR:
            return flake_area(flakes_of(scene, m.g), d) * length
        return length

    return flake_length


@functools.cache
def make_extinction_along(kinds: tuple[int, ...]):
    """Return ``extinction_along(scene, m, d) -> Coefficients``: those of a ray along d; of microflakes A(d) sigma_t."""
    flakes, one = PHASE_SGGX in kinds, len(kinds) == 1

    @wp.func
    def extinction_along(scene: Scene, m: Medium, d: wp.vec3) -> Coefficients:
        c = coefficients_of(scene, m)
        if wp.static(flakes):
            if wp.static(one) or m.phase == PHASE_SGGX:
                c.sigma_t = flake_area(flakes_of(scene, m.g), d) * c.sigma_t
        return c

    return extinction_along
