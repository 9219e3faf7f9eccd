"""Interior term by record and sweep: path replay [VSJ21] without its division ([ZCZ25] eq. 12 first term, eq. 55).

With L_n = E_n + D_n + beta_n L_{n+1} and the detached prefix A_n, the derivative of one sample is sum_n A_n . ( dE_n +
dD_n + dbeta_n L_{n+1} ). A backward sweep that carries L_{n+1} needs no division by a factor, so the derivative is
right even where a factor is exactly zero. Longer paths are replayed in blocks of K vertices.

Derivation: ``docs/theory/interior.md#replay-by-record-and-sweep``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.bsdf.dispatch import is_diffuse
from warp_psdr.kernels.camera_rays import make_camera_paths, make_pixel_bundle
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.sweep import Carry, make_sweep
from warp_psdr.kernels.invalid import count_invalid, finite, vanishes
from warp_psdr.kernels.jobs import PixelJob, pixel_of
from warp_psdr.kernels.lanes.lanes import ROOM, ROWS
from warp_psdr.kernels.lanes.material_sweep import make_material_sweep, sweeps_materials
from warp_psdr.kernels.lanes.path_lanes import LanePaths, make_lane_paths, side_by_side
from warp_psdr.kernels.lanes.sweep_lanes import make_lane_sweep
from warp_psdr.kernels.lanes.sweep_sinks import make_chosen
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.scattering import samples_lights
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_ray
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, PathState, PathVertex


@functools.cache
def make_replay_kernel(config: PathConfig, wanted: GradientRequest, block: int, blocks: int):
    """Return the reverse-mode kernel of ``interior.Replay``.

    Args:
        config: what the scene needs.
        wanted: what is differentiated.
        block: K, the number of vertices kept at a time.
        blocks: the most blocks that a path can have; 1 compiles the replay out.
    """
    if blocks == 1 and side_by_side(config):
        has_lights = samples_lights(config.lights, config.surfaces.bsdfs)
        ways = [(make_sweep_of_each, has_lights), (make_sweep_of_each, False)]
        if wanted.geometry and is_diffuse(config.surfaces.bsdfs) and not config.surfaces.primitives:
            ways.insert(0, (make_lane_sweep, False))
        elif sweeps_materials(config, wanted):
            ways.insert(0, (make_material_sweep, True))
        for make, lit in ways:
            paths = make_lane_paths(config, True, True, kept=block, whole=make is make_lane_sweep, lit=lit)
            end, sweep_all = make(config, wanted, paths)
            if end <= ROOM:
                return _make_lane_kernel(paths, sweep_all, config.through)
    lanes, starts, path_step = make_camera_paths(config, True, True)
    _camera_ray, camera_origin = make_camera_ray(config.camera)
    sweep, finish, _finish_vertex = make_sweep(config, wanted, "reverse")

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def replay(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        job: PixelJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        pixel = pixel_of(job, camera, wp.tid())
        delta = job.scale * job.image_adjoint[pixel.py, pixel.px]
        if vanishes(delta):
            return
        record = wp.zeros(shape=(wp.static(block),), dtype=PathVertex)
        states = wp.zeros(shape=(wp.static(blocks),), dtype=PathState)
        starting = wp.zeros(shape=(wp.static(lanes),), dtype=PathState)
        cameras = wp.zeros(shape=(wp.static(lanes),), dtype=CameraSample)
        for i in range(job.samples):
            sampler = sampler_at(pixel.number, job.first_sample + i, job.seed)
            state, sample = starts(scene, camera, pixel.px, pixel.py, sampler, i, job.samples, starting, cameras)
            origin = camera_origin(scene, camera, sample)
            count = wp.int32(0)
            touched_requested = scene.requested_shapes[scene.requested_shapes.shape[0] - 1]
            if wp.static(config.through or config.points_pass):
                touched_requested += 1  # shadow rays meet shapes as well
            state.touched_requested = touched_requested
            radiance = wp.vec3(0.0, 0.0, 0.0)
            while state.alive == 1:
                if wp.static(blocks > 1):
                    if count % wp.static(block) == 0:
                        states[count // wp.static(block)] = state
                vertex, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
                if count == 0:
                    vertex.o = origin
                record[count % wp.static(block)] = vertex
                count += 1
                radiance += wp.cw_mul(vertex.throughput, vertex.direct)
                if vertex.face >= 0:
                    touched_requested += scene.requested_shapes[scene.triangles[vertex.face].shape]
            if touched_requested == 0:
                if not finite(radiance):
                    count_invalid(scene, sampler)
                continue
            loaded = (count - 1) // wp.static(block)
            carry = Carry()
            carry.face = -2
            n = count - 1
            while n >= 0:
                if wp.static(blocks > 1):
                    if n // wp.static(block) != loaded:
                        loaded = n // wp.static(block)
                        again = states[loaded]
                        for j in range(wp.static(block)):
                            if again.alive == 1:
                                vertex, again = path_step(scene, sampler, again, job.max_depth, job.rr_depth)
                                if loaded == 0 and j == 0:
                                    vertex.o = origin
                                record[j] = vertex
                carry = sweep(scene, target, record[n % wp.static(block)], delta, carry)
                n -= 1
            if finish(scene, target, camera, sample, carry) != 0.0 or not finite(carry.radiance):
                count_invalid(scene, sampler)

    return replay


def make_sweep_of_each(config: PathConfig, wanted: GradientRequest, paths: LanePaths) -> tuple[int, wp.Function]:
    """Return what ``make_lane_sweep`` returns, for paths that are swept one after the other."""
    told = paths.light is not None
    sweep, finish, _finish_vertex = make_sweep(config, wanted, "reverse", told=told)
    _camera_ray, camera_origin = make_camera_ray(config.camera)
    chosen = make_chosen(paths)

    @wp.func
    def sweep_all(
        scene: Scene,
        camera: Camera,
        target: wp.array(dtype=wp.float32),
        scale: wp.float32,
        adjoint: wp.array2d(dtype=wp.vec3),
        count: wp.int32,
        always: wp.int32,
        rows: ROWS,
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        for j in range(count):
            path = chosen(scene, scale, adjoint, j, always, rows)
            n = wp.int32(path.vertices)
            if n > 0:
                sample = paths.camera(rows, j)
                carry = Carry()
                carry.face = -2
                while n > 0:
                    n -= 1
                    vertex = paths.vertex(rows, j, n)
                    if n == 0:
                        vertex.o = camera_origin(scene, camera, sample)
                    if wp.static(told):
                        light = paths.light(rows, j, n)
                        carry.lit = light.radiance
                        carry.crosses = light.crosses
                    carry = sweep(scene, target, vertex, path.delta, carry)
                if finish(scene, target, camera, sample, carry) != 0.0 or not finite(carry.radiance):
                    count_invalid(scene, paths.lane_samples.get(rows, j).sampler)

    return paths.end, sweep_all


def _make_lane_kernel(paths: LanePaths, sweep_all: wp.Function, through: bool):
    """The same for paths that are traced side by side; ``through``: shadow rays meet shapes as well."""
    pixel_bundle = make_pixel_bundle(paths.width)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def replay_lanes(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        job: PixelJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        bundle = pixel_bundle(job, camera, wp.tid())
        weighted = wp.bool(False)
        for i in range(bundle.pixels):
            pixel = job.pixels[bundle.first + i]
            weight = job.image_adjoint[pixel // bundle.raster, pixel % bundle.raster]
            weighted = weighted or not vanishes(job.scale * weight)
        if not weighted:
            return
        rows = scene.rows
        always = scene.requested_shapes[scene.requested_shapes.shape[0] - 1]
        if wp.static(through):
            always += 1
        done = wp.int32(0)
        while done < job.samples:
            bundle.first_sample = job.first_sample + done
            bundle.samples = wp.min(job.samples - done, wp.static(paths.width))
            done += bundle.samples
            paths.start(scene, camera, paths.view(scene, camera), job.pixels, bundle, 0, always, rows)
            n = wp.int32(0)
            alive = wp.int32(1)
            while alive > 0:
                alive = paths.step(scene, n, job.max_depth, job.rr_depth, rows)
                n += 1
            count = bundle.pixels * bundle.samples
            sweep_all(scene, camera, target, job.scale, job.image_adjoint, count, always, rows)

    return replay_lanes
