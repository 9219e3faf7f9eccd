"""Concave edges: how close to an edge rays may look at its two sides where surfaces meet at an acute angle.

A ray that leaves a surface starts one step off it. Next to a concave edge, this start may lie behind another surface
that rises from the first at an acute angle. There, rays pass ``INTO`` steps from the edge, where they meet the first
surface in front of the other.

Derivation: ``docs/theory/boundary.md#concave-edges``.
"""

import warp as wp

from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.kernels.constants import LOBE_BEHIND, LOBE_DELTA_TRANSMISSION, LOBE_NULL
from warp_psdr.kernels.structs import Scene

#: Distance in steps at which rays pass the edge of a notch that they look into.
INTO = 1.5
#: Cosine of the least angle that is none: at right angles up to roundings, every distance is enough.
RIGHT = 0.02
#: Times by which it is larger than needed in one behind, and its most, where surfaces nearly touch.
BEHIND, MOST = 2.0, 100.0


@wp.func
def facing(n: wp.vec3, d: wp.vec3) -> wp.vec3:
    """The normal of the side at which a ray along d arrives."""
    return wp.where(wp.dot(n, d) > 0.0, -n, n)


@wp.func
def behind(n_a: wp.vec3, n_b: wp.vec3) -> wp.float32:
    return wp.min(BEHIND * wp.abs(wp.dot(n_a, n_b)) / wp.length(wp.cross(n_a, n_b)), MOST)


@wp.func
def shines(scene: Scene, face: wp.int32) -> wp.bool:
    return scene.shapes[scene.triangles[face].shape].emitter >= 0


@wp.func
def refracts(scene: Scene, face: wp.int32) -> wp.bool:
    lobes = scene.bsdfs[scene.shapes[scene.triangles[face].shape].bsdf].lobes
    return (((lobes >> LOBE_DELTA_TRANSMISSION) | (lobes >> LOBE_NULL) | (lobes >> LOBE_BEHIND)) & 1) == 1


@wp.func
def let_through(scene: Scene, face_a: wp.int32, face_b: wp.int32, hidden: wp.bool) -> wp.bool:
    """Whether light from behind one of two surfaces that cross is seen in front of it; ``hidden``: lights are."""
    lights = hidden and (shines(scene, face_a) or shines(scene, face_b))
    return lights or refracts(scene, face_a) or refracts(scene, face_b)


@wp.func
def concave_distance(n_a: wp.vec3, n_b: wp.vec3, through: wp.bool) -> wp.float32:
    """Distance in steps at which rays pass the line at which two surfaces meet in front of them; 0: at any.

    The normals face the rays. ``through``: the surfaces go on, and light from behind counts.
    """
    r = wp.where(wp.dot(n_a, n_b) < -RIGHT, INTO, 0.0)
    if through:
        r = wp.max(r, behind(n_a, n_b))
    return r


@wp.func
def is_ridge(n_a: wp.vec3, n_b: wp.vec3, m: wp.vec3, d: wp.vec3) -> wp.bool:
    """Whether a ray along d looks at an edge between surfaces from outside of their angle; m: towards the first one.

    The second one leaves the edge along t = -m + d (n_b . m) / (n_b . d), which is behind the first one: n_a . t < 0.
    """
    return wp.dot(wp.cross(n_a, n_b), wp.cross(m, d)) < 0.0


@wp.func
def sharp_glass(scene: Scene, edges: Edges, edge: wp.int32) -> wp.float32:
    """The same for a ray that enters glass beside an edge of it; 0: at any distance, or it is none."""
    first = edges.first[edge]
    # A curve of intersection is no edge of the shapes that it has its faces from.
    if edges.ends[edge, 0] < 0 or edges.first[edge + 1] - first != 2:
        return 0.0
    a = scene.triangles[edges.faces[first]]
    b = scene.triangles[edges.faces[first + 1]]
    if not refracts(scene, edges.faces[first]) or wp.dot(a.normal, b.normal) >= 0.0:
        return 0.0
    return behind(a.normal, b.normal)
