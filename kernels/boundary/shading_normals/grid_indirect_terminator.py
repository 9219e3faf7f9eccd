"""The terminator of a grid's interpolated normals as seen from path vertices other than the camera.

As on meshes (``indirect_terminator.py``), the light that x scatters towards the vertex y before it jumps where n(x) .
(y - x) = 0. x slides along the ray by which y finds it (form S, ``docs/theory/implicit.md#form-s``).

Derivation: ``docs/theory/shading_normals.md#terminators-of-grids``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.shading_normals.indirect_terminator import FLAT, make_jump
from warp_psdr.kernels.boundary.silhouette.grid_points import (
    GridItems,
    area_of_voxel_area,
    choose_item,
    item_parts,
    surface_point,
)
from warp_psdr.kernels.boundary.transport import Segment, make_transport
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.primitive.affine import step_off_primitive
from warp_psdr.kernels.primitive.dispatch import make_adjoint_sink
from warp_psdr.kernels.primitive.sdfgrid import grid_of, pack
from warp_psdr.kernels.primitive.sdfgrid_adjoint import make_sdfgrid_sink
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of

#: Sample slots of the item and its point, and of the direction; those of the walk follow (``transport.py``).
SLOT_ITEM, SLOT_THETA = 0, 1


@functools.cache
def make_grid_indirect_terminator_kernel(config: PathConfig, role: str, camera_moves: bool):
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``)."""
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    surface_at = make_interaction(config.surfaces, config.lights).surface
    accumulate_turned = make_sdfgrid_sink(role)
    accumulate_vertex = make_adjoint_sink(role, False, False, False, False, False, True, config.surfaces.primitives)
    transport = make_transport(config, role, camera_moves, make_jump(config), 2)
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_4d = draw.sample_4d

    @wp.func
    def accumulate_grid_terminator(
        scene: Scene, target: wp.array(dtype=wp.float32), s: Segment, w: wp.float32
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        turned = VertexAdjoint()
        turned.n = -w * s.w
        tri = scene.triangles[s.face2]
        found = accumulate_turned(scene, target, tri, s.u2, s.v2, turned, True, s.x - s.t1 * s.w, s.w)
        # What the ray is tied to: it carries x along, and against it the path vertex y moves.
        tied = VertexAdjoint()
        tied.x = found.o + w * s.boundary_normal
        started = accumulate_vertex(scene, target, s.face1, s.u1, s.v1, tied, False, s.x, s.w)
        return found.dot + started.dot

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def grid_indirect_terminator(
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
        u4 = sample_4d(sampler, SLOT_ITEM)
        count = found.items.shape[0]
        n, along = choose_item(found, count, (wp.float64(number) + wp.float64(u4[0])) / wp.float64(job.samples))
        item = found.items[n]
        tri = scene.triangles[item[0]]
        g = grid_of(scene, tri)
        point = surface_point(scene, tri, g, item_parts(g, item[1]), along, u4[1])
        if point.valid == 0:
            return
        s = Segment()
        s.light = -1
        s.face2 = item[0]
        uv = pack(point.q)
        s.u2 = uv[0]
        s.v2 = uv[1]
        surface = surface_at(scene, s.face2, s.u2, s.v2)
        across = surface.ng - wp.dot(surface.ng, surface.n) * surface.n
        sine = wp.length(across)
        if sine < FLAT:
            return
        across = across / sine
        # theta: its sine is uniform, its cosine has either sign.
        theta = sample_1d(sampler, SLOT_THETA)
        half = wp.where(theta < 0.5, 0.0, 1.0)
        b = 4.0 * theta - 2.0 * half - 1.0
        a = (1.0 - 2.0 * half) * wp.sqrt(wp.max(1.0 - b * b, 0.0))
        out = a * across + b * wp.cross(surface.n, across)
        s.x = surface.x
        s.w = -out
        away = step_off_primitive(scene, tri)
        s.step = away
        hit = visibility.closest(scene, s.x + ((1.0 - 2.0 * half) * away) * surface.ng, out, FAR)
        if hit.face < 0 or hit.t <= away:
            return
        s.t1 = hit.t
        s.boundary_normal = (-1.0 / s.t1) * surface.n
        s.face1 = hit.face
        s.u1 = hit.u
        s.v1 = hit.v
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = accumulate_grid_terminator(scene, target, s, 1.0)
        # |n_g . w| / pdf_theta = 4 sin(alpha)
        scale = 4.0 * sine * wp.float32(count) * area_of_voxel_area(tri, g, point)
        scale /= point.density * wp.float32(job.samples)
        weight = transport(scene, camera, sampler, s, scale, rest, job, target, image_out)
        if wp.static(role != "forward"):
            if weight != 0.0:
                if accumulate_grid_terminator(scene, target, s, weight) != 0.0:
                    count_invalid(scene, sampler)

    return grid_indirect_terminator
