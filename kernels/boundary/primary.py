"""Primary boundary: discontinuities of the radiance on the film, for the pixel filter h.

    dI_j = integral h(u - u_j) (L_- - L_+) (u' . N) ds,      N perpendicular to du/ds on the film, |N| = |du/ds|,

u = pixel(x_b) the image of an edge point, s its position along the edge, L_+ and L_- the radiance on the side that N
points to and on the other [LADL18; survey eq. 4 on the film]. It is the local form with the camera as x_1: with g the
gradient of N . pixel(x), u' . N = g . (x_b' - o' - |x_b - o| d'), the edge's velocity relative to its pixel's ray.
A thin lens is the mean over its points of such cameras, one point a sample (``projection.py``).

Where the edge is hidden there is no jump. The two radiances are path-traced along rays that pass the edge on either
side at a fraction of a ray epsilon, parallel to the line of sight, with common random numbers. Silhouettes, creases,
and borders between materials or texture charts are one case: whatever does not jump cancels.

Where a fine mesh bends away from the camera, creases run within that distance of its silhouette, in front of it and
behind. One of their two rays passes the silhouette instead, whose jump the silhouette's own samples have counted, so at
an edge that is not a silhouette both rays have to meet one of its faces' planes beside it. (Otherwise a ball of 5,120
triangles, and of a twentieth of the scene's size, had 15 % too large a derivative.)

Such a face F is often narrow as it is seen: the rim of a thin slab, the top of a table at the height of the eye. The
rays pass its edges at half of its width, in order to meet it, down to some roundings of coordinates, and start in front
of all of it. Narrower faces, 10^-6 of the scene, are looked past from both of their edges, E_1 of A | F and E_2 of
F | B, B hidden, which is a crease and which a silhouette is up to roundings, and all lies in the plane of F. There the
jump is the edge's beside which one of its own faces is seen, or what continues one in its plane: on the occluder's side
of a silhouette, on either side of a crease; at E_1, that is. So motions of F as a whole are right at any width; what
changes the width of such a narrow one is not, and sheets that narrow are lost. (Shapes with interpolated normals do
without: next to silhouettes of their fine meshes many faces are as narrow, and their creases are no candidates.)
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.detector import make_arrival
from warp_psdr.kernels.boundary.local_form import (
    Edges,
    edge_behind,
    edge_point,
    edge_step,
    interior_side,
    make_edge_sink,
    narrowest_face,
    on_planes,
    own_face,
)
from warp_psdr.kernels.boundary.projection import make_projection, make_splat
from warp_psdr.kernels.bvh.wide import make_intersect
from warp_psdr.kernels.camera import make_camera_sink, make_lens
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.notes import NOTE_EDGE, make_note
from warp_psdr.kernels.path import PathConfig
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import make_surface

#: Distance at which the two rays pass the edge, in ray epsilons: some 8 float32 steps of the largest coordinate, and 2
#: beside narrow faces. It is small because a second discontinuity as near (a terminator just inside of a silhouette) is
#: taken for the first; the rays start close to the edge, where float32 resolves it.
BESIDE = 0.1
BESIDE_LEAST = 0.025
#: The same at curves of intersection. It is larger because a ray that leaves one of the two surfaces at an acute angle
#: starts one ray epsilon off it, which may not be behind the other. Where something else is seen there than close to
#: the curve, the ray passes close to it: a silhouette that turns into a curve and its terminator are tangent to it.
BESIDE_CURVE = 10.0
#: Least distance in front of the edge at which the rays start, in ray epsilons. It is longer where a face is seen more
#: edge-on than BESIDE / AHEAD, 10^-4: the ray beside the edge must start in front of that face.
AHEAD = 2000.0
#: Share by which it is longer than needed, and by which a face is wider than the rays' distance if they meet it.
MARGIN = 2.0


@functools.cache
def make_primary_kernel(config: PathConfig, role: str, camera_moves: bool):
    """Return the kernel of the primary boundary term: one thread a sample (arguments as in ``secondary.py``)."""
    closest_hit, any_hit = make_intersect(config.ray_backend, config.ray_width)
    surface_at = make_surface(config.smooth, config.flat, False, False)
    arrival = make_arrival(config)
    push_edge = make_edge_sink(role)
    push_camera = make_camera_sink(role, config.camera) if camera_moves else None
    splat, gather = make_splat()
    project, film_gradient, film_velocity = make_projection(config.camera)
    lens_point = make_lens(config.camera)
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_2d = draw.sample_2d
    note_place = make_note(config.noted)

    @wp.func
    def seen_from(scene: Scene, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> wp.int32:
        """Number of the shape that a ray meets, from one, negative on the back of its normals; 0: none."""
        hit = closest_hit(scene.accel, o, d, t_max)
        if hit.face < 0:
            return 0
        surface = surface_at(scene, hit.face, hit.u, hit.v)
        return wp.where(wp.dot(surface.n, d) > 0.0, -1, 1) * (1 + surface.shape)

    @wp.kernel(module="unique", enable_backward=False)
    def primary(
        # Scene:
        scene: Scene,
        camera: Camera,
        edges: Edges,
        # In:
        first: wp.int32,
        samples: wp.int32,
        seed: wp.uint32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
        adjoint: wp.array2d(dtype=wp.vec3),
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        number = first + wp.tid()
        sampler = sampler_at(number, 0, seed)
        point = edge_point(scene, edges, number, samples, sample_1d(sampler, 0))
        at = project(scene, camera, point.x, lens_point(sample_2d(sampler, 1)))
        if at.valid == 0:
            return
        distance = wp.length(point.x - at.origin)
        d = (point.x - at.origin) / distance
        tangent = wp.normalize(point.p1 - point.p0)
        m = wp.cross(tangent, d)
        sine = wp.length(m)
        if sine <= 0.0:
            return
        m = m / sine
        side = interior_side(scene, edges, point, m)
        # Is the edge visible? Seen from just outside of a silhouette, or straight on.
        local = edge_step(scene, edges, point.edge)
        behind = edge_behind(scene, local)
        start = point.x - (local * side) * m - behind * d
        back = at.origin - start
        length = wp.length(back)
        if length > at.near and any_hit(scene.accel, start, back / length, length - at.near):
            return
        step = film_velocity(scene, camera, at, point.p1 - point.p0)
        normal = wp.vec2(step[1], -step[0])
        g = film_gradient(scene, camera, at, normal)
        if wp.dot(g, m) < 0.0:
            g = -g
        weight = wp.vec3(1.0, 1.0, 1.0)
        if wp.static(role != "forward"):
            weight = gather(camera, at.pixel, adjoint)
            if weight[0] == 0.0 and weight[1] == 0.0 and weight[2] == 0.0:
                return
        note_place(scene, NOTE_EDGE, point.edge, point.s, 0.0, point.x, d, weight)
        sampler.index = wp.uint32(1)
        apart = BESIDE_CURVE * local
        ahead = AHEAD * local
        narrow = wp.bool(False)
        curve = edges.ends[point.edge, 0] < 0
        if not curve:
            width, slant = narrowest_face(scene, edges, point, m, d)
            # Where scales are mixed, steps are some roundings already.
            least = wp.where(scene.least_step > 0.0, BESIDE, BESIDE_LEAST)
            apart = wp.clamp(width / MARGIN, least * local, BESIDE * local)
            ahead = wp.max(ahead, MARGIN * apart / slant)
            flat = scene.shapes[scene.triangles[edges.faces[edges.first[point.edge]]].shape].smooth == 0
            narrow = flat and width < MARGIN * apart
        # Of a face that is seen exactly edge-on, the near plane.
        ahead = wp.min(ahead, distance - at.near)
        beside = apart * m
        t_max = at.far - distance + ahead
        own = wp.bool(False)
        jump = wp.vec3(0.0, 0.0, 0.0)
        for i in range(2):
            sign = 1.0 - 2.0 * wp.float32(i)
            o = point.x + sign * beside - ahead * d
            if curve:
                close = point.x + (sign * BESIDE * local) * m - ahead * d
                if seen_from(scene, close, d, t_max) != seen_from(scene, o, d, t_max):
                    o = close
            seen = arrival(scene, sampler, o, d, t_max, 0, max_depth, rr_depth)
            jump -= sign * seen.radiance
            # A face that is seen nearly edge-on is met far away.
            its = own_face(scene, edges, point.edge, seen.face)
            if narrow:
                own = own or (side * sign >= 0.0 and its)
            elif side == 0.0 and not (its or on_planes(scene, edges, point, seen.face, seen.x, local)):
                return
        if narrow and not own:
            return
        scale = 1.0 / (point.pdf * wp.float32(samples))
        if wp.static(role != "forward"):
            scale *= wp.dot(weight, jump)
        g = scale * g
        speed = push_edge(scene, target, edges, point, g)
        if wp.static(camera_moves):
            speed += push_camera(scene, target, camera, at.sample, -g, -distance * g)
        if wp.static(role == "forward"):
            splat(scene, sampler, camera, at.pixel, speed * jump, image_out)
        elif wp.static(role == "reverse"):
            if speed != 0.0:
                count_invalid(scene, sampler)

    return primary
