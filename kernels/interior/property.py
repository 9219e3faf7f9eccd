"""Interior term of a property that the camera sees first (``kernels/property.py``), in both modes.

A path has one vertex, found by a ray that rests on the film: the adjoint of its property goes to the surface, along the
ray, and to the camera, as the last step of every sweep has it.

Derivation: ``docs/theory/interior.md#properties-of-surfaces``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.sweep import Carry, make_sweep
from warp_psdr.kernels.invalid import count_invalid, finite, vanishes
from warp_psdr.kernels.jobs import PixelJob, pixel_of
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path import make_camera_start
from warp_psdr.kernels.property import make_property_step, make_property_vjp
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_ray
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, PathVertex


@functools.cache
def make_property_kernel(config: PathConfig, wanted: GradientRequest, role: str):
    """Return the kernel; arguments as ``make_replay_kernel``'s, ``role`` as ``make_sweep``'s."""
    start = make_camera_start(config)
    step = make_property_step(config, False)
    _camera_ray, camera_origin = make_camera_ray(config.camera)
    property_vjp = make_property_vjp(config.shown)
    _sweep, finish, _finish_vertex = make_sweep(config, wanted, role)

    @wp.func
    def differentiated(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        camera: Camera,
        sample: CameraSample,
        vertex: PathVertex,
        a: wp.vec3,
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        carry = Carry()
        carry.face = vertex.face
        carry.u = vertex.u
        carry.v = vertex.v
        carry.o = vertex.o
        carry.d = vertex.d
        adjoint, a_o = property_vjp(vertex.d, a)
        carry.adjoint = adjoint
        carry.a_x = a_o
        return finish(scene, target, camera, sample, carry)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def of_property(
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
        delta = wp.vec3(job.scale, job.scale, job.scale)
        if wp.static(role != "forward"):
            delta = job.scale * job.image_adjoint[pixel.py, pixel.px]
            if vanishes(delta):
                return
        total = wp.vec3(0.0, 0.0, 0.0)
        for i in range(job.samples):
            sampler = sampler_at(pixel.number, job.first_sample + i, job.seed)
            state, sample = start(scene, camera, pixel.px, pixel.py, sampler)
            vertex, _after = step(scene, sampler, state, job.max_depth, job.rr_depth)
            if vertex.face >= 0:
                vertex.o = camera_origin(scene, camera, sample)
                if wp.static(role == "forward"):
                    found = wp.vec3(0.0, 0.0, 0.0)
                    for k in range(3):
                        a = wp.vec3(0.0, 0.0, 0.0)
                        a[k] = 1.0
                        found[k] = differentiated(scene, target, camera, sample, vertex, wp.cw_mul(delta, a))
                    if finite(found):
                        total += found
                    else:
                        count_invalid(scene, sampler)
                else:
                    if differentiated(scene, target, camera, sample, vertex, delta) != 0.0:
                        count_invalid(scene, sampler)
        if wp.static(role == "forward"):
            image_out[pixel.py, pixel.px] = image_out[pixel.py, pixel.px] + total

    return of_property
