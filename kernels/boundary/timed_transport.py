"""Transport of a boundary segment to a transient film: ``transport.py`` with light binned by path length.

Walk, connections and adjoints are those of ``transport.py``. Behind every vertex of the walk that the camera sees, a
separate path continues past the occluder. The length of its light is that of walk, segment and path together.

Derivation: ``docs/theory/transient.md#boundary-term``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.coincident import pass_together
from warp_psdr.kernels.boundary.detector import Walk, make_walk
from warp_psdr.kernels.boundary.timed_light import make_timed_light
from warp_psdr.kernels.boundary.transport import (
    SLOT_LENS,
    SLOT_WALK,
    Segment,
    before_light,
    make_first_sink,
    make_found_sink,
)
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.invalid import count_invalid, vanishes
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.path_length import lamp_position
from warp_psdr.kernels.primitive.dispatch import make_point_at
from warp_psdr.kernels.rng import Sampler, branch_of, make_sampler
from warp_psdr.kernels.sensor.camera import make_camera_sink, make_lens
from warp_psdr.kernels.sensor.time_gate import TimeGates
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, path_from


@functools.cache
def make_timed_transport(config: PathConfig, role: str, camera_moves: bool):
    """Return ``timed_transport(scene, camera, sampler, s, scale, rest, gates, job, target, image) -> float``.

    As ``make_transport``'s; role "reverse" or "forward".
    """
    connect, extend = make_walk(config)
    accumulate_first = make_first_sink(role, config.surfaces.primitives)
    accumulate_found = make_found_sink(role, config.surfaces.primitives)
    point_at = make_point_at(config.surfaces.primitives)
    accumulate_camera = make_camera_sink(role, config.camera) if camera_moves else None
    send, send_path = make_timed_light(config, role)
    lens_point = make_lens(config.camera)
    draw = make_sampler(config.sampler)
    sample_2d = draw.sample_2d
    sample_4d = draw.sample_4d

    @wp.func
    def send_source(
        scene: Scene,
        sampler: Sampler,
        camera: Camera,
        gates: TimeGates,
        at: wp.vec2,
        s: Segment,
        x1: wp.vec3,
        length: wp.float32,
        k: wp.int32,
        factor: wp.vec3,
        job: SampleJob,
        image: wp.array2d(dtype=wp.vec3),
    ) -> wp.float32:
        """The light past the occluder, ``length`` from the camera to x_1, behind k vertices."""
        total = wp.float32(0.0)
        if s.light >= 0:
            far = length + wp.length(lamp_position(scene, scene.emitters[s.light]) - x1)
            return send(scene, sampler, camera, gates, at, far, wp.cw_mul(factor, s.radiance), job, image)
        if s.face2 < 0:
            return total
        o = s.source
        shines = wp.max(s.radiance) > 0.0
        if shines:
            far = length + s.t1 + s.t2
            total += send(scene, sampler, camera, gates, at, far, wp.cw_mul(factor, s.radiance), job, image)
            o = before_light(scene, s)
        if job.max_depth < 0 or k + 1 < job.max_depth:
            start = path_from(o, s.w, FAR, k)
            far = length + wp.dot(o - x1, s.w)
            total += send_path(scene, sampler, camera, gates, at, start, far, False, not shines, factor, job, image)
        return total

    @wp.func
    def timed_transport(
        scene: Scene,
        camera: Camera,
        sampler: Sampler,
        s: Segment,
        scale: wp.float32,
        rest: wp.float32,
        gates: TimeGates,
        job: SampleJob,
        target: wp.array(dtype=wp.float32),
        image: wp.array2d(dtype=wp.vec3),
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        x1 = point_at(scene, scene.triangles[s.face1], s.u1, s.v1)
        walk = Walk()
        walk.alive = 1
        walk.face = s.face1
        walk.u = s.u1
        walk.v = s.v1
        walk.x = x1
        walk.to = s.w
        walk.weight = wp.vec3(1.0, 1.0, 1.0)
        lens = lens_point(sample_2d(sampler, SLOT_LENS))
        second = Walk()
        weight = wp.float32(0.0)
        total = wp.float32(0.0)
        walked = wp.float32(0.0)
        k = wp.int32(1)
        while walk.alive == 1:
            seen = connect(scene, camera, walk, lens)
            counts = not vanishes(seen.weight)
            if k == 1 and s.light >= 0:
                counts = counts and not pass_together(seen.at.origin - walk.x, s.w, s.t1, s.step)
            if counts:
                away = walk.x - seen.at.origin
                ray = wp.normalize(away)
                factor = scale * seen.weight
                if wp.static(role == "forward"):
                    speed = wp.float32(rest)
                    if k == 1:
                        a_o, a_d, moved = accumulate_first(scene, target, s, 1.0, True, seen.at.origin, ray)
                        speed += moved
                        if wp.static(camera_moves):
                            speed += accumulate_camera(scene, target, camera, seen.at.sample, a_o, a_d)
                    else:
                        speed += accumulate_found(scene, target, s, 1.0, second)
                    factor *= speed
                length = walked + wp.where(gates.unwarp == 1, 0.0, wp.length(away))
                w = send_source(
                    scene, branch_of(sampler, k), camera, gates, seen.at.pixel, s, x1, length, k, factor, job, image
                )
                if wp.static(role == "reverse"):
                    total += w
                    if k == 1 and w != 0.0:
                        a_o, a_d, dropped = accumulate_first(scene, target, s, w, True, seen.at.origin, ray)
                        if wp.static(camera_moves):
                            dropped += accumulate_camera(scene, target, camera, seen.at.sample, a_o, a_d)
                        if dropped != 0.0:
                            count_invalid(scene, sampler)
                    if k > 1:
                        weight += w
            if job.max_depth >= 0 and k + 2 > job.max_depth:
                walk.alive = 0
            else:
                last = walk.x
                walk = extend(scene, walk, sample_4d(sampler, SLOT_WALK + k), FAR, k >= job.rr_depth)
                walked += wp.length(walk.x - last)
                if k == 1:
                    second = walk
            k += 1
        if wp.static(role == "reverse"):
            if weight != 0.0:
                if accumulate_found(scene, target, s, weight, second) != 0.0:
                    count_invalid(scene, sampler)
        return total

    return timed_transport
