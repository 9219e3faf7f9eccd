"""The transmittance of a rough dielectric coat: the table of ``roughplastic``, and its derivatives.

With visible normals m of density D G_1(wi) <wi, m> / cos(wi), reflected or refracted into wo,

    R(wi) = E[ F(<wi, m>) G_1(wo) ],   T(wi) = E[ (1 - F(<wi, m>)) G_1(wo) ],

by Gauss-Legendre quadrature over the unit square from which the normals are sampled. The table holds T from outside at
``RESOLUTION`` cosines, linear between them, and one number for the reflectance that light from the base meets from
below, 2 mean(cos R). Nodes, their number, the sampling of normals and the plain mean are Mitsuba's, so that the model
has Mitsuba's values.

Derivation: ``docs/theory/materials.md#rough-plastic``.
"""

from __future__ import annotations

import functools

import numpy as np

from warp_psdr.kernels.bsdf.microfacet import MIN_ALPHA
from warp_psdr.kernels.bsdf.roughplastic import HEADER, RESOLUTION, TABLE_SIZE

#: Nodes along each axis where the interface is met from the thinner and from the denser side: there the reflectance has
#: a root at the critical angle.
NODES, NODES_TOTAL = 32, 128
#: Cosines of the table; the first is kept off 0.
COSINES = np.maximum(np.linspace(0.0, 1.0, RESOLUTION), 1e-6)
#: Relative step of the central differences, wide enough to pass over the ripples of the quadrature, which come from
#: nodes that cross the critical angle, and errors of 1e-3; most, of the index; where there is no critical angle; least.
STEP, LARGE_STEP, FINE_STEP, LEAST_STEP = 0.025, 0.04, 0.002, 1e-6
#: Uniform numbers keep this far from 0 and 1 where Beckmann's slopes are sampled.
MARGIN = 1e-6
#: Newton steps of that inversion.
STEPS = 3
#: Cosines that are computed at a time: their arrays stay in the processor's cache.
BLOCK = 4


