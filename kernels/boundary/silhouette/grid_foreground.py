"""The foreground of grids of signed distances: light that they send to path vertices past creases and silhouettes.

A vertex of a grid slides along the ray that finds it, and the ray starts at x_1, whose surface it follows (form S,
``docs/theory/implicit.md#form-s``). The border of the visible part therefore moves against the grid: past a silhouette
the term L_- (x_b' - c_1') counts, where L_- is the light of the grid and c_1' the velocity at x_1. At creases that are
seen from the front (``shading``) the light jumps because the normal does.

Derivation: ``docs/theory/implicit.md#silhouettes-of-grids``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.detector import Incident, difference, make_incident
from warp_psdr.kernels.boundary.film_edge import AHEAD, BESIDE
from warp_psdr.kernels.boundary.path_space.direction import pdf_wedge, wedge_direction
from warp_psdr.kernels.boundary.path_space.secondary import moves
from warp_psdr.kernels.boundary.pull_record import record_pull
from warp_psdr.kernels.boundary.silhouette.aim import SLOT_DIRECTION, SLOT_SILHOUETTE
from warp_psdr.kernels.boundary.silhouette.ends import is_beside_curve, make_sensor_end
from warp_psdr.kernels.boundary.silhouette.grid_points import (
    VOXEL_ITEM,
    GridItems,
    TouchPoint,
    ahead_of_sheet,
    choose_item,
    crease_point,
    crease_side,
    from_voxels,
    item_parts,
    make_touch_sink,
    shows_both_sheets,
    surface_point,
    touch_curvature,
)
from warp_psdr.kernels.boundary.silhouette.grid_sampling import crease_wedge, own_density, own_direction
from warp_psdr.kernels.boundary.silhouette.grid_secondary import make_outline
from warp_psdr.kernels.boundary.silhouette.network_points import network_surface_point
from warp_psdr.kernels.boundary.silhouette.spline_points import SLOT_ROOT, spline_curvature, spline_surface_point
from warp_psdr.kernels.boundary.silhouette.touch import FRONT, MARGIN, TRIES, WIDER
from warp_psdr.kernels.boundary.transport import Segment, make_source, make_transport
from warp_psdr.kernels.constants import FAR, PI
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.notes import NOTE_POINT, make_note
from warp_psdr.kernels.primitive.affine import step_off_primitive
from warp_psdr.kernels.primitive.dispatch import make_adjoint_sink
from warp_psdr.kernels.primitive.network import network_of
from warp_psdr.kernels.primitive.sdfgrid import grid_of, pack
from warp_psdr.kernels.rng import Sampler, make_sampler, sampler_at
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of


@functools.cache
def make_foreground_grid_kernel(
    config: PathConfig, role: str, camera_moves: bool, shading: bool, cubic: bool = False, network: bool = False
):
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``); ``cubic``: smooth grids.

    ``network`` beside ``cubic``: networks, whose cells are the voxels of smooth grids.
    """
    visibility = visibility_of(config)
    sensor_end = make_sensor_end(config)
    accumulate_touch = make_touch_sink(role, cubic, network)
    record_of = network_of if network else grid_of
    smooth_surface_point = network_surface_point if network else spline_surface_point
    curvature_of = spline_curvature if cubic else touch_curvature
    outline_at = make_outline(cubic) if role == "samples" else None
    accumulate_vertex = make_adjoint_sink(role, False, False, False, False, False, True, config.primitives)
    incident = make_incident(config)

    @wp.func
    def jump_source(
        scene: Scene, sampler: Sampler, s: Segment, k: wp.int32, max_depth: wp.int32, rr_depth: wp.int32
    ) -> Incident:
        """What arrives from the sheet beside a crease on one side, less that on the other, where x starts."""
        below = incident(scene, sampler, s.source, s.w, FAR, k, max_depth, rr_depth)
        above = incident(scene, sampler, s.x, s.w, FAR, k, max_depth, rr_depth)
        return difference(below, above)

    source = jump_source if shading else make_source(config)
    transport = make_transport(config, role, camera_moves, source, 2)
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_4d = draw.sample_4d
    note_place = make_note(config.noted)

    @wp.func
    def start_beside(
        scene: Scene, point: TouchPoint, out: wp.vec3, side: wp.float32, s: Segment, curvature: wp.float32
    ) -> tuple[wp.vec3, wp.bool]:
        """Where a ray along the segment starts that meets the grid beside the point, and whether there is one."""
        apart = BESIDE * s.step
        k = wp.int32(0)
        while k < TRIES:
            met = wp.sqrt(2.0 * apart / wp.max(curvature, 1.0e-20))
            if point.crease == 1:
                met = apart * ahead_of_sheet(point, s.w, out)
            o = point.x + (side * apart) * out - wp.min(wp.max(AHEAD * s.step, MARGIN * met), s.t1) * s.w
            if visibility.closest(scene, o, s.w, FAR).face == point.face:
                return o, True
            apart *= WIDER
            k += 1
        return s.x, False

    @wp.func
    def accumulate(
        scene: Scene, target: wp.array(dtype=wp.float32), point: TouchPoint, s: Segment, w: wp.float32
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        total = accumulate_touch(scene, target, point, w * s.boundary_normal)
        start = VertexAdjoint()
        start.x = -w * s.boundary_normal
        started = accumulate_vertex(scene, target, s.face1, s.u1, s.v1, start, False, s.x, s.w)
        return total + started.dot

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def foreground_grid(
        # Scene:
        scene: Scene,
        camera: Camera,
        found: GridItems,
        moving: wp.array(dtype=wp.int32),
        # In:
        job: SampleJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        number = job.first + wp.tid()
        sampler = sampler_at(number, 0, job.seed)
        u4 = sample_4d(sampler, SLOT_DIRECTION)
        u = (wp.float64(number) + wp.float64(sample_1d(sampler, SLOT_SILHOUETTE))) / wp.float64(job.samples)
        count = found.items.shape[0]
        n, along = choose_item(found, count, u)
        item = found.items[n]
        tri = scene.triangles[item[0]]
        g = record_of(scene, tri)
        parts = item_parts(g, item[1])
        point = TouchPoint()
        if wp.static(cubic):
            choice = sample_1d(sampler, wp.static(SLOT_ROOT))
            point = smooth_surface_point(scene, tri, g, parts, along, u4[2], choice)
        elif parts[3] != VOXEL_ITEM:
            point = crease_point(scene, tri, g, parts, along)
        else:
            if wp.static(not shading):
                point = surface_point(scene, tri, g, parts, along, u4[2])
        if point.valid == 0:
            return
        point.face = item[0]
        # ---- The direction ----
        s = Segment()
        s.face2 = -1
        s.light = -1
        s.tau = 1.0
        s.step = step_off_primitive(scene, tri)
        curvature = wp.float32(0.0)
        out = point.out
        density = wp.float32(0.0)
        if wp.static(shading):
            wedge = crease_wedge(point)
            wedge.start += wedge.width
            wedge.width = PI - wedge.width
            s.w = wedge_direction(wedge, wp.vec2(u4[0], u4[1]))
            # From the front: against where phi grows.
            normal = wp.cross(point.along, point.up)
            if wp.dot(normal, s.w) * wp.dot(normal, from_voxels(tri, g, point.gradient)) > 0.0:
                s.w = -s.w
            if not shows_both_sheets(point, s.w):
                return
            density = 2.0 * point.density * pdf_wedge(wedge)
            s.boundary_normal = wp.cross(point.along, s.w)
            out = wp.normalize(s.boundary_normal)
            s.x = point.x - (FRONT * s.step) * s.w
        else:
            s.w = own_direction(point, wp.vec2(u4[0], u4[1]))
            if point.crease == 1:
                side = crease_side(point, s.w)
                if side == 0.0:
                    return
                s.boundary_normal = side * wp.cross(point.along, s.w)
                out = -wp.normalize(s.boundary_normal)
            else:
                curvature = curvature_of(tri, g, point, s.w)
                if curvature <= 0.0:
                    return
                s.boundary_normal = -out
            density = own_density(tri, g, point, curvature)
            s.x = point.x + s.step * out
        # ---- Towards the sensor ----
        if not density > 0.0:
            return
        s = sensor_end(scene, moving, s, moves(scene, moving, point.face))
        if s.valid == 0:
            return
        if wp.static(not shading):
            if point.crease == 0 and is_beside_curve(scene, s, point.face, curvature):
                return
        # ---- Towards the source ----
        below, met = start_beside(scene, point, out, -1.0, s, curvature)
        s.source = below
        if wp.static(shading):
            above, also = start_beside(scene, point, out, 1.0, s, curvature)
            s.x = above
            met = met and also
        if not met:
            return
        s.scale = wp.float32(count) / (density * wp.float32(job.samples))
        if wp.static(not shading):
            s.scale = -s.scale
        if wp.static(cubic):
            s.scale *= point.roots
        uv = pack(point.q)
        note_place(scene, NOTE_POINT, point.face, uv[0], uv[1], point.x, s.w, s.radiance)
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = accumulate(scene, target, point, s, 1.0)
        weight = transport(scene, camera, sampler, s, s.scale, rest, job, target, image_out)
        if wp.static(role != "forward"):
            if weight != 0.0:
                dropped = accumulate(scene, target, point, s, weight)
                if wp.static(role == "samples"):
                    tangent = outline_at(tri, g, point, s.w)
                    dropped += record_pull(target, number, point.x, tangent, weight * s.boundary_normal)
                if dropped != 0.0:
                    count_invalid(scene, sampler)

    return foreground_grid
