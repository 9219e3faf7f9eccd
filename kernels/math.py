"""Small vector algebra with derivatives that stay finite at the ends of the ranges. Every function is differentiable.

A plain ``sqrt(0)`` has an infinite derivative, and ``0 * inf`` in an adjoint is NaN. The functions named ``safe_*``
have derivative zero where the plain ones have none.
"""

import warp as wp

from warp_psdr.kernels.constants import INV_TWO_PI

#: Below it a squared length or a radicand counts as zero; its root, 1e-15, is far below float32's resolution of one.
TINY = 1.0e-30
#: sin^2 of the angle between a normal and a tangent below which the tangent says nothing.
PARALLEL = 1.0e-12
#: Size of an argument below which the logarithm, and the exponential function, are series.
LOG_SERIES, EXP_SERIES = 0.1, 0.5


@wp.func_native(
    "return condition ? a : b;",
    "adj_a += condition ? adj_ret : 0.0f;\nadj_b += condition ? 0.0f : adj_ret;",
)
def where_number(condition: wp.bool, a: wp.float32, b: wp.float32) -> wp.float32:
    """``wp.where``, whose adjoint does not branch, either: loops over lanes stay SIMD (``lanes.py``)."""
    return wp.float32(0.0)


@wp.func
def where3(condition: wp.bool, a: wp.vec3, b: wp.vec3) -> wp.vec3:
    """One of two vectors, component by component: no branch in a loop over lanes (``lanes.py``)."""
    return wp.vec3(
        where_number(condition, a[0], b[0]), where_number(condition, a[1], b[1]), where_number(condition, a[2], b[2])
    )


@wp.func
def unit_vector(w: wp.vec3) -> wp.vec3:
    """``w`` over its length, or 0 as it is: ``wp.normalize`` without its branch."""
    length = wp.length(w)
    return w / where_number(length > 0.0, length, 1.0)


@wp.func
def at_least(low: wp.float32, x: wp.float32) -> wp.float32:
    """The greater of the two, with ``x``'s derivative in a tie: adjoints of ``wp.max`` branch, and are no SIMD."""
    return where_number(x < low, low, x)


@wp.func
def at_most(high: wp.float32, x: wp.float32) -> wp.float32:
    """The lesser of the two, with ``x``'s derivative in a tie."""
    return where_number(x > high, high, x)


@wp.func
def clamp_unit(x: wp.float32) -> wp.float32:
    """``x`` clamped to [0, 1], with derivative 1 in it, its ends included."""
    return at_least(0.0, at_most(1.0, x))


@wp.func
def log_ratio(x: wp.float32) -> wp.float32:
    """log(1 + x) / x, at ``x`` > -1, where it has no pole."""
    z = x / (2.0 + x)
    z2 = z * z
    series = 2.0 / (2.0 + x) * (1.0 + z2 * (1.0 / 3.0 + z2 * (0.2 + z2 / 7.0)))
    near = wp.abs(x) < LOG_SERIES
    far = where_number(near, 1.0, x)
    return where_number(near, series, wp.log(1.0 + far) / far)


@wp.func
def exp_ratio(x: wp.float32) -> wp.float32:
    """(exp(x) - 1) / x, which has no pole."""
    near = wp.abs(x) < EXP_SERIES
    z = where_number(near, x, 0.0)
    series = 1.0 + z / 2.0 * (1.0 + z / 3.0 * (1.0 + z / 4.0 * (1.0 + z / 5.0 * (1.0 + z / 6.0 * (1.0 + z / 7.0)))))
    far = where_number(near, 1.0, x)
    return where_number(near, series, (wp.exp(far) - 1.0) / far)


@wp.func
def safe_sqrt(x: wp.float32) -> wp.float32:
    """Square root; 0 with derivative 0 for ``x`` at and below zero."""
    positive = x > TINY
    return where_number(positive, wp.sqrt(where_number(positive, x, 1.0)), 0.0)


@wp.func
def safe_normalize(v: wp.vec3) -> wp.vec3:
    """``v`` over its length; 0 with derivative 0 for a vector of length zero, NaN for one that holds NaN."""
    squared = wp.dot(v, v)
    unit = wp.vec3(0.0, 0.0, 0.0)
    if not squared <= TINY:
        unit = v / wp.sqrt(squared)
    return unit


@wp.func
def any_tangent(n: wp.vec3) -> wp.vec3:
    """Return a unit vector perpendicular to the unit ``n``.

    [Duff et al. 2017, Building an Orthonormal Basis, Revisited.] It turns by a finite angle across ``n.z = 0``: use it
    where the model is isotropic.
    """
    sign = where_number(n[2] >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + n[2])
    return wp.vec3(1.0 + sign * n[0] * n[0] * a, sign * n[0] * n[1] * a, -sign * n[0])


@wp.func
def aligned_tangent(n: wp.vec3, tangent: wp.vec3) -> wp.vec3:
    """Return the direction of the part of ``tangent`` normal to the unit ``n``, for anisotropic models.

    Falls back on ``any_tangent`` where the two are parallel or ``tangent`` is zero.
    """
    across = tangent - n * wp.dot(n, tangent)
    squared = wp.dot(across, across)
    parallel = squared <= PARALLEL * wp.dot(tangent, tangent)
    return where3(parallel, any_tangent(n), across / wp.sqrt(where_number(parallel, 1.0, squared)))


@wp.func
def to_local(s: wp.vec3, t: wp.vec3, n: wp.vec3, w: wp.vec3) -> wp.vec3:
    """World to local coordinates of the orthonormal frame (s, t, n)."""
    return wp.vec3(wp.dot(s, w), wp.dot(t, w), wp.dot(n, w))


@wp.func
def to_world(s: wp.vec3, t: wp.vec3, n: wp.vec3, w: wp.vec3) -> wp.vec3:
    """Local to world coordinates of the orthonormal frame (s, t, n)."""
    return w[0] * s + w[1] * t + w[2] * n


@wp.func
def reflect_local(wi: wp.vec3) -> wp.vec3:
    """Mirror ``wi`` about the local z axis."""
    return wp.vec3(-wi[0], -wi[1], wi[2])


@wp.func
def refract_at(w: wp.vec3, n: wp.vec3, c: wp.float32, g: wp.float32, eta: wp.float32) -> wp.vec3:
    """Refract the unit vector ``w`` at a plane with the unit normal ``n`` on its side, ``c = dot(w, n)``.

    ``eta`` and ``g`` as in ``refract_local``. The normal's share, c - g, is written without the difference.
    """
    return (-(eta - 1.0) * (eta + 1.0) / (c + g) * n - w) / eta


@wp.func
def refract_local(wi: wp.vec3, g: wp.float32, eta: wp.float32) -> wp.vec3:
    """Refract ``wi`` at the local plane z = 0 to its other side (Snell's law).

    ``eta`` is the index of refraction behind the plane over the one on the side of ``wi``, and
    ``g = sqrt(eta^2 - 1 + wi.z^2)``, which is ``eta`` times the cosine on the other side (see ``fresnel.py``).
    """
    return wp.vec3(-wi[0], -wi[1], where_number(wi[2] < 0.0, g, -g)) / eta


@wp.func
def share_of_turn(y: wp.float32, x: wp.float32) -> wp.float32:
    """The angle of (x, y) as a share of a turn, in [0, 1)."""
    t = wp.atan2(y, x) * INV_TWO_PI
    return wp.min(where_number(t < 0.0, t + 1.0, t), 0.9999999)
