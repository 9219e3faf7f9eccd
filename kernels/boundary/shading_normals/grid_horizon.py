"""The horizon on a grid of signed distances, where the interpolated normal differs from the surface normal.

As on triangles (``geometric_horizon.py``), the incident light jumps where a direction w enters the surface: phi = n_g .
w = 0, with the surface normal n_g. The vertex slides along the ray that finds it (form S,
``docs/theory/implicit.md#form-s``), and n_g turns on the way.

Derivation: ``docs/theory/shading_normals.md#horizons-of-grids``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.depth import make_indirect
from warp_psdr.kernels.boundary.shading_normals.geometric_horizon import make_horizon_source
from warp_psdr.kernels.boundary.shading_normals.indirect_terminator import FLAT, TILT
from warp_psdr.kernels.boundary.silhouette.grid_points import (
    GridItems,
    area_of_voxel_area,
    choose_item,
    item_parts,
    surface_point,
)
from warp_psdr.kernels.boundary.transport import Segment, make_transport
from warp_psdr.kernels.bsdf.dispatch import passing
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.primitive.affine import step_off_primitive
from warp_psdr.kernels.primitive.dispatch import make_adjoint_sink, slides_on
from warp_psdr.kernels.primitive.sdfgrid import grid_of, pack
from warp_psdr.kernels.primitive.sdfgrid_adjoint import make_sdfgrid_sink
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of

#: Sample slots of the item and its point, and of theta and the side; those of the walk follow (``transport.py``).
SLOT_ITEM, SLOT_THETA = 0, 1


@functools.cache
def make_bent_first_sink(role: str, _primitives: tuple[int, ...] = ()):
    """Return ``make_first_sink``'s function for a vertex of a grid whose geometric normal counts as well."""
    accumulate_bent = make_sdfgrid_sink(role, geometric=True)

    @wp.func
    def accumulate_bent_first(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        segment: Segment,
        w: wp.float32,
        by_ray: wp.bool,
        o: wp.vec3,
        d: wp.vec3,
    ) -> tuple[wp.vec3, wp.vec3, wp.float32]:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        adjoint = VertexAdjoint()
        adjoint.x = ((segment.tau - 1.0) * w) * segment.boundary_normal
        adjoint.n = w * segment.w
        tri = scene.triangles[segment.face1]
        found = accumulate_bent(scene, target, tri, segment.u1, segment.v1, adjoint, by_ray, o, d)
        return found.o, found.d, found.dot

    return accumulate_bent_first


@functools.cache
def make_grid_horizon_kernel(config: PathConfig, role: str, camera_moves: bool, indirect: bool = False):
    """Return the kernel: one thread a sample; arguments as those of ``make_secondary_kernel``."""
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    surface_at = make_interaction(config.surfaces, config.lights).surface
    accumulate_vertex = make_adjoint_sink(role, False, False, False, False, False, True, config.surfaces.primitives)
    source = make_indirect(make_horizon_source(config)) if indirect else make_horizon_source(config)
    transport = make_transport(config, role, camera_moves, source, first=make_bent_first_sink)
    both = config.surfaces.two_sided or bool(passing(config.surfaces.bsdfs))
    draw = make_sampler(config.sampler)
    sample_2d = draw.sample_2d
    sample_4d = draw.sample_4d

    @wp.func
    def accumulate_other_end(scene: Scene, target: wp.array(dtype=wp.float32), s: Segment, w: wp.float32) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        if wp.length_sq(s.boundary_normal) == 0.0:
            return 0.0
        other = VertexAdjoint()
        other.x = w * s.boundary_normal
        met = accumulate_vertex(scene, target, s.face2, s.u2, s.v2, other, False, s.x, s.w)
        return met.dot

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def grid_horizon(
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
        s.face1 = item[0]
        uv = pack(point.q)
        s.u1 = uv[0]
        s.v1 = uv[1]
        surface = surface_at(scene, s.face1, s.u1, s.v1)
        across = surface.n - wp.dot(surface.n, surface.ng) * surface.ng
        sine = wp.length(across)
        if sine < FLAT:
            return
        across = across / sine
        u2 = sample_2d(sampler, SLOT_THETA)
        # theta: its sine is uniform. Where n . w < 0, only materials with two sides, or a lobe behind, scatter.
        half = wp.float32(0.0)
        b = 2.0 * u2[0] - 1.0
        chance = wp.float32(1.0)
        if wp.static(both):
            half = wp.where(u2[0] < 0.5, 0.0, 1.0)
            b = 4.0 * u2[0] - 2.0 * half - 1.0
            chance = wp.float32(0.5)
        cosine = wp.sqrt(wp.max(1.0 - b * b, 0.0))
        if cosine <= 0.0:
            return
        flat = (1.0 - 2.0 * half) * cosine * across + b * wp.cross(surface.ng, across)
        sign = wp.where(u2[1] < 0.5, 1.0, -1.0)
        s.radiance = wp.vec3(sign, 0.0, 0.0)
        s.w = wp.normalize(flat + (sign * TILT) * surface.ng)
        s.x = surface.x
        away = step_off_primitive(scene, tri)
        s.source = s.x + (sign * away) * surface.ng
        hit = visibility.closest(scene, s.source, s.w, FAR)
        s.face2 = hit.face
        if hit.face >= 0:
            if hit.t <= away:
                return
            s.u2 = hit.u
            s.v2 = hit.v
            # What slides along w moves across n_g as x does, which is nothing.
            if not slides_on(scene.triangles[hit.face]):
                s.boundary_normal = surface.ng / hit.t
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = accumulate_other_end(scene, target, s, 1.0)
        # One of two sides; pdf_theta = chance |cos(theta)| / 2.
        density = chance * cosine * point.density * wp.float32(job.samples)
        scale = 4.0 * wp.float32(count) * area_of_voxel_area(tri, g, point) * wp.abs(wp.dot(surface.ng, s.w)) / density
        weight = transport(scene, camera, sampler, s, scale, rest, job, target, image_out)
        if wp.static(role != "forward"):
            if weight != 0.0:
                if accumulate_other_end(scene, target, s, weight) != 0.0:
                    count_invalid(scene, sampler)

    return grid_horizon
