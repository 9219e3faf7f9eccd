"""Paths of two vertices behind the camera and longer ones apart: the direct and the indirect boundary.

A boundary segment x_1 -> x_2 whose x_1 is the k-th vertex as counted from the camera brings W_k L_k (``transport.py``),
where L_k holds what x_2 sends by itself, E_2, wherever a path may have k + 1 vertices, and what it scatters, R_k.
Linear in L, the term is the sum of

    direct boundary:    W_1 E_2,                            all that is left of it at max_depth = 2,
    indirect boundary:  W_1 R_1 + sum over k > 1 of W_k L_k,

which may be estimated by independent samples of any densities that are positive where their integrands are not zero:
the sum of the two means is the whole term, the sum of their variances that of its estimate. The direct part is the
estimator with max_depth = 2. For the indirect one, what that estimator would count is taken from what a path brings
behind one vertex. Both follow the same path, which starts with x_2: the difference is R_1 path by path, and nothing is
left of the variance of E_2.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.detector import ROW_COUNT, ROWS, Incident, arriving
from warp_psdr.kernels.boundary.transport import Segment
from warp_psdr.kernels.rng import Sampler
from warp_psdr.kernels.structs import Scene

#: Most vertices of the paths that are left out.
DIRECT = 2


@wp.func
def less(incident: Incident, sent: wp.vec3) -> Incident:
    """What arrives behind one vertex and more, without ``sent`` behind one; behind many, another path is asked for."""
    r = Incident()
    r.first = incident.first
    rows = ROWS()
    for i in range(ROW_COUNT):
        row = arriving(incident, incident.first + i)
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
            r = less(r, arriving(direct, k))
        return r

    return indirect
