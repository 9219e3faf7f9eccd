"""The edge of a grid's own shadow under point, spot and directional lights, inside of voxels.

Under interpolated normals, a light of no area still has a positive cosine at the horizon n_g . w = 0 of the surface,
beyond which the body occludes it. The horizon is the silhouette that the light sees, and the vertex lies on it. The
terms of creases cover horizons on creases (``CREASES`` of ``silhouette/grid_sampling.py``).

Derivation: ``docs/theory/shading_normals.md#horizons-of-grids``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.path_space.secondary import make_source_sink
from warp_psdr.kernels.boundary.shading_normals.grid_horizon import make_bent_first_sink
from warp_psdr.kernels.boundary.shading_normals.indirect_terminator import TILT
from warp_psdr.kernels.boundary.silhouette.aim import SLOT_DIRECTION, SLOT_SILHOUETTE, make_light_aim
from warp_psdr.kernels.boundary.silhouette.grid_points import (
    GridItems,
    choose_item,
    curve_point,
    eye_in_voxels,
    item_parts,
    touch_curvature,
)
from warp_psdr.kernels.boundary.transport import Segment, make_source, make_transport
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.emitter.dispatch import is_delta_light, make_delta_sample
from warp_psdr.kernels.invalid import count_invalid, vanishes
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.notes import NOTE_POINT, make_note
from warp_psdr.kernels.primitive.affine import step_off_primitive
from warp_psdr.kernels.primitive.sdfgrid import grid_of, pack
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of


@functools.cache
def make_grid_light_horizon_kernel(config: PathConfig, role: str, camera_moves: bool, light_pose: bool):
    """Return the kernel: one thread a sample; arguments as those of ``make_grid_horizon_kernel``."""
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    light_aim = make_light_aim(config.lights)
    delta_sample = make_delta_sample(config.lights.others)
    accumulate_source = make_source_sink(role, light_pose, config.surfaces.primitives)
    transport = make_transport(config, role, camera_moves, make_source(config), first=make_bent_first_sink)
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_4d = draw.sample_4d
    note_place = make_note(config.noted)

    @wp.func
    def accumulate_light(
        scene: Scene, target: wp.array(dtype=wp.float32), at: Segment, light: wp.int32, ng: wp.vec3, w: wp.float32
    ) -> wp.float32:
        """The adjoint of the light: n_g / d of its place, n_g of its direction."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        lit = at
        lit.light = light
        # Opposite to what a segment that touches an occluder has, at tau = t_1 = 1.
        lit.tau = -1.0
        lit.t1 = -1.0
        if wp.length_sq(at.boundary_normal) == 0.0:
            lit.boundary_normal = ng
        return accumulate_source(scene, target, lit, w, 0.0)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def grid_light_horizon(
        # Scene:
        scene: Scene,
        camera: Camera,
        found: GridItems,
        # In:
        job: SampleJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        number = job.first + wp.tid()
        sampler = sampler_at(number, 0, job.seed)
        u = (wp.float64(number) + wp.float64(sample_1d(sampler, SLOT_SILHOUETTE))) / wp.float64(job.samples)
        n, along = choose_item(found, found.aimed, u)
        item = found.items[n]
        tri = scene.triangles[item[0]]
        g = grid_of(scene, tri)
        aim = light_aim(scene, tri.normal, sample_4d(sampler, SLOT_DIRECTION))
        if aim.valid == 0:
            return
        emitter = scene.emitters[aim.light]
        if not is_delta_light(emitter.kind):
            return
        eye = eye_in_voxels(tri, g, aim.eye, aim.distant)
        point = curve_point(scene, tri, g, item_parts(g, item[1]), eye, aim.distant, along)
        if point.valid == 0:
            return
        s = Segment()
        s.face1 = item[0]
        s.face2 = -1
        s.light = -1  # no silhouette of an occluder that another one may hide
        uv = pack(point.q)
        s.u1 = uv[0]
        s.v1 = uv[1]
        s.x = point.x
        way = aim.eye
        distance = wp.float32(FAR)
        if not aim.distant:
            way = aim.eye - point.x
            distance = wp.length(way)
            s.boundary_normal = point.out / distance
        way = wp.normalize(way)
        curvature = touch_curvature(tri, g, point, way)
        if curvature <= 0.0:
            return
        s.source = s.x + step_off_primitive(scene, tri) * point.out
        sent = delta_sample(scene, emitter, s.x, wp.vec2(0.0, 0.0))
        if sent.pdf <= 0.0 or vanishes(sent.radiance):
            return
        if visibility.occluded(scene, s.source, way, distance):
            return
        s.known = 1
        s.radiance = sent.radiance / emitter.probability
        s.w = wp.normalize(way + TILT * point.out)
        note_place(scene, NOTE_POINT, item[0], uv[0], uv[1], point.x, s.w, s.radiance)
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = accumulate_light(scene, target, s, aim.light, point.out, 1.0)
        scale = wp.float32(found.aimed) * wp.length(wp.cross(point.along, way)) * wp.abs(wp.dot(point.out, s.w))
        scale /= curvature * point.density * wp.float32(job.samples)
        weight = transport(scene, camera, sampler, s, scale, rest, job, target, image_out)
        if wp.static(role != "forward"):
            if weight != 0.0:
                if accumulate_light(scene, target, s, aim.light, point.out, weight) != 0.0:
                    count_invalid(scene, sampler)

    return grid_light_horizon
