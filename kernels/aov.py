"""What the camera sees first: depth, position, normals, texture coordinates, albedo and indices, averaged over a pixel.

The channels are those of Mitsuba's ``aov`` integrator, under its names. All channels are 0 where a ray leaves the
scene. Depth is the distance along the ray from the near clip plane. The albedo is pi f_s for light that leaves along
the shading normal: the reflectance of a diffuse surface, and 0 for models without a smooth lobe.
"""

import functools

import warp as wp

from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import PI
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.invalid import count_invalid, finite
from warp_psdr.kernels.jobs import PixelJob, pixel_of
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path import make_camera_start
from warp_psdr.kernels.primitive.affine import is_primitive
from warp_psdr.kernels.primitive.dispatch import make_partials
from warp_psdr.kernels.reading import shape_at, triangle_at
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import make_visibility

#: Where a kind's values stand in a pixel's row, and how many there are.
CHANNELS = {
    "depth": (0, 1),
    "position": (1, 3),
    "uv": (4, 2),
    "geo_normal": (6, 3),
    "sh_normal": (9, 3),
    "dp_du": (12, 3),
    "dp_dv": (15, 3),
    "albedo": (18, 3),
    "prim_index": (21, 1),
    "shape_index": (22, 1),
    "mask": (23, 1),
}
ROW = 24


@wp.func
def add3(row: wp.array(dtype=wp.float64), first: wp.int32, value: wp.vec3):
    """Add to three values of a row."""
    row[first] = row[first] + wp.float64(value[0])
    row[first + 1] = row[first + 1] + wp.float64(value[1])
    row[first + 2] = row[first + 2] + wp.float64(value[2])


@functools.cache
def make_aov_kernel(config: PathConfig):
    """Return the kernel: one thread a pixel, all its samples in order; each counts in its own pixel.

    ``config``: of a scene that reads texture coordinates, and whose lights the camera sees.
    """
    start = make_camera_start(config)
    closest = make_visibility(config.rays.backend, config.rays.width, False, config.surfaces.primitives).closest
    partials = make_partials(config.surfaces.primitives)
    interaction = make_interaction(config.surfaces, config.lights)
    surface_at, interaction_at, bsdf_eval = interaction.surface, interaction.at, interaction.eval

    @wp.func
    def albedo_at(scene: Scene, hit: RayHit, d: wp.vec3) -> wp.vec3:
        albedo = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(bsdf_eval is not None):
            at = interaction_at(scene, hit.face, hit.u, hit.v, d)
            # Also of the back of what scatters on its front only.
            at.wi = wp.vec3(at.wi[0], at.wi[1], wp.abs(at.wi[2]))
            albedo = PI * bsdf_eval(at, wp.vec3(0.0, 0.0, 1.0))
        return albedo

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def aov(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        job: PixelJob,
        # Out:
        rows_out: wp.array3d(dtype=wp.float32),
    ):
        pixel = pixel_of(job, camera, wp.tid())
        row = wp.zeros(shape=(ROW,), dtype=wp.float64)
        for i in range(job.samples):
            sampler = sampler_at(pixel.number, job.first_sample + i, job.seed)
            state, _sample = start(scene, camera, pixel.px, pixel.py, sampler)
            hit = closest(scene, state.o, state.d, state.t_max)
            if hit.face >= 0:
                tri = triangle_at(scene, hit.face)
                surface = surface_at(scene, hit.face, hit.u, hit.v)
                albedo = albedo_at(scene, hit, state.d)
                if not finite(surface.x + surface.n + albedo):
                    count_invalid(scene, sampler)
                    continue
                dp_du, dp_dv = partials(scene, tri, hit.u, hit.v)
                row[0] = row[0] + wp.float64(hit.t)
                add3(row, 1, surface.x)
                row[4] = row[4] + wp.float64(surface.uv[0])
                row[5] = row[5] + wp.float64(surface.uv[1])
                add3(row, 6, surface.ng)
                add3(row, 9, surface.n)
                add3(row, 12, dp_du)
                add3(row, 15, dp_dv)
                add3(row, 18, albedo)
                number = wp.where(is_primitive(tri), 0, hit.face - shape_at(scene, tri.shape).first_face)
                row[21] = row[21] + wp.float64(number)
                row[22] = row[22] + wp.float64(tri.shape)
                row[23] = row[23] + wp.float64(1.0)
        for k in range(ROW):
            rows_out[pixel.py, pixel.px, k] = wp.float32(row[k] / wp.float64(job.samples))

    return aov
