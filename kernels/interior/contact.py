"""Contacts: the interior term's fireflies where a moving surface touches another, and what is done about them.

In material form the geometric factor between a path vertex p and the next one q, towards the source, changes by the
rate dG/G ~ v / r when q moves relative to p with v, r = |q - p|. Paths are drawn with a density proportional to G, so a
sample is as large as v / r. Near a line of contact of the two surfaces r gets as small as the distance a of p from the
surface of q, and a is spread evenly: the samples have a tail P(|X| > t) ~ 1/t and no variance. Their mean exists in the
order in which a path is drawn, p first: with b the distance of q from the surface of p, G = a b / r^4, and the
integral over q of dG/da at a fixed a is dF/da, F(a) the form factor of q's surface, which is smooth down to a = 0.
(The jump F(0+) itself is the boundary term's: the segment p -> q whose end q is the contact, ``boundary/local_form``.)

So what changes because the two move against each other is multiplied by

    chi = 3 (s / rho)^2 where s < rho, 1 elsewhere,    s = a / sin(theta),

a the distance of p from the tangent plane of q, theta the angle between the two surfaces: s is how far p is from the
line where they meet, and infinite in a gap between parallel ones, where r has a bound, the gap's width. (Near
those sin(theta) counts as ``LEAST_SINE``, and chi is at most 1.) It is dG/G but for the rate of the area around q, and
the turn of the direction in the frames of p and of q. Each is complete with the turn of the surfaces themselves: where
all turn together they are 0, and chi changes nothing.

Where q's surface is flat over lengths rho, chi is constant for a given p, and what is lost is the integral of
(1 - chi) dF/da over s < rho. That holds for a weight which depends on a alone; a cut at a fixed r would leave an error
that does not vanish with rho. The mean of chi over s < rho is 1, so what is lost is of second order: with L the size
of the surfaces, 1/4 (rho / L)^2 of L d^2F/da^2. (Among the weights with that mean this one has the least integral of
(chi / s)^2, hence the least noise.) Where light was scattered nearby just before, s is not spread evenly but with a
logarithm, ln(L / s), of which a first order is left: 2/3 rho / L of that part. This is the mean over the strip s < rho;
pixels that resolve it see chi. The part v / a of a sample is at most some v / rho; that of directions which graze p, as
q lifts off its plane, has a logarithmic tail of its own.

Where F varies within rho, that part of its derivative is wrong, and what is lost may be all: next to a sheet of paper
that slides over a table, F falls from F(0+) to 0 within the height of the paper's rim, and of the two terms that nearly
cancel in the mean only the boundary's would be left. So rho goes by the surfaces themselves: it is
``Scene.contact_ratio`` times the smaller radius at p and where they meet (``warp_psdr.topology.patches``), whatever
shapes they belong to; and a speck in the scene does not make the corners of its rooms noisy.

For the same reason chi is 1 where the surfaces do not meet: next to a wall that ends g above the floor, F(0+) is 0 and
F rises within a ~ g. Whether they do must not depend on where on its surface q is: of the changes v / r at a given p
only the sum over q is small. So two rays ask for it, each along one of the planes but for a rise of ``SLOPE``: one from
p, or rather next to q, as far along the line of both planes (past the end of a contact chi is then what it is before,
and as F falls on the one side and rises on the other, what is lost cancels), and one from the plane of q, as far from
the line as p. Each has to find the shape of the other, and the radii are those of what they find. Next to a gap they
pass below for a < g / ``SLOPE``; next to an edge that is rounded with radius g they find that, with a rho much smaller
than g: chi is 1 until F has risen. The mean of chi is not 1 then, but at most 1.39 (where that ends at 0.58 rho), in
front of a derivative that is smooth at this distance: 0.39 rho / L of it. The samples are as large as v / g, and are
many. On surfaces that bend away from the contact, F falls with the root of a, and the s of their triangles grow from
the contact on; 1 % of F(0+) is lost at rho = R / 25.

Cameras, mirrors and glass need no weight: what they meet has no density G.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import EMITTER_AREA
from warp_psdr.kernels.math import where3
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


@functools.cache
def make_contact_weights(backend: str, width: int) -> tuple[wp.Function, wp.Function]:
    """Return two functions of the weight chi; backend and width as of ``make_visibility``.

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
        if vertex.face < 0 or vertex.before < 0:
            return 1.0
        x = point_on(scene.triangles[vertex.face], vertex.u, vertex.v)
        return contact_weight(scene, vertex.before, vertex.face, vertex.o, x)

    @wp.func
    def weight_of_light(scene: Scene, vertex: PathVertex, x: wp.vec3) -> wp.float32:
        if scene.emitters[vertex.light].kind != EMITTER_AREA:
            return 1.0
        y = point_on(scene.triangles[vertex.light_face], vertex.light_u, vertex.light_v)
        return contact_weight(scene, vertex.face, vertex.light_face, x, y)

    return weight_before, weight_of_light
