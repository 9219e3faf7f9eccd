"""Interior term on a transient film, by record and sweep with attached path lengths [WCRZ21, YKC*21].

The light of vertex n counts for the loss by a(ell) = sum_b delta_b w_b(ell), with the image's adjoint delta and the
length ell that the light has gone. The sweep of ``sweep.py`` runs over weighted emission and next-event estimates, one
channel at a time, since the weights of E_n and D_n are colours. The derivative a'(ell) goes to the ends of every
segment: |x_n - x_{n-1}| has the adjoint S_n, the sum of a' times light over all that comes from vertex n on.

Derivation: ``docs/theory/transient.md#reverse-mode``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.camera_rays import make_camera_paths
from warp_psdr.kernels.constants import EMITTER_AREA, EMITTER_POINT
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.sweep import Carry, make_sweep
from warp_psdr.kernels.invalid import count_invalid, finite
from warp_psdr.kernels.jobs import PixelJob, pixel_of
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path_length import TimedVertex, make_next_event_point, make_timed_vertex
from warp_psdr.kernels.primitive.dispatch import make_adjoint_sink, make_point_at
from warp_psdr.kernels.rng import Sampler, sampler_at
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_origin
from warp_psdr.kernels.sensor.time_gate import TimeGates, make_time_gate
from warp_psdr.kernels.sink import make_sink, make_sink_vec3
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint
from warp_psdr.kernels.vertex import LightConfig, PathConfig, PathState, PathVertex


@functools.cache
def make_light_point_sink(lights: LightConfig, primitives: tuple[int, ...], wanted: GradientRequest, role: str):
    """Return ``accumulate_light_point(scene, target, vertex, g) -> float`` for the adjoint g of a light point."""
    accumulate_vertex = make_adjoint_sink(role, False, False, False, False, False, False, primitives)
    sink = make_sink(role)
    sink3 = make_sink_vec3(role)
    has_posed = bool(lights.others) and "pose" in wanted.lights

    @wp.func
    def accumulate_light_point(
        scene: Scene, target: wp.array(dtype=wp.float32), vertex: PathVertex, g: wp.vec3
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        total = wp.float32(0.0)
        emitter = scene.emitters[vertex.light]
        if emitter.kind == EMITTER_AREA:
            if wp.static(bool(lights.area) and wanted.shapes):
                adjoint = VertexAdjoint()
                adjoint.x = g
                accumulated = accumulate_vertex(
                    scene, target, vertex.light_face, vertex.light_u, vertex.light_v, adjoint, False, g, g
                )
                total += accumulated.dot
        else:
            if wp.static(has_posed):
                if emitter.kind == EMITTER_POINT:
                    total += sink3(target, emitter.to_world, g)
                else:
                    for i in range(3):
                        total += sink(target, emitter.to_world + 4 * i + 3, g[i])
        return total

    return accumulate_light_point


@wp.struct
class GatedVertex:
    """A recorded vertex, and what it counts for the loss."""

    vertex: PathVertex
    time: TimedVertex
    weight_e: wp.vec3  # a(ell) of E_n and of D_n
    weight_d: wp.vec3
    late: wp.float32  # adjoint of the length of D_n
    own: wp.float32  # that and the adjoint of the length of E_n


@functools.cache
def make_time_gated_kernel(config: PathConfig, wanted: GradientRequest, most: int):
    """Return the reverse-mode kernel of ``interior.Replay`` before a transient film.

    Args:
        config: what the scene needs.
        wanted: what is differentiated.
        most: number of vertices that are kept; no path has more.
    """
    lanes, starts, path_step = make_camera_paths(config, True, True)
    camera_origin = make_camera_origin(config.camera)
    sweep, finish, _finish_vertex = make_sweep(config, wanted, "reverse")
    timed_vertex = make_timed_vertex(config.surfaces, config.lights)
    light_point = make_next_event_point(config.surfaces.primitives, config.lights.area)
    point_at = make_point_at(config.surfaces.primitives)
    accumulate_light_point = make_light_point_sink(config.lights, config.surfaces.primitives, wanted, "reverse")
    gate = make_time_gate(config.pulse)
    moves = wanted.geometry or "pose" in wanted.lights

    @wp.func
    def gated_vertex(
        vertex: PathVertex, time: TimedVertex, gates: TimeGates, job: PixelJob, row: wp.int32, column: wp.int32
    ) -> GatedVertex:
        r = GatedVertex()
        r.vertex = vertex
        r.time = time
        a_e, slope_e = gate.read(gates, time.length, row, column, job.image_adjoint)
        a_d, slope_d = gate.read(gates, time.length + time.link, row, column, job.image_adjoint)
        r.weight_e = a_e
        r.weight_d = a_d
        if wp.static(moves):
            r.late = job.scale * wp.dot(wp.cw_mul(slope_d, vertex.throughput), time.direct)
            r.own = r.late + job.scale * wp.dot(wp.cw_mul(slope_e, vertex.throughput), time.emission)
        return r

    @wp.func
    def weighted(r: GatedVertex, channel: wp.int32) -> PathVertex:
        """The vertex with what it sends weighted for the loss, of one channel."""
        vertex = r.vertex
        vertex.direct = r.weight_e[channel] * r.time.emission + r.weight_d[channel] * r.time.direct
        vertex.e_weight *= r.weight_e[channel]
        vertex.light_weight *= r.weight_d[channel]
        return vertex

    @wp.func
    def stretch(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        sampler: Sampler,
        r: GatedVertex,
        carry_in: Carry,
        s_n: wp.float32,
    ) -> Carry:
        """Add the adjoints of |x_n - x_{n-1}|, S_n, and of |y - x_n| to the points of their ends."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        carry = carry_in
        if r.vertex.face >= 0:
            x = point_at(scene, scene.triangles[r.vertex.face], r.vertex.u, r.vertex.v)
            g = (r.time.segment * s_n) * wp.normalize(x - r.vertex.o)
            carry.a_x = carry.a_x - g
            if r.vertex.light >= 0 and r.late != 0.0:
                g_y = (r.time.eta * r.late) * wp.normalize(light_point(scene, r.vertex) - x)
                g -= g_y
                if accumulate_light_point(scene, target, r.vertex, g_y) != 0.0:
                    count_invalid(scene, sampler)
            carry.adjoint.x = carry.adjoint.x + g
        return carry

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def time_gated(
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
        record = wp.zeros(shape=(wp.static(most),), dtype=GatedVertex)
        starting = wp.zeros(shape=(wp.static(lanes),), dtype=PathState)
        cameras = wp.zeros(shape=(wp.static(lanes),), dtype=CameraSample)
        for i in range(job.samples):
            sampler = sampler_at(pixel.number, job.first_sample + i, job.seed)
            state, sample = starts(scene, camera, pixel.px, pixel.py, sampler, i, job.samples, starting, cameras)
            touched_requested = scene.requested_shapes[scene.requested_shapes.shape[0] - 1]
            if wp.static(config.through):
                touched_requested += 1  # shadow rays meet shapes as well
            state.touched_requested = touched_requested
            count = wp.int32(0)
            length = wp.float32(0.0)
            valid = wp.bool(True)
            while state.alive == 1:
                eta = state.eta
                vertex, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
                if count == 0:
                    vertex.o = camera_origin(scene, camera, sample)
                time = timed_vertex(scene, gates, vertex, count == 0, eta, length)
                length = time.length
                valid = valid and finite(wp.cw_mul(vertex.throughput, vertex.direct))
                record[count] = gated_vertex(vertex, time, gates, job, pixel.py, pixel.px)
                count += 1
                if vertex.face >= 0:
                    touched_requested += scene.requested_shapes[scene.triangles[vertex.face].shape]
            if not valid:
                count_invalid(scene, sampler)
            if touched_requested == 0 or not valid:
                continue
            for channel in range(3):
                delta = wp.vec3(0.0, 0.0, 0.0)
                delta[channel] = job.scale
                carry = Carry()
                carry.face = -2
                s_n = wp.float32(0.0)
                n = count - 1
                while n >= 0:
                    carry = sweep(scene, target, weighted(record[n], channel), delta, carry)
                    if wp.static(moves):
                        # For all channels at once.
                        if channel == 0:
                            s_n += record[n].own
                            carry = stretch(scene, target, sampler, record[n], carry, s_n)
                    n -= 1
                if finish(scene, target, camera, sample, carry) != 0.0 or not finite(carry.radiance):
                    count_invalid(scene, sampler)

    return time_gated
