"""A straight line through media: its crossings with interfaces, which only change the medium, and its transmittance.

The estimators of the boundary term look along lines with known ends, and share this file. Ratio tracking estimates the
transmittance of grids.

Derivation: ``docs/theory/media.md#boundaries-in-media``.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import NO_INTERFACE
from warp_psdr.kernels.medium.coefficients import exp_minus
from warp_psdr.kernels.medium.null_surface import make_null_surface
from warp_psdr.kernels.medium.passage import MOST_INTERFACES, is_lost, medium_towards
from warp_psdr.kernels.medium.tracking import make_tracking
from warp_psdr.kernels.medium.volume import GRID
from warp_psdr.kernels.phase.sggx import make_extinction_along
from warp_psdr.kernels.rng import Sampler, salted
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of

#: Salt of the numbers that estimate the transmittance of lines.
SALT_LINE = wp.constant(wp.uint32(0x1B56C4E9))
#: Lines of a sample: that to a light, that from the near plane, and those from there to the vertices of a walk.
AHEAD, BEFORE, SIGHT = wp.constant(0), wp.constant(1), wp.constant(2)


@wp.struct
class ClearLine:
    """A line up to the first surface that is there."""

    face: wp.int32  # of that surface; -1: there is none on the line
    u: wp.float32
    v: wp.float32
    t: wp.float32  # where it is, or the length
    lost: wp.bool  # it meets a shape that has another medium on this side
    transmittance: wp.vec3
    medium: wp.int32  # at its end
    near: wp.float32  # where the last interface is crossed
    near_face: wp.int32  # -1: none is
    near_u: wp.float32
    near_v: wp.float32


@functools.cache
def make_line(config: PathConfig):
    """Return ``(line, medium_at)``; directions are unit.

    ``line(scene, sampler, number, o, d, t_max, medium, depth) -> ClearLine`` from o, in a medium, on; ``depth``: path
    vertices in front; ``number``: that of the line in its sample, -1: the transmittance of grids is not asked for.
    ``medium_at(scene, o, x, medium) -> int32``: the medium at x, from that at o: of all that lies between, the border
    of a medium that is next to x says it.
    """
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    is_interface, past = make_null_surface(config.surfaces, config.lights)
    assert config.media is not None
    grids = config.media.grids
    extinction_along = make_extinction_along(config.media.phases)
    _tracked_flight, tracked_transmittance = make_tracking(config.media, False)

    @wp.func
    def line(
        scene: Scene,
        sampler: Sampler,
        number: wp.int32,
        o: wp.vec3,
        d: wp.vec3,
        t_max: wp.float32,
        medium: wp.int32,
        depth: wp.int32,
    ) -> ClearLine:
        r = ClearLine()
        r.face = -1
        r.near_face = -1
        r.medium = medium
        r.transmittance = wp.vec3(1.0, 1.0, 1.0)
        start = o
        crossings = wp.int32(0)
        while crossings <= MOST_INTERFACES:
            before = wp.dot(start - o, d)
            hit = visibility.seen(scene, start, d, t_max - before, depth)
            length = wp.where(hit.face >= 0, hit.t, t_max - before)
            in_grid = wp.bool(False)
            if wp.static(grids):
                if r.medium >= 0:
                    m = scene.media.records[r.medium]
                    in_grid = m.sigma_t_channels == GRID
                    if in_grid and number >= 0:
                        stream = salted(sampler, SALT_LINE, number)
                        passed = tracked_transmittance(scene, m, start, d, length, stream, crossings)
                        r.transmittance = wp.cw_mul(r.transmittance, passed)
            if r.medium >= 0 and not in_grid:
                sigma = extinction_along(scene, scene.media.records[r.medium], d).sigma_t
                r.transmittance = wp.cw_mul(r.transmittance, exp_minus(sigma, length))
            r.t = before + length
            crossings += 1
            if is_interface(scene, hit.face):
                at = past(scene, hit.face, hit.u, hit.v, d)
                r.lost = r.lost or is_lost(scene, at.shape, at.ng, d, r.medium) or crossings > MOST_INTERFACES
                r.medium = medium_towards(scene, at.shape, at.ng, d, d, r.medium)
                r.near = r.t
                r.near_face = hit.face
                r.near_u = hit.u
                r.near_v = hit.v
                start = at.o
            else:
                r.face = hit.face
                r.u = hit.u
                r.v = hit.v
                crossings = MOST_INTERFACES + 1
        return r

    @wp.func
    def medium_at(scene: Scene, o: wp.vec3, x: wp.vec3, medium: wp.int32) -> wp.int32:
        way = o - x
        distance = wp.length(way)
        d = way / wp.max(distance, 1.0e-30)
        start = x
        crossings = wp.int32(0)
        while crossings <= MOST_INTERFACES:
            hit = visibility.closest(scene, start, d, distance - wp.dot(start - x, d))
            if hit.face < 0:
                return medium
            at = past(scene, hit.face, hit.u, hit.v, d)
            sides = scene.media.sides[at.shape]
            if sides[0] != NO_INTERFACE:
                return wp.where(wp.dot(at.ng, d) > 0.0, sides[1], sides[0])
            crossings += 1
            start = at.o
        return medium

    return line, medium_at
