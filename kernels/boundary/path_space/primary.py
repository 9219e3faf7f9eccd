"""Primary boundary: discontinuities of the radiance on the film, for the pixel filter h.

dI_j = integral h(u - u_j) (L_- - L_+) (u' . N) ds over the edges' images u on the film [LADL18]. The two radiances are
path-traced along rays that pass the edge on either side. Common random numbers cancel whatever does not jump.

Derivation: ``docs/theory/boundary.md#primary-boundary``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.coincident import make_lit_along, make_shadow_along
from warp_psdr.kernels.boundary.concave_edge import concave_distance, facing, is_ridge, let_through, sharp_glass, shines
from warp_psdr.kernels.boundary.detector import IncidentRadiance, make_incident_radiance
from warp_psdr.kernels.boundary.film_edge import (
    AHEAD,
    BESIDE,
    NEXT,
    OWN,
    bends,
    make_film_edge,
    rays_beside,
)
from warp_psdr.kernels.boundary.local_form import (
    CURVE,
    EdgePoint,
    Edges,
    barycentrics_at,
    is_pierced,
    on_plane,
    on_planes,
    own_face,
)
from warp_psdr.kernels.boundary.media_radiance import make_media_radiance
from warp_psdr.kernels.boundary.path_space.timed_primary import make_timed_primary_kernel
from warp_psdr.kernels.constants import DELTA_LIGHTS
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.medium.line import BEFORE, make_line
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.primitive.affine import is_primitive, is_primitive_at, triangle_or_none
from warp_psdr.kernels.primitive.dispatch import make_normal_at
from warp_psdr.kernels.property import make_beside_edge
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.step import leaving_step
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig

#: Sine of the angle at a curve of intersection from which on rays pass it as close as an edge. At smaller angles they
#: do where the surfaces are as far apart as there, up to so many ray epsilons: nearer, roundings decide which is in
#: front.
ACUTE, BESIDE_CURVE = 0.01, 10.0
#: Distance at which rays pass a silhouette along which shadows of point, spot and directional lights fall, in the steps
#: by which rays leave what is met (``coincident.py``). Light may fall at 70 degrees to the normal.
LIT = 3.0
#: Up to what distance another shape's edge runs along this one: as seen, in roundings of coordinates, if that is more
#: than the rays' distance; in space, over that. (One far behind it is hidden, and does not count the jump.)
ROUNDING, ALONG = 2.0e-7, 10.0


@functools.cache
def make_primary_kernel(config: PathConfig, role: str, camera_moves: bool):
    """Return the kernel of the primary boundary term: one thread a sample (arguments as in ``secondary.py``).

    Before a transient film it is that of ``timed_primary.py``.
    """
    surface_at = make_interaction(config.surfaces, config.lights).surface
    among_media = config.media is not None
    media_radiance = make_media_radiance(config) if among_media else None
    line = make_line(config)[0] if among_media else None
    incident_radiance = None if among_media else make_incident_radiance(config)
    normal_at = make_normal_at(config.surfaces.primitives)
    find, accumulate, accumulate_side = make_film_edge(config, role, camera_moves)
    _own, behind = make_beside_edge(config.shown)
    has_delta_lights = bool(DELTA_LIGHTS & set(config.lights.others)) and not among_media
    lit_along = make_lit_along(config.lights.others) if has_delta_lights else None
    shadow_along = make_shadow_along(config) if has_delta_lights else None

    @wp.func
    def seen_as(scene: Scene, seen: IncidentRadiance, d: wp.vec3) -> wp.int32:
        """Number of the shape that a ray meets, from one, negative on the back of its normals; 0: none."""
        if seen.face < 0:
            return 0
        if wp.static(len(config.surfaces.primitives) > 0):
            if is_primitive_at(scene, seen.face):
                tri = scene.triangles[seen.face]
                return wp.where(wp.dot(normal_at(scene, tri, seen.x), d) > 0.0, -1, 1) * (1 + tri.shape)
        uv = barycentrics_at(scene.triangles[seen.face], seen.x)
        surface = surface_at(scene, seen.face, uv[0], uv[1])
        return wp.where(wp.dot(surface.n, d) > 0.0, -1, 1) * (1 + surface.shape)

    @wp.func
    def touches(scene: Scene, point: EdgePoint, seen: IncidentRadiance, step: wp.float32) -> wp.bool:
        """Whether what a ray meets beside a point of an edge goes on to that point."""
        if seen.face < 0 or (wp.static(len(config.surfaces.primitives) > 0) and is_primitive_at(scene, seen.face)):
            return False
        return on_plane(scene.triangles[seen.face].normal, seen.x - point.x, step)

    @wp.func
    def parts_shapes(scene: Scene, edges: Edges, edge: wp.int32) -> wp.bool:
        """Whether the two sides of an edge belong to two shapes."""
        i = edges.first[edge]
        if i + 1 == edges.first[edge + 1]:
            return False
        return scene.triangles[edges.faces[i]].shape != scene.triangles[edges.faces[i + 1]].shape

    @wp.func
    def whose(scene: Scene, edges: Edges, point: EdgePoint, d: wp.vec3, apart: wp.float32, face: wp.int32) -> wp.int32:
        """OWN, NEXT or 0: whether what is met beside an edge belongs to its shapes, or ends along it with an edge."""
        if face < 0:
            return 0
        tri = scene.triangles[face]
        for i in range(edges.first[point.edge], edges.first[point.edge + 1]):
            if scene.triangles[edges.faces[i]].shape == tri.shape:
                return OWN
        if wp.static(len(config.surfaces.primitives) > 0):
            if is_primitive(tri):
                return 0
        sides = edges.sides[face]
        p = tri.p0
        q = tri.p1
        for k in range(3):
            if k == 1:
                p = tri.p1
                q = tri.p2
            if k == 2:
                p = tri.p2
                q = tri.p0
            if ((sides >> k) & 1) == 1:
                r = point.x - p
                n = wp.cross(q - p, d)
                squared = wp.dot(n, n)
                t = wp.dot(wp.cross(r, d), n)
                side = wp.abs(wp.dot(n, r))
                off = wp.length(wp.cross(r, wp.normalize(q - p)))
                near = wp.max(apart, ROUNDING * (wp.length(p) + wp.length(q)))
                if t >= 0.0 and t <= squared and side <= near * wp.sqrt(squared) and off <= ALONG * near:
                    return NEXT
        return 0

    @wp.func
    def room_beside(
        scene: Scene,
        edges: Edges,
        point: EdgePoint,
        d: wp.vec3,
        m: wp.vec3,
        side: wp.float32,
        local: wp.float32,
        a: IncidentRadiance,
        b: IncidentRadiance,
    ) -> wp.float32:
        """Distance at which rays have to pass an edge for what they meet, ``a`` on the side of m, to be lit as seen."""
        room = sharp_glass(scene, edges, point.edge) * local
        hidden = wp.bool(wp.static(config.rays.hidden))
        first_face = edges.first[point.edge]
        curve = edges.ends[point.edge, 0] == CURVE
        if curve or (touches(scene, point, a, local) and touches(scene, point, b, local)):
            face_a = a.face
            face_b = b.face
            through = hidden and shines(scene, edges.faces[first_face])
            if curve:
                # What a hidden light is pierced by is seen on both sides.
                face_a = edges.faces[first_face]
                face_b = edges.faces[first_face + 1]
                through = let_through(scene, face_a, face_b, hidden)
            n_a = facing(scene.triangles[face_a].normal, d)
            n_b = facing(scene.triangles[face_b].normal, d)
            away = wp.max(leaving_step(scene, face_a), leaving_step(scene, face_b))
            if curve or not is_ridge(n_a, n_b, m, d):
                room = wp.max(room, concave_distance(n_a, n_b, through) * wp.max(local, away))
        if wp.static(has_delta_lights):
            if side != 0.0:
                before = a
                beyond = b
                if side < 0.0:
                    before = b
                    beyond = a
                if touches(scene, point, before, local):
                    t = wp.normalize(point.p1 - point.p0)
                    into = before.x - point.x
                    into = wp.normalize(into - wp.dot(into, t) * t)
                    if shadow_along(scene, point.x, into, local):
                        room = wp.max(room, LIT * wp.max(local, leaving_step(scene, before.face)))
                if beyond.face >= 0:
                    if lit_along(scene, beyond.x, point.x - beyond.x, local):
                        room = wp.max(room, LIT * wp.max(local, leaving_step(scene, beyond.face)))
        return room

    if config.pulse:
        return make_timed_primary_kernel(config, role, camera_moves, seen_as, whose, room_beside)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def primary(
        # Scene:
        scene: Scene,
        camera: Camera,
        edges: Edges,
        # In:
        job: SampleJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        number = job.first + wp.tid()
        sampler = sampler_at(number, 0, job.seed)
        f = find(scene, camera, edges, number, job.samples, sampler, job.image_adjoint)
        if f.valid == 0:
            return
        point = f.point
        at = f.at
        d = f.d
        m = f.m
        side = f.side
        local = f.step
        distance = f.distance
        sampler.index = wp.uint32(1)
        ahead = AHEAD * local
        narrow = wp.bool(False)
        curve = edges.ends[point.edge, 0] == CURVE
        first_face = edges.first[point.edge]
        if wp.static(config.material_first):
            # Faces on both sides of an edge of their own keep all of their points.
            if side == 0.0 and not curve and not parts_shapes(scene, edges, point.edge):
                return
        if curve:
            normal_a = scene.triangles[edges.faces[first_face]].normal
            normal_b = scene.triangles[edges.faces[first_face + 1]].normal
            acute = wp.length(wp.cross(normal_a, normal_b))
            apart = wp.clamp(BESIDE * ACUTE / acute, BESIDE, BESIDE_CURVE) * local
        else:
            apart, ahead, narrow = rays_beside(scene, edges, f)
        # Of a face that is seen exactly edge-on, the near plane.
        ahead = wp.min(ahead, distance - at.near)
        t_max = at.far - distance + ahead
        if wp.static(among_media):
            # Up to where both rays start: beyond it the edge's transmittance is theirs.
            length = distance - ahead - at.near
            before = line(scene, sampler, BEFORE, at.origin + at.near * d, d, length, camera.medium, 0)
        own = wp.bool(False)
        a = IncidentRadiance()
        b = IncidentRadiance()
        to_a = apart * m
        to_b = -apart * m
        k = wp.int32(0)
        looks = wp.int32(2)
        while k < looks:
            o = point.x + wp.where(k % 2 == 0, to_a, to_b) - ahead * d
            if wp.static(among_media):
                seen = media_radiance(scene, sampler, before.medium, o, d, t_max, job.max_depth, job.rr_depth)
            else:
                seen = incident_radiance(scene, sampler, o, d, t_max, 0, job.max_depth, job.rr_depth)
            if wp.static(bool(config.shown)):
                seen.radiance = behind(seen.radiance, seen.face, distance - ahead - at.near)
            if k < 2:
                # A face that is seen nearly edge-on is met far away.
                met = seen.face
                if wp.static(len(config.surfaces.primitives) > 0):
                    met = triangle_or_none(scene, met)
                its = own_face(scene, edges, point.edge, met)
                if is_pierced(scene, edges, point, met, seen.x, local):
                    return
                if narrow:
                    sign = 1.0 - 2.0 * wp.float32(k)
                    own = own or (side * sign >= 0.0 and its)
                elif side == 0.0 and not (its or on_planes(scene, edges, point, seen.face, seen.x, local)):
                    return
            if k == 0 or (k == 2 and seen_as(scene, seen, d) == seen_as(scene, a, d)):
                a = seen
            if k == 1 or (k == 3 and seen_as(scene, seen, d) == seen_as(scene, b, d)):
                b = seen
            k += 1
            if k == 2:
                room = room_beside(scene, edges, point, d, m, side, local, a, b)
                if room > apart:
                    to_a = room * m
                    to_b = -room * m
                    looks = 4
        if narrow and not own:
            return
        if side == 0.0 and bends(scene, edges, point.edge) and seen_as(scene, a, d) != seen_as(scene, b, d):
            return
        share = wp.float32(1.0)
        jump = b.radiance - a.radiance
        if wp.static(among_media):
            # What is scattered in front of the edge is common to both sides.
            jump = wp.cw_mul(before.transmittance, jump)
        if edges.sides.shape[0] > 1 and not curve:
            by_a = whose(scene, edges, point, d, apart, a.face)
            by_b = whose(scene, edges, point, d, apart, b.face)
            if by_a == NEXT or by_b == NEXT:
                # Another edge counts this jump, too, or alone.
                if by_a != OWN and by_b != OWN:
                    return
                share = wp.float32(0.5)
        if wp.static(config.material_first):
            # What the edge hides is uncovered; its own surface keeps its points.
            if side >= 0.0:
                l_b = share * b.radiance
                accumulate_side(scene, camera, edges, sampler, job.samples, f, b.face, b.x, l_b, target, image_out)
            if side <= 0.0:
                l_a = -share * a.radiance
                accumulate_side(scene, camera, edges, sampler, job.samples, f, a.face, a.x, l_a, target, image_out)
        else:
            accumulate(scene, camera, edges, sampler, job.samples, f, share * jump, target, image_out)

    return primary
