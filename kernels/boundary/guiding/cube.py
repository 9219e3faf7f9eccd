"""The unit cube of segments that touch a shape without triangles: the random numbers of their unguided sampler.

A segment has the coordinates (u_0, u_1, u_2): the item of the shape with a position on it, and a direction of its own
or a point of a light. Each of these two techniques has cells. The weights between the techniques are those of unguided
sampling, so a point of the cube needs no inverse: guiding divides the unguided result there by the density of the
cells.

Derivation: ``docs/theory/guiding.md#shapes-without-triangles``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.guiding.cells import sample_cells
from warp_psdr.kernels.boundary.guiding.techniques import Guide, octant_point
from warp_psdr.kernels.boundary.transport import Segment
from warp_psdr.kernels.primitive.dispatch import make_point_at
from warp_psdr.kernels.structs import Scene

#: Numbers that describe the ends of a segment (``make_ends``).
END_NUMBERS = 9


@wp.struct
class CubePoint:
    """A point of the cube.

    ``weight``: the technique's share without guiding, over the density of the point with it.
    """

    u: wp.vec3d
    own: wp.bool  # the direction is its own, not towards a light
    weight: wp.float32


@functools.cache
def make_cube(evaluates: bool):
    """Return ``cube(guide, share, number, samples, u4) -> CubePoint``, ``share`` that of the own directions.

    Of ``samples`` stratified ones; with ``evaluates`` a point that ``guide`` gives, as in ``techniques.py``.
    """

    @wp.func
    def cube(guide: Guide, share: wp.float32, number: wp.int32, samples: wp.int32, u4: wp.vec4) -> CubePoint:
        r = CubePoint()
        if wp.static(evaluates):
            if guide.points.shape[0] > 0:
                r.u = guide.points[number]
            else:
                box = number // samples
                r.u = octant_point(guide.low[box], guide.high[box], (number - box * samples) % 8, u4)
            r.own = guide.technique == 1
            r.weight = wp.where(r.own, share, 1.0 - share)
        else:
            v = (wp.float64(number) + wp.float64(u4[0])) / wp.float64(samples)
            chance = wp.float64(guide.share)
            jitter = wp.vec3(u4[1], u4[2], u4[3])
            r.own = v < chance
            if r.own:
                at = sample_cells(guide.wedge, v / chance, jitter)
                r.u = at.u
                r.weight = share / (guide.share * at.pdf)
            else:
                at = sample_cells(guide.light, (v - chance) / (wp.float64(1.0) - chance), jitter)
                r.u = at.u
                r.weight = (1.0 - share) / ((1.0 - guide.share) * at.pdf)
        return r

    return cube


@functools.cache
def make_ends(primitives: tuple[int, ...]):
    """Return ``ends(scene, out, number, segment, scale)``: what a grid asks its photon maps (``ends.py``).

    ``END_NUMBERS`` a segment: scale, what x_2 emits, whether x_2 scatters, x_1, x_2.
    """
    point_at = make_point_at(primitives)

    @wp.func
    def ends(scene: Scene, out: wp.array(dtype=wp.float32), number: wp.int32, s: Segment, scale: wp.float32):
        first = number * wp.static(END_NUMBERS)
        x1 = point_at(scene, scene.triangles[s.face1], s.u1, s.v1)
        out[first] = scale
        out[first + 1] = s.radiance[0] + s.radiance[1] + s.radiance[2]
        if s.light < 0 and s.face2 >= 0:
            x2 = point_at(scene, scene.triangles[s.face2], s.u2, s.v2)
            out[first + 2] = 1.0
            for a in range(3):
                out[first + 6 + a] = x2[a]
        for a in range(3):
            out[first + 3 + a] = x1[a]

    return ends
