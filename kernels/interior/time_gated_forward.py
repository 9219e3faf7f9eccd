"""Interior term on a transient film in forward mode: lengths travel with the path, as the derivative does.

The velocities of vertices, and the derivatives of emission and next-event estimates, are those of ``forward.py``. With
ell_n' = ell_{n-1}' + eta u . (x_n' - x_{n-1}'), u along the segment, bin b receives w_b(ell) L' + dw_b / dell ell' L of
light L that has gone the length ell.

Derivation: ``docs/theory/transient.md#forward-mode``.
"""

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.camera_rays import make_camera_paths
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.time_gated import make_light_point_sink
from warp_psdr.kernels.invalid import count_invalid, finite
from warp_psdr.kernels.jobs import PixelJob, pixel_of
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path_length import make_next_event_point, make_timed_vertex
from warp_psdr.kernels.primitive.dispatch import make_point_at
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_origin
from warp_psdr.kernels.sensor.time_gate import TimeGates, make_time_gate
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, PathState, PathVertex


def make_time_gated_forward_kernel(
    config: PathConfig, wanted: GradientRequest, advance: wp.Function, first_moving: wp.Function
):
    """Return the kernel of ``make_forward_kernel`` before a transient film; its functions are ``forward.py``'s."""
    lanes, starts, path_step = make_camera_paths(config, True)
    camera_origin = make_camera_origin(config.camera)
    timed_vertex = make_timed_vertex(config.surfaces, config.lights)
    light_point = make_next_event_point(config.surfaces.primitives, config.lights.area)
    point_at = make_point_at(config.surfaces.primitives)
    move_light_point = make_light_point_sink(config.lights, config.surfaces.primitives, wanted, "forward")
    gate = make_time_gate(config.pulse)
    moves = wanted.geometry or "pose" in wanted.lights

    @wp.func
    def link_dot(scene: Scene, target: wp.array(dtype=wp.float32), vertex: PathVertex, x_dot: wp.vec3) -> wp.float32:
        """Velocity of |y - x_n|."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        x = point_at(scene, scene.triangles[vertex.face], vertex.u, vertex.v)
        u = wp.normalize(light_point(scene, vertex) - x)
        return move_light_point(scene, target, vertex, u) - wp.dot(u, x_dot)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def time_gated_forward(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        gates: TimeGates,
        job: PixelJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        pixel = pixel_of(job, camera, wp.tid())
        starting = wp.zeros(shape=(wp.static(lanes),), dtype=PathState)
        cameras = wp.zeros(shape=(wp.static(lanes),), dtype=CameraSample)
        for i in range(job.samples):
            sampler = sampler_at(pixel.number, job.first_sample + i, job.seed)
            state, sample = starts(scene, camera, pixel.px, pixel.py, sampler, i, job.samples, starting, cameras)
            eta = state.eta
            vertex, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
            vertex.o = camera_origin(scene, camera, sample)
            moving = first_moving(scene, camera, target, sample, vertex)
            time = timed_vertex(scene, gates, vertex, True, eta, 0.0)
            length_dot = wp.float32(0.0)
            throughput_dot = wp.vec3(0.0, 0.0, 0.0)
            dropped = wp.bool(False)
            more = wp.bool(True)
            while more:
                following = PathVertex()
                following.face = -1
                more = state.alive == 1
                eta = state.eta
                if more:
                    following, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
                factor = job.scale * vertex.throughput
                late_dot = length_dot
                if wp.static(moves):
                    if vertex.face >= 0:
                        x = point_at(scene, scene.triangles[vertex.face], vertex.u, vertex.v)
                        u = wp.normalize(x - vertex.o)
                        length_dot += time.segment * wp.dot(u, moving.vertex.x - moving.o)
                        late_dot = length_dot
                        if vertex.light >= 0:
                            late_dot += time.eta * link_dot(scene, target, vertex, moving.vertex.x)
                # What the vertex emits, and what it scatters, if both are there: one after the other.
                next_dot = throughput_dot
                after = moving
                at = vertex
                length = time.length + time.link
                ell_dot = late_dot
                parts = wp.int32(1)
                if vertex.e_weight > 0.0 and vertex.light >= 0:
                    parts = 2
                while parts > 0:
                    if parts == 2:
                        at.light = -1
                        at.direct = time.emission
                        length = time.length
                        ell_dot = length_dot
                    sent_dot, next_dot, after = advance(scene, target, at, following, moving, throughput_dot)
                    sent = wp.cw_mul(factor, at.direct)
                    if finite(sent_dot) and finite(sent) and wp.isfinite(ell_dot):
                        gate.add_moving(
                            gates, length, sent, ell_dot, job.scale * sent_dot, pixel.py, pixel.px, image_out
                        )
                    else:
                        dropped = wp.bool(True)
                    at = vertex
                    at.e_weight = 0.0
                    at.direct = time.direct
                    length = time.length + time.link
                    ell_dot = late_dot
                    parts -= 1
                throughput_dot = next_dot
                moving = after
                time = timed_vertex(scene, gates, following, False, eta, time.length)
                vertex = following
            if dropped:
                count_invalid(scene, sampler)

    return time_gated_forward