@functools.lru_cache(maxsize=256)
def transmittance(variant: str, alpha: float, ior: float) -> np.ndarray:
    """Return the table of ``roughplastic``, flat float32, as ``kernels/bsdf/roughplastic.py`` reads it.

    Args:
        variant: of the model; it begins with the name of the distribution.
        alpha: Roughness.
        ior: Index of refraction inside over that outside.
    """
    distribution = variant.split()[0]
    used = max(alpha, MIN_ALPHA)
    table = np.zeros((HEADER // 3 + RESOLUTION, 3))
    table[0, :2] = alpha, ior
    steps = _steps_of_index(ior)
    for rows, value, d_ior in zip((slice(1, 2), slice(2, None)), (inside, through), steps, strict=True):
        at, denser, thinner = value(distribution, used, (ior, ior + d_ior, ior - d_ior))
        table[rows, 0] = at
        table[rows, 2] = (denser - thinner) / (2.0 * d_ior)
        if alpha >= np.float32(MIN_ALPHA):  # below nothing changes with it
            d_alpha = STEP * used
            more, less = (value(distribution, used + sign * d_alpha, (ior,))[0] for sign in (1.0, -1.0))
            table[rows, 1] = (more - less) / (2.0 * d_alpha)
    result = table.astype(np.float32).reshape(-1)
    assert result.size == TABLE_SIZE
    result.setflags(write=False)
    return result


def _steps_of_index(ior: float) -> tuple[float, float]:
    """Return the steps for the reflectance from below and for the transmittance; they do not reach equal indices.

    On the denser side it is one across which the critical angle passes a whole number of the table's cosines: each of
    them adds a step to the internal reflectance of a nearly smooth coat.
    """
    most = max(0.5 * abs(ior - 1.0), LEAST_STEP)
    fine, wide = (min(step * ior, most) for step in (FINE_STEP, STEP))
    if ior <= 1.0:
        return fine, wide
    one = 0.5 / (RESOLUTION - 1) * ior**2 * np.sqrt(ior**2 - 1.0)
    return min(max(np.floor(LARGE_STEP * ior / one), 1.0) * one, most), fine


def inside(distribution: str, alpha: float, iors: tuple[float, ...]) -> np.ndarray:
    """Return the internal reflectance for each of the indices, (n, 1), float64."""
    below = albedo(distribution, alpha, tuple(1.0 / ior for ior in iors), COSINES, transmitted=False)
    return 2.0 * np.mean(below * COSINES, axis=1, keepdims=True)


def through(distribution: str, alpha: float, iors: tuple[float, ...]) -> np.ndarray:
    """Return the transmittance at ``COSINES`` for each of the indices, (n, RESOLUTION), float64."""
    return albedo(distribution, alpha, iors, COSINES, transmitted=True)


def albedo(
    distribution: str, alpha: float, iors: tuple[float, ...], cosines: np.ndarray, *, transmitted: bool
) -> np.ndarray:
    """Return E[F G_1(wo)], or E[(1 - F) G_1(wo)], for directions with these cosines.

    Args:
        distribution: "ggx" or "beckmann".
        alpha: Roughness.
        iors: Indices behind the interface over that in front, all above or all below 1.
        cosines: (k,) of the directions that the normals are seen from.
        transmitted: Whether the light that passes is asked for.

    Returns:
        (len(iors), k).
    """
    x, y, weights = _nodes(distribution, NODES if iors[0] > 1.0 else NODES_TOTAL)
    slopes = _beckmann_slopes if distribution == "beckmann" else _ggx_slopes
    found = np.empty((len(iors), len(cosines)))
    for first in range(0, len(cosines), BLOCK):
        block = slice(first, first + BLOCK)
        c = cosines[block, None, None]
        s = np.sqrt(1.0 - c * c)
        along, across2 = slopes(c / np.sqrt((alpha * s) ** 2 + c * c), x, y)
        along = alpha * along
        nz = 1.0 / np.sqrt(1.0 + along * along + (alpha * alpha) * across2)
        d = (c - s * along) * nz
        faces = d > 0.0
        d = np.where(faces, d, 0.0)
        if not transmitted:
            shown = weights * _masked(distribution, alpha, 2.0 * d * nz - c, faces)
        for i, ior in enumerate(iors):
            g = np.sqrt(np.maximum((ior - 1.0) * (ior + 1.0) + d * d, 0.0))
            r_s = (d - g) / (d + g)
            r_p = (ior * ior * d - g) / (ior * ior * d + g)
            reflected = 0.5 * (r_s * r_s + r_p * r_p)
            if transmitted:
                shown = weights * _masked(distribution, alpha, (c - (d - g) * nz) / ior, faces)
                reflected = 1.0 - reflected
            found[i, block] = np.einsum("kij,kij->k", reflected, shown)
    return found


@functools.cache
def _nodes(distribution: str, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes x (n, 1) and y (1, n) and their weights, half of those of the axis in which the sum is symmetric."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    x = y = 0.5 * nodes + 0.5
    wx = wy = 0.5 * weights
    if distribution == "beckmann":
        y, wy = y[n // 2 :], 2.0 * wy[n // 2 :]
    else:
        x, wx = x[n // 2 :], 2.0 * wx[n // 2 :]
    return x[:, None], y[None, :], wx[:, None] * wy[None, :]


def _beckmann_slopes(cosine: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Visible slopes of roughness one along the direction of incidence, and the squares of those across it."""
    from scipy.special import erf, erfinv

    x = np.clip(x, MARGIN, 1.0 - MARGIN)
    tangent = np.sqrt(1.0 - np.minimum(cosine, 1.0) ** 2) / cosine
    cotangent = 1.0 / np.maximum(tangent, 1e-30)
    top = erf(cotangent)
    root = top - (top + 1.0) * erf(np.sqrt(-np.log(x)))
    target = x * (1.0 + top + tangent * np.exp(-(cotangent**2)) / np.sqrt(np.pi))
    for _ in range(STEPS):
        slope = erfinv(root)
        value = 1.0 + root + tangent * np.exp(-(slope**2)) / np.sqrt(np.pi) - target
        root = root - value / (1.0 - slope * tangent)
    return erfinv(root), erfinv(2.0 * np.clip(y, MARGIN, 1.0 - MARGIN) - 1.0) ** 2


def _ggx_slopes(cosine: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same of GGX: a point on the disk, half of which is lifted to the visible part of the sphere."""
    a, b = np.broadcast_arrays(2.0 * x - 1.0, 2.0 * y - 1.0)
    wide = np.abs(a) > np.abs(b)
    r = np.where(wide, a, b)
    angle = 0.25 * np.pi * np.where(wide, b, a) / r
    p = r * np.where(wide, np.cos(angle), np.sin(angle))
    q = r * np.where(wide, np.sin(angle), np.cos(angle))
    s = 0.5 * (1.0 + cosine)
    q = (1.0 - s) * np.sqrt(np.maximum(1.0 - p * p, 0.0)) + s * q
    z = np.sqrt(np.maximum(1.0 - p * p - q * q, 0.0))
    sine = np.sqrt(np.maximum(1.0 - cosine * cosine, 0.0))
    scale = 1.0 / (sine * q + cosine * z)
    return (cosine * q - sine * z) * scale, (p * scale) ** 2


def _masked(distribution: str, alpha: float, z: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Smith's G_1 of directions with the cosines z; 0 below the surface and where the normal does not face them."""
    shown = faces & (z > 0.0)
    z = np.where(shown, z, 1.0)
    tangent2 = np.maximum((alpha * alpha) * (1.0 - z * z), 0.0) / (z * z)
    if distribution == "ggx":
        g = 2.0 / (1.0 + np.sqrt(1.0 + tangent2))
    else:
        a = 1.0 / np.sqrt(np.maximum(tangent2, 0.1))
        g = np.where(a < 1.6, (3.535 * a + 2.181 * a * a) / (1.0 + 2.276 * a + 2.577 * a * a), 1.0)
    return np.where(shown, g, 0.0)
