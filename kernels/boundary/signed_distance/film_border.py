"""Flux of moving rays across the borders of pixels, where the pixel filter jumps [VSJ22, BLD20, LHJ19].

A box filter counts nothing beyond its pixel, and moving rays do not stop at the border. With U the motion of rays on
the film, the integral over a pixel loses or gains L U . n along its border. What one pixel loses, its neighbour gains.
Other filters have such a flux only where the border of the film cuts them.

Derivation: ``docs/theory/signed_distances.md#the-film``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.signed_distance.warp_field import Beyond, WarpOptions, make_warp_field
from warp_psdr.kernels.boundary.warped_area.auxiliary import AuxiliaryBundle, WarpedOptions
from warp_psdr.kernels.boundary.warped_area.ray_motion import make_ray_motion
from warp_psdr.kernels.boundary.warped_area.rotation import RotationOptions
from warp_psdr.kernels.constants import RFILTER_BOX
from warp_psdr.kernels.invalid import count_invalid, vanishes
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path import make_path_radiance
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_ray
from warp_psdr.kernels.sensor.projection import make_projection, make_splat
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, film_position, path_from

#: Distance from a border at which either side is asked what it counts [pixels].
BESIDE = 1.0e-3


@functools.cache
def make_film_border_kernel(
    config: PathConfig, role: str, options: WarpOptions | WarpedOptions | RotationOptions
) -> wp.Kernel:
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``)."""
    meshes = not isinstance(options, WarpOptions)
    if isinstance(options, WarpOptions):
        moved = make_warp_field(config.surfaces.primitives[0], options, role)
    else:
        moved = make_ray_motion(config.rays, config.surfaces.primitives, options, role)
    path_radiance = make_path_radiance(config)
    camera_ray, _origin = make_camera_ray(config.camera)
    project, film_gradient, _velocity = make_projection(config.camera)
    splat, gather = make_splat()
    draw = make_sampler(config.sampler)
    sample_2d = draw.sample_2d
    every = config.filter == RFILTER_BOX

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def film_border(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        job: SampleJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        number = job.first + wp.tid()
        sampler = sampler_at(number, 0, job.seed)
        u = sample_2d(sampler, 0)
        # ---- A point of the borders: lines across the film, each as long as the film ----
        width = camera.crop_width
        height = camera.crop_height
        columns = wp.int32(2)
        rows = wp.int32(2)
        if wp.static(every):
            columns = width + 1
            rows = height + 1
        upright = columns * height
        count = upright + rows * width
        place = (wp.float64(number) + wp.float64(u[0])) * wp.float64(count) / wp.float64(job.samples)
        k = wp.min(wp.int32(place), count - 1)
        along = wp.float32(place - wp.float64(k))
        n = wp.vec2(1.0, 0.0)
        at = wp.vec2(0.0, wp.float32(k % height) + along)
        line = k // height
        last = columns - 1
        length = width
        if k >= upright:
            k -= upright
            n = wp.vec2(0.0, 1.0)
            at = wp.vec2(wp.float32(k % width) + along, 0.0)
            line = k // width
            last = rows - 1
            length = height
        at += wp.float32(line * length // last) * n
        # ---- Its ray ----
        sample = CameraSample()
        sample.film = film_position(camera, 0, 0, at - wp.vec2(0.5, 0.5))
        ray = camera_ray(scene, camera, sample)
        point = project(scene, camera, ray.o + ray.d, wp.vec2(0.0, 0.0))
        if wp.static(meshes):
            bundle = AuxiliaryBundle()
            bundle.o = ray.o
            bundle.start = ray.o + ray.t_min * ray.d
            bundle.w = ray.d
            bundle.pixels = wp.length(film_gradient(scene, camera, point, wp.vec2(1.0, 0.0)))
            warp = moved.trace(scene, sampler, 0, bundle)
        else:
            warp = moved.trace(scene, ray.o, ray.d)
            if warp.moves == 0:
                return
        below = at - BESIDE * n
        above = at + BESIDE * n
        weight = wp.vec3(1.0, 1.0, 1.0)
        if wp.static(role != "forward"):
            weight = gather(camera, above, job.image_adjoint) - gather(camera, below, job.image_adjoint)
            if vanishes(weight):
                return
        state = path_from(ray.o + ray.t_min * ray.d, ray.d, ray.t_max - ray.t_min, 0)
        radiance = path_radiance(scene, sampler, state, job.max_depth, job.rr_depth)
        # ---- Accumulation ----
        scale = wp.float32(count) / wp.float32(job.samples)
        if wp.static(role != "forward"):
            scale *= wp.dot(weight, radiance)
        a_w = scale * film_gradient(scene, camera, point, n)
        if wp.static(meshes):
            speed = moved.pull(scene, target, warp, 0.0, a_w).dot
        else:
            speed = moved.pull(scene, target, ray.o, ray.d, warp, Beyond(), 0.0, a_w).dot
        if wp.static(role == "forward"):
            splat(scene, sampler, camera, above, speed * radiance, image_out)
            splat(scene, sampler, camera, below, -speed * radiance, image_out)
        else:
            if speed != 0.0:
                count_invalid(scene, sampler)

    return film_border
