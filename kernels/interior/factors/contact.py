"""Contacts: the weight that removes fireflies of the interior term where a moving surface touches another.

Near a line of contact of two surfaces that move against each other, a sample is as large as v / r and has no finite
variance. The part that this relative motion changes is therefore multiplied by chi = 3 (s / rho)^2 where s < rho, and
by 1 elsewhere; s is the distance from the line of contact. The mean of chi is one, and its bias is of second order in
rho.

Derivation: ``docs/theory/interior.md#contacts``.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import EMITTER_AREA
from warp_psdr.kernels.math import where3
from warp_psdr.kernels.primitive.affine import is_primitive_at
from warp_psdr.kernels.step import leaving_step
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.surface import point_on
from warp_psdr.kernels.vertex import PathVertex
from warp_psdr.kernels.visibility import make_visibility

#: Of the angle between two surfaces. Between planes nearer to parallel, chi goes by it and is at most 1.
LEAST_SINE = 0.1
#: Of the angle between two planes: below it they have no line in common that float32 could find.
PARALLEL = 1.0e-3
#: Rise over run of the ray that looks for the contact.
SLOPE = 0.1
#: Length of the ray over the distance to where the planes meet, below which what it found is not what is there.
LEAST_SHARE = 0.4
#: What float32 adds, in steps by which rays leave surfaces.
WAVER = 0.1
#: In q's own widths: how far from its plane contacts are looked for, where its facet may be narrower than theirs.
REACH = 4.0


@wp.struct
class ContactWedge:
    """Two planes, and a connection between a point of each."""

    n: wp.vec3  # normals that face the wedge between the planes
    m: wp.vec3
    p: wp.vec3
    r: wp.vec3  # q - p
    cosine: wp.float32  # of the angle between the normals, and its sine
    sine: wp.float32
    a: wp.float32  # distance of p from the plane of q
    t: wp.float32  # s, or less where the planes are close to parallel


@wp.func
def wedge_between(n: wp.vec3, corner: wp.vec3, m: wp.vec3, o: wp.vec3, q: wp.vec3) -> ContactWedge:
    """The planes have the normals n, through ``corner``, and m, through q; o is p or a step off it."""
    w = ContactWedge()
    w.p = o + wp.dot(n, corner - o) * n
    w.r = q - w.p
    w.n = where3(wp.dot(n, w.r) < 0.0, -n, n)
    w.m = where3(wp.dot(m, w.r) > 0.0, -m, m)
    w.cosine = wp.dot(w.n, w.m)
    w.sine = wp.length(wp.cross(w.n, w.m))
    w.a = -wp.dot(w.m, w.r)
    w.t = w.a / wp.max(w.sine, LEAST_SINE)
    return w


@wp.func
def may_touch(w: ContactWedge, rho_p: wp.float32, rho_q: wp.float32) -> wp.bool:
    """Whether chi may not be 1; ``rho_p`` and ``rho_q`` are ``Scene.contact_ratio`` times the radii at p and q."""
    return not (w.t >= rho_p or w.t >= REACH * rho_q or w.sine < PARALLEL)


@wp.func
def no_weight_before(scene: Scene, vertex: PathVertex) -> wp.float32:
    """The weight of a vertex that its ray finds: such connections have no fireflies."""
    return 1.0


@wp.func
def no_weight_of_light(scene: Scene, vertex: PathVertex, x: wp.vec3) -> wp.float32:
    """The same of a light."""
    return 1.0


@functools.cache
def make_contact_weights(backend: str, width: int, primitives: tuple[int, ...] = ()) -> tuple[wp.Function, wp.Function]:
    """Return two functions of the weight chi; arguments as of ``make_visibility``. On curved shapes chi is 1.

    ``weight_before(scene, vertex)``: of the connection by which a vertex was found.
    ``weight_of_light(scene, vertex, x)``: of that of a vertex, at x, with the light found by next-event estimation.
    """
    closest_hit = make_visibility(backend, width).closest

    @wp.func
    def found_ahead(
        scene: Scene, p: wp.vec3, n: wp.vec3, ahead: wp.vec3, reach: wp.float32, step: wp.float32, shape: wp.int32
    ) -> wp.int32:
        """Triangle of a shape that a ray finds which leaves a plane flatly, and which meets the plane; -1: none."""
        hit = closest_hit(scene, p + step * n, wp.normalize(ahead + SLOPE * n), reach)
        if hit.face < 0:
            return -1
        found = scene.triangles[hit.face]
        sine = wp.length(wp.cross(n, found.normal))
        a = wp.abs(wp.dot(found.normal, found.p0 - p))
        if found.shape != shape or sine < PARALLEL or hit.t * sine < LEAST_SHARE * a - WAVER * step:
            return -1
        return hit.face

    @wp.func
    def contact_weight(scene: Scene, p_face: wp.int32, q_face: wp.int32, o: wp.vec3, q: wp.vec3) -> wp.float32:
        """Weight chi of a connection with q that starts at o, on p's triangle or a step off it."""
        near = scene.triangles[p_face]
        w = wedge_between(near.normal, near.p0, scene.triangles[q_face].normal, o, q)
        rho = scene.contact_ratio * scene.radii[p_face]
        if not may_touch(w, rho, scene.contact_ratio * scene.radii[q_face]):
            return 1.0
        t = w.t
        step = wp.max(leaving_step(scene, p_face), leaving_step(scene, q_face))
        if w.a + step * w.cosine > 0.0:
            # Across the line of both planes, in that of p and in that of q.
            ahead = (w.cosine * w.n - w.m) / w.sine
            back = (w.n - w.cosine * w.m) / w.sine
            line = wp.cross(w.n, ahead)
            s = w.a / w.sine
            reach = 2.0 * (s + rho)
            other = scene.triangles[q_face].shape
            met = found_ahead(scene, w.p + wp.dot(w.r, line) * line, w.n, ahead, reach, step, other)
            if met < 0:
                return 1.0
            own = scene.triangles[p_face].shape
            left = found_ahead(scene, w.p + s * (ahead + back), w.m, -back, reach, step, own)
            if left < 0:
                return 1.0
            rho = wp.min(rho, scene.contact_ratio * wp.min(scene.radii[met], scene.radii[left]))
            if t >= rho:
                return 1.0
        t /= rho
        return wp.min(3.0 * t * t, wp.where(w.sine < LEAST_SINE, 1.0, 3.0))

    @wp.func
    def weight_before(scene: Scene, vertex: PathVertex) -> wp.float32:
        if vertex.face < 0 or vertex.previous_face < 0:
            return 1.0
        if wp.static(len(primitives) > 0):
            if is_primitive_at(scene, vertex.face) or is_primitive_at(scene, vertex.previous_face):
                return 1.0
        x = point_on(scene.triangles[vertex.face], vertex.u, vertex.v)
        return contact_weight(scene, vertex.previous_face, vertex.face, vertex.o, x)

    @wp.func
    def weight_of_light(scene: Scene, vertex: PathVertex, x: wp.vec3) -> wp.float32:
        if scene.emitters[vertex.light].kind != EMITTER_AREA:
            return 1.0
        if wp.static(len(primitives) > 0):
            if is_primitive_at(scene, vertex.face) or is_primitive_at(scene, vertex.light_face):
                return 1.0
        y = point_on(scene.triangles[vertex.light_face], vertex.light_u, vertex.light_v)
        return contact_weight(scene, vertex.face, vertex.light_face, x, y)

    return weight_before, weight_of_light
