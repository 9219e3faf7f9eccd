"""A step of a path among media that move, and the length on which its volume vertex was drawn."""

import functools

import warp as wp

from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.medium.grid_span import span_length, span_of
from warp_psdr.kernels.medium.volume import GRID
from warp_psdr.kernels.path_media import MediaVertex
from warp_psdr.kernels.primitive.dispatch import make_position
from warp_psdr.kernels.reading import texture_record
from warp_psdr.kernels.structs import Scene


@wp.struct
class MovedStep:
    """A step of a path, and what its ray is attached to."""

    step: MediaVertex
    start: wp.vec3  # y: where its direction was drawn
    before: wp.float32  # distance from there to where its flight starts
    reach: wp.float32  # of a volume vertex y the stretch on which it was drawn; 0: none
    face: wp.int32  # z: the first surface behind it that is there; -1: none
    u: wp.float32
    v: wp.float32


@functools.cache
def make_stretch(grids: bool, primitives: tuple[int, ...]):
    """Return ``(stretch_of, reach_of)``; ``grids``: some media are grids.

    ``stretch_of(scene, step) -> (float, float)``: of a flight that a surface or an interface ends the distance of that
    end from y, and the length of the stretch.
    ``reach_of(scene, step) -> float``: the length on which the volume vertex of a step was drawn; 0: no end is known.
    """
    position, _cross_of = make_position(primitives)

    @wp.func
    def stretch_of(scene: Scene, s: MovedStep) -> tuple[wp.float32, wp.float32]:
        vertex = s.step.surface
        far = wp.dot(position(scene.triangles[vertex.face], vertex.u, vertex.v) - s.start, vertex.d)
        # Not the recorded length, which ends a step before the surface: it may be far shorter than what is drawn.
        return far, wp.max(far - s.before, s.step.t)

    @wp.func
    def reach_of(scene: Scene, s: MovedStep) -> wp.float32:
        v = s.step
        r = wp.float32(0.0)
        if v.surface.face >= 0:
            _far, r = stretch_of(scene, s)
        if wp.static(grids):
            m = scene.media.records[v.medium]
            if m.sigma_t_channels == GRID:
                ends = wp.where(v.surface.face >= 0, s.before + r, FAR)
                y = v.surface.o - s.before * v.surface.d
                r = span_length(span_of(scene, texture_record(scene, m.sigma_t), y, v.surface.d, s.before, ends))
        return r

    return stretch_of, reach_of
