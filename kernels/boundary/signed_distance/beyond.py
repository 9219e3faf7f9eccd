"""The target of rays from path vertices: the sky, or a flat light whose points do not move with the ray.

Light points are material points, as for the interior term, so domains end at the border of the light, whatever moves.
The motion of rays must therefore vanish at that border, but not where it meets a silhouette. It is multiplied by b / (b
+ s), where b is the distance from the border and s that from the silhouette.

Derivation: ``docs/theory/signed_distances.md#shadows-by-moving-rays``.
"""

import warp as wp

from warp_psdr.kernels.boundary.signed_distance.march import across
from warp_psdr.kernels.boundary.signed_distance.warp_field import Beyond
from warp_psdr.kernels.structs import Emitter, Scene, Triangle

#: Unit of the distance from the border, over the root of a triangle's doubled area.
STRIP = 0.25


@wp.func
def light_corner(tri: Triangle, k: wp.int32) -> wp.vec3:
    """Corner k modulo 3 of a triangle."""
    p = tri.p0
    if k % 3 == 1:
        p = tri.p1
    if k % 3 == 2:
        p = tri.p2
    return p


@wp.func
def is_inner(scene: Scene, e: Emitter, face: wp.int32, a: wp.vec3, b: wp.vec3) -> wp.bool:
    """Whether the edge from a to b of a light's triangle is one of another of its triangles."""
    for other in range(e.first_face, e.first_face + e.face_count):
        if other != face:
            tri = scene.triangles[other]
            has_a = tri.p0 == a or tri.p1 == a or tri.p2 == a
            has_b = tri.p0 == b or tri.p1 == b or tri.p2 == b
            if has_a and has_b:
                return True
    return False


@wp.func
def light_beyond(scene: Scene, e: Emitter, y: wp.vec3, o: wp.vec3, w: wp.vec3) -> Beyond:
    """A point y of a flat convex light, as a ray o + t w meets it."""
    r = Beyond()
    first = scene.triangles[e.first_face]
    d = wp.length(y - o)
    r.inverse = 1.0 / d
    slope = across(w, first.normal) / wp.dot(first.normal, w)
    r.inverse_w = (1.0 / d) * slope
    d_w = -d * slope
    width = STRIP * wp.sqrt(wp.length(wp.cross(first.p1 - first.p0, first.p2 - first.p0)))
    r.bordered = 1
    r.border = 1.0e6
    for face in range(e.first_face, e.first_face + e.face_count):
        tri = scene.triangles[face]
        c = wp.cross(tri.p1 - tri.p0, tri.p2 - tri.p0)
        for k in range(3):
            a = light_corner(tri, k)
            b = light_corner(tri, k + 1)
            if not is_inner(scene, e, face, a, b):
                inwards = wp.normalize(wp.cross(c, b - a)) / width
                depth = wp.dot(inwards, y - a)
                if depth < r.border:
                    r.border = wp.max(depth, 0.0)
                    r.border_w = d * across(w, inwards) + wp.dot(inwards, w) * d_w
    return r
