"""Primary boundary on a transient film: the edges of ``primary.py``, with the light beside them binned by path length.

The two rays beside an edge first find what they meet. A path then continues along each ray, with common random numbers,
and adds its light to the bins of its length with the sign of its side.

Derivation: ``docs/theory/transient.md#boundary-term``.
"""

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.detector import IncidentRadiance
from warp_psdr.kernels.boundary.film_edge import (
    NEXT,
    OWN,
    bends,
    make_film_edge,
    rays_beside,
)
from warp_psdr.kernels.boundary.local_form import Edges, is_pierced, make_edge_sink, on_planes, own_face
from warp_psdr.kernels.boundary.timed_light import make_timed_light
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.primitive.affine import triangle_or_none
from warp_psdr.kernels.primitive.dispatch import make_point_at
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.sensor.camera import make_camera_sink
from warp_psdr.kernels.sensor.time_gate import TimeGates
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, path_from
from warp_psdr.kernels.visibility import visibility_of


def make_timed_primary_kernel(
    config: PathConfig,
    role: str,
    camera_moves: bool,
    seen_as: wp.Function,
    whose: wp.Function,
    room_beside: wp.Function,
):
    """Return the kernel of ``make_primary_kernel`` before a transient film; its functions are ``primary.py``'s."""
    # In reverse mode it would read one adjoint.
    find, _accumulate, _accumulate_side = make_film_edge(config, "forward", camera_moves)
    accumulate_edge = make_edge_sink(role, config.surfaces.steps)
    accumulate_camera = make_camera_sink(role, config.camera) if camera_moves else None
    _send, send_path = make_timed_light(config, role)
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    point_at = make_point_at(config.surfaces.primitives)

    @wp.func
    def seen_along(scene: Scene, o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> IncidentRadiance:
        r = IncidentRadiance()
        hit = visibility.seen(scene, o, d, t_max, 0)
        r.face = hit.face
        if hit.face >= 0:
            r.x = point_at(scene, scene.triangles[hit.face], hit.u, hit.v)
        return r

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def timed_primary(
        # Scene:
        scene: Scene,
        camera: Camera,
        edges: Edges,
        # In:
        gates: TimeGates,
        job: SampleJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        number = job.first + wp.tid()
        sampler = sampler_at(number, 0, job.seed)
        f = find(scene, camera, edges, number, job.samples, sampler, job.image_adjoint)
        if f.valid == 0:
            return
        point = f.point
        at = f.at
        d = f.d
        local = f.step
        sampler.index = wp.uint32(1)
        apart, ahead, narrow = rays_beside(scene, edges, f)
        # Of a face that is seen exactly edge-on, the near plane.
        ahead = wp.min(ahead, f.distance - at.near)
        t_max = at.far - f.distance + ahead
        # ---- What they meet ----
        own = wp.bool(False)
        a = IncidentRadiance()
        b = IncidentRadiance()
        o_a = point.x
        o_b = point.x
        beside = wp.float32(apart)
        k = wp.int32(0)
        looks = wp.int32(2)
        while k < looks:
            o = point.x + wp.where(k % 2 == 0, beside, -beside) * f.m - ahead * d
            seen = seen_along(scene, o, d, t_max)
            if k < 2:
                # A face that is seen nearly edge-on is met far away.
                met = triangle_or_none(scene, seen.face)
                its = own_face(scene, edges, point.edge, met)
                if is_pierced(scene, edges, point, met, seen.x, local):
                    return
                if narrow:
                    sign = 1.0 - 2.0 * wp.float32(k)
                    own = own or (f.side * sign >= 0.0 and its)
                elif f.side == 0.0 and not (its or on_planes(scene, edges, point, seen.face, seen.x, local)):
                    return
            if k == 0 or (k == 2 and seen_as(scene, seen, d) == seen_as(scene, a, d)):
                a = seen
                o_a = o
            if k == 1 or (k == 3 and seen_as(scene, seen, d) == seen_as(scene, b, d)):
                b = seen
                o_b = o
            k += 1
            if k == 2:
                room = room_beside(scene, edges, point, d, f.m, f.side, local, a, b)
                if room > apart:
                    beside = wp.float32(room)
                    looks = 4
        if narrow and not own:
            return
        if f.side == 0.0 and bends(scene, edges, point.edge) and seen_as(scene, a, d) != seen_as(scene, b, d):
            return
        scale = 1.0 / (point.pdf * wp.float32(job.samples))
        if edges.sides.shape[0] > 1:
            by_a = whose(scene, edges, point, d, apart, a.face)
            by_b = whose(scene, edges, point, d, apart, b.face)
            if by_a == NEXT or by_b == NEXT:
                # Another edge counts this jump, too, or alone.
                if by_a != OWN and by_b != OWN:
                    return
                scale *= 0.5
        # ---- Their light ----
        factor = wp.float32(scale)
        if wp.static(role == "forward"):
            factor = accumulate_edge(scene, target, edges, point, scale * f.g)
            if wp.static(camera_moves):
                a_d = -f.distance * scale * f.g
                factor += accumulate_camera(scene, target, camera, at.sample, -scale * f.g, a_d)
            if factor == 0.0:
                return
        total = wp.float32(0.0)
        for side in range(2):
            sign = wp.where(side == 0, -factor, factor)
            o = wp.where(side == 0, o_a, o_b)
            start = path_from(o, d, t_max, 0)
            length = wp.where(gates.unwarp == 1, 0.0, wp.length(o - at.origin))
            weight = wp.vec3(sign, sign, sign)
            total += send_path(
                scene, sampler, camera, gates, at.pixel, start, length, True, True, weight, job, image_out
            )
        if wp.static(role == "reverse"):
            if total != 0.0:
                g = total * f.g
                dropped = accumulate_edge(scene, target, edges, point, g)
                if wp.static(camera_moves):
                    dropped += accumulate_camera(scene, target, camera, at.sample, -g, -f.distance * g)
                if dropped != 0.0:
                    count_invalid(scene, sampler)

    return timed_primary
