"""The direct and the indirect boundary: paths of two vertices behind the camera, apart from longer ones.

The direct boundary is W_1 E_2, the light that x_2 emits towards a vertex that the camera sees. The indirect boundary is
the rest. Independent samples estimate the two parts, whose means add up to the whole term.

Derivation: ``docs/theory/boundary.md#direct-and-indirect-boundary``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.detector import ROW_COUNT, ROWS, Incident, radiance_behind
from warp_psdr.kernels.boundary.transport import Segment
from warp_psdr.kernels.rng import Sampler
from warp_psdr.kernels.structs import Scene

#: Most vertices of the paths that are left out.
DIRECT = 2


@wp.func
def subtract(incident: Incident, sent: wp.vec3) -> Incident:
    """What arrives behind one vertex and more, without ``sent`` behind one; behind many, another path is asked for."""
    r = Incident()
    r.first = incident.first
    rows = ROWS()
    for i in range(ROW_COUNT):
        row = radiance_behind(incident, incident.first + i)
        if i == 0:
            row -= sent
        for c in range(3):
            rows[i, c] = row[c]
    r.rows = rows
    return r


@functools.cache
def make_indirect(source: wp.Function):
    """Return a source of radiance (``transport.make_source`` or its like) without E_2 behind one vertex."""

    @wp.func
    def indirect(
        scene: Scene, sampler: Sampler, s: Segment, k: wp.int32, max_depth: wp.int32, rr_depth: wp.int32
    ) -> Incident:
        r = source(scene, sampler, s, k, max_depth, rr_depth)
        if k == 1:
            direct = source(scene, sampler, s, k, DIRECT, rr_depth)
            r = subtract(r, radiance_behind(direct, k))
        return r

    return indirect
