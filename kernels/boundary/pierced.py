"""Finds edges that run through another triangle: there surfaces intersect, in a curve that is no edge of either."""

import functools

import warp as wp

from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.kernels.bvh.wide import make_intersect
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.surface import load_vec3

#: Both ends of an edge are left out by this fraction of its length and this many ray epsilons, and so is the rim of a
#: triangle in barycentrics: what merely touches there, like a floor and a box that stands on it, is a contact.
END_FRACTION = 1.0e-3
END_EPSILONS = 10.0
#: Sine of the angle between an edge and a triangle below which the edge lies in the triangle's plane.
PARALLEL = 1.0e-3
#: Hits that are looked at along an edge before it counts as free.
TRIES = 16


@functools.cache
def make_pierced_kernel(backend: str, width: int):
    """Return the kernel: for every edge a triangle that it runs through, or -1."""
    closest_hit, _any_hit = make_intersect(backend, width)

    @wp.kernel(module="unique", enable_backward=False)
    def pierced(
        # Scene:
        scene: Scene,
        edges: Edges,
        # Out:
        face_out: wp.array(dtype=wp.int32),
    ):
        e = wp.tid()
        face_out[e] = -1
        p0 = load_vec3(scene.values, scene.positions + 3 * edges.ends[e, 0])
        p1 = load_vec3(scene.values, scene.positions + 3 * edges.ends[e, 1])
        length = wp.length(p1 - p0)
        end = END_FRACTION * length + END_EPSILONS * scene.ray_epsilon
        if length <= 2.0 * end:
            return
        d = (p1 - p0) / length
        t = end
        for _i in range(TRIES):
            hit = closest_hit(scene.accel, p0 + t * d, d, length - end - t)
            if hit.face < 0:
                return
            own = wp.int32(0)
            for j in range(edges.first[e], edges.first[e + 1]):
                if edges.faces[j] == hit.face:
                    own = 1
            inside = wp.min(wp.min(hit.u, hit.v), 1.0 - hit.u - hit.v) > END_FRACTION
            if own == 0 and inside and wp.abs(wp.dot(scene.triangles[hit.face].normal, d)) > PARALLEL:
                face_out[e] = hit.face
                return
            t += hit.t + scene.ray_epsilon
            if t >= length - end:
                return

    return pierced
