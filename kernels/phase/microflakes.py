"""The matrix S of microflakes at a point of a medium, constant or a grid, and the sinks for its adjoints.

One S serves a whole medium, or S is a grid (``medium/volume.py``) of six channels that are interpolated one by one:
interpolation of positive definite matrices stays positive definite. Extinction is sigma_t A(x, d), which tracking
follows. Its rate holds a bound on A: A itself if there is one S, and for a grid the largest A of its voxels and all
directions, sqrt(max lambda(S)), at the flat offset ``Texture.second`` (A^2 is linear in S).

Derivation: ``docs/theory/media.md#microflakes``.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.constants import PHASE_SGGX, PHASE_SGGX_GRID
from warp_psdr.kernels.medium.volume import Voxels, grid_point, trilinear, voxels_at
from warp_psdr.kernels.phase.sggx import Flakes, adjugate_times, flake_area, flakes_of, half_vector, sggx_eval
from warp_psdr.kernels.reading import load_float, texture_record
from warp_psdr.kernels.sink import make_sink_vec3
from warp_psdr.kernels.structs import Medium, Scene, Texture

FLAKES = (PHASE_SGGX, PHASE_SGGX_GRID)


def has_flakes(kinds: tuple[int, ...]) -> bool:
    """Whether some of the kinds of phase functions (PHASE_*) are microflakes."""
    return any(kind in FLAKES for kind in kinds)


@wp.struct
class FlakeAdjoint:
    """Adjoint of S."""

    diagonal: wp.vec3  # of S_xx, S_yy, S_zz
    beside: wp.vec3  # of S_xy, S_xz, S_yz, each of which stands in S twice


@wp.func
def outer_adjoint(v: wp.vec3, w: wp.float32) -> FlakeAdjoint:
    """``w`` is the adjoint of v^T S v."""
    a = FlakeAdjoint()
    a.diagonal = w * wp.cw_mul(v, v)
    a.beside = (2.0 * w) * wp.vec3(v[0] * v[1], v[0] * v[2], v[1] * v[2])
    return a


@wp.func
def voxel_flakes(values: wp.array(dtype=wp.float32), v: Voxels) -> Flakes:
    """S of a grid, interpolated."""
    s = Flakes()
    xy = trilinear(values, v, 3)
    xz = trilinear(values, v, 4)
    yz = trilinear(values, v, 5)
    s.x = wp.vec3(trilinear(values, v, 0), xy, xz)
    s.y = wp.vec3(xy, trilinear(values, v, 1), yz)
    s.z = wp.vec3(xz, yz, trilinear(values, v, 2))
    return s


class Microflakes(NamedTuple):
    """Warp functions of the media of a scene; ``d`` is the unit direction of a ray.

    Attributes:
        is_flakes: ``(m) -> bool``: whether a medium has microflakes.
        at: ``(scene, m, x) -> Flakes``: S of such a medium at a point.
        area_at: ``(scene, m, x, d) -> float32``: A there, 1 in other media.
        most_area: ``(scene, m, d) -> float32``: no A of the medium along d is larger.
    """

    is_flakes: wp.Function
    at: wp.Function
    area_at: wp.Function
    most_area: wp.Function


@functools.cache
def make_microflakes(kinds: tuple[int, ...]) -> Microflakes:
    """Return the functions for the kinds (PHASE_*) of a scene."""
    constant, varies = PHASE_SGGX in kinds, PHASE_SGGX_GRID in kinds

    @wp.func
    def is_flakes(m: Medium) -> wp.bool:
        found = wp.bool(False)
        if wp.static(constant):
            found = m.phase == PHASE_SGGX
        if wp.static(varies):
            found = found or m.phase == PHASE_SGGX_GRID
        return found

    @wp.func
    def flakes_at(scene: Scene, m: Medium, x: wp.vec3) -> Flakes:
        if wp.static(varies):
            if m.phase == PHASE_SGGX_GRID:
                g = texture_record(scene, m.g)
                return voxel_flakes(scene.values, voxels_at(g, grid_point(scene, g, x)))
        return flakes_of(scene, m.g)

    @wp.func
    def area_at(scene: Scene, m: Medium, x: wp.vec3, d: wp.vec3) -> wp.float32:
        if is_flakes(m):
            return flake_area(flakes_at(scene, m, x), d)
        return 1.0

    @wp.func
    def most_area(scene: Scene, m: Medium, d: wp.vec3) -> wp.float32:
        if wp.static(varies):
            if m.phase == PHASE_SGGX_GRID:
                return load_float(scene.values, texture_record(scene, m.g).second)
        return area_at(scene, m, d, d)

    return Microflakes(is_flakes, flakes_at, area_at, most_area)


@functools.cache
def make_flake_sinks(kinds: tuple[int, ...], role: str):
    """Return ``(accumulate_sggx, accumulate_area)``; x is a point of the medium.

    ``accumulate_sggx(scene, target, m, x, d, wo, w) -> float32``: ``w`` is the adjoint of the value.
    ``accumulate_area(scene, target, m, x, d, w) -> float32``: ``w`` is A(x, d) times its own adjoint.
    """
    sink3 = make_sink_vec3(role)
    flakes_at = make_microflakes(kinds).at
    varies = PHASE_SGGX_GRID in kinds

    @wp.func
    def accumulate_voxels(target: wp.array(dtype=wp.float32), g: Texture, p: wp.vec3, a: FlakeAdjoint) -> wp.float32:
        """``a`` is the adjoint of S at p, in voxels."""
        v = voxels_at(g, p)
        total = wp.float32(0.0)
        corners = wp.int32(8)
        for corner in range(corners):
            x = wp.float32(corner % 2)
            y = wp.float32((corner // 2) % 2)
            z = wp.float32(corner // 4)
            share = wp.lerp(1.0 - v.f[0], v.f[0], x) * wp.lerp(1.0 - v.f[1], v.f[1], y)
            share *= wp.lerp(1.0 - v.f[2], v.f[2], z)
            if share != 0.0:
                voxel = wp.where(x > 0.0, v.x1, v.x0) + wp.where(y > 0.0, v.y1, v.y0) + wp.where(z > 0.0, v.z1, v.z0)
                total += sink3(target, voxel, share * a.diagonal) + sink3(target, voxel + 3, share * a.beside)
        return total

    @wp.func
    def accumulate_flakes(
        scene: Scene, target: wp.array(dtype=wp.float32), m: Medium, x: wp.vec3, a: FlakeAdjoint
    ) -> wp.float32:
        if wp.static(varies):
            if m.phase == PHASE_SGGX_GRID:
                g = texture_record(scene, m.g)
                return accumulate_voxels(target, g, grid_point(scene, g, x), a)
        return sink3(target, m.g, a.diagonal) + sink3(target, m.g + 3, a.beside)

    @wp.func
    def accumulate_area(
        scene: Scene, target: wp.array(dtype=wp.float32), m: Medium, x: wp.vec3, d: wp.vec3, w: wp.float32
    ) -> wp.float32:
        area = flake_area(flakes_at(scene, m, x), d)
        return accumulate_flakes(scene, target, m, x, outer_adjoint(d, 0.5 * w / (area * area)))

    @wp.func
    def accumulate_sggx(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        m: Medium,
        x: wp.vec3,
        d: wp.vec3,
        wo: wp.vec3,
        w: wp.float32,
    ) -> wp.float32:
        s = flakes_at(scene, m, x)
        a_log = w * sggx_eval(s, d, wo)
        h = half_vector(d, wo)
        area = flake_area(s, d)
        yz = wp.cross(s.y, s.z)
        zx = wp.cross(s.z, s.x)
        inverse = 1.0 / wp.dot(s.x, yz)
        b = inverse * adjugate_times(s, h)
        # d ln f = 2 (S^-1 h)^T dS (S^-1 h) / (h^T S^-1 h) - tr(S^-1 dS) / 2 - d ln A
        turned = outer_adjoint(b, 2.0 * a_log / wp.dot(h, b))
        seen = outer_adjoint(d, -0.5 * a_log / (area * area))
        trace = -0.5 * inverse * a_log
        a = FlakeAdjoint()
        a.diagonal = turned.diagonal + seen.diagonal + trace * wp.vec3(yz[0], zx[1], wp.cross(s.x, s.y)[2])
        a.beside = turned.beside + seen.beside + (2.0 * trace) * wp.vec3(yz[1], yz[2], zx[2])
        return accumulate_flakes(scene, target, m, x, a)

    return accumulate_sggx, accumulate_area
