"""Small vector algebra with derivatives that stay finite at the ends of the ranges. Every function is differentiable.

A plain ``sqrt(0)`` has an infinite derivative, and ``0 * inf`` in an adjoint is NaN. The functions named ``safe_*``
have derivative zero where the plain ones have none.
"""

import warp as wp

#: Below it a squared length or a radicand counts as zero; its root, 1e-15, is far below float32's resolution of one.
TINY = 1.0e-30
#: Distance of a cosine from +-1 at which ``safe_acos`` stops following the infinite slope of ``acos``: 1/2 ulp of one.
ACOS_MARGIN = 5.9604645e-8


@wp.func
def safe_sqrt(x: wp.float32) -> wp.float32:
    """Square root; 0 with derivative 0 for ``x`` at and below zero."""
    root = wp.float32(0.0)
    if x > TINY:
        root = wp.sqrt(x)
    return root


@wp.func
def safe_acos(x: wp.float32) -> wp.float32:
    """Arc cosine (radians) of ``x`` clamped to [-1, 1]; derivative 0 at both ends."""
    return wp.acos(wp.clamp(x, -1.0 + ACOS_MARGIN, 1.0 - ACOS_MARGIN))


@wp.func
def safe_normalize(v: wp.vec3) -> wp.vec3:
    """``v`` over its length; 0 with derivative 0 for a vector of length zero."""
    squared = wp.dot(v, v)
    unit = wp.vec3(0.0, 0.0, 0.0)
    if squared > TINY:
        unit = v / wp.sqrt(squared)
    return unit


@wp.func
def frame_from_normal(n: wp.vec3) -> wp.mat33:
    """Right-handed orthonormal frame, rows (s, t, n), for a unit ``n``.

    [Duff et al. 2017, Building an Orthonormal Basis, Revisited.] Its tangents turn by a finite angle across
    ``n.z = 0``: use it where the model is isotropic.
    """
    sign = wp.where(n[2] < 0.0, -1.0, 1.0)
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    return wp.matrix_from_rows(
        wp.vec3(1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]), wp.vec3(b, sign + n[1] * n[1] * a, -n[1]), n
    )


@wp.func
def frame_from_tangent(n: wp.vec3, tangent: wp.vec3) -> wp.mat33:
    """Right-handed orthonormal frame, rows (s, t, n): ``s`` along the part of ``tangent`` normal to the unit ``n``.

    Falls back on ``frame_from_normal`` where the two are parallel or ``tangent`` is zero. For anisotropic models.
    """
    across = tangent - n * wp.dot(n, tangent)
    squared = wp.dot(across, across)
    if squared <= 1.0e-12 * wp.dot(tangent, tangent):
        return frame_from_normal(n)
    s = across / wp.sqrt(squared)
    return wp.matrix_from_rows(s, wp.cross(n, s), n)


@wp.func
def to_local(frame: wp.mat33, v: wp.vec3) -> wp.vec3:
    """World to local coordinates, for a frame with rows (s, t, n)."""
    return frame * v


@wp.func
def to_world(frame: wp.mat33, v: wp.vec3) -> wp.vec3:
    """Local to world coordinates, for a frame with rows (s, t, n)."""
    return wp.transpose(frame) * v


@wp.func
def reflect(w: wp.vec3, n: wp.vec3) -> wp.vec3:
    """Mirror ``w`` about the unit vector ``n``; both point away from the surface."""
    return 2.0 * wp.dot(w, n) * n - w


@wp.func
def reflect_local(wi: wp.vec3) -> wp.vec3:
    """Mirror ``wi`` about the local z axis."""
    return wp.vec3(-wi[0], -wi[1], wi[2])


@wp.func
def refract_local(wi: wp.vec3, g: wp.float32, eta: wp.float32) -> wp.vec3:
    """Refract ``wi`` at the local plane z = 0 to its other side (Snell's law).

    ``eta`` is the index of refraction behind the plane over the one on the side of ``wi``, and
    ``g = sqrt(eta^2 - 1 + wi.z^2)``, which is ``eta`` times the cosine on the other side (see ``fresnel.py``).
    """
    return wp.vec3(-wi[0], -wi[1], wp.where(wi[2] < 0.0, g, -g)) / eta
