"""Secondary boundary of grids of signed distances [ZCM*24]: segments between two path vertices that touch one.

At a crease the measure is that of edges, sin(phi) dl dsigma; inside of a voxel it is kappa_n dA dtheta. The balance
heuristic joins two techniques: an item with a direction in which it is a silhouette, and a point of a light with an
item that may show it a silhouette. Point, spot and directional lights give the direction. A grid has no material points
(form S, ``docs/theory/implicit.md#form-s``), so light that it sends past its own silhouette counts as well
(``grid_foreground.py``).

Derivation: ``docs/theory/implicit.md#silhouettes-of-grids``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.depth import make_indirect
from warp_psdr.kernels.boundary.guiding.cube import make_cube, make_ends
from warp_psdr.kernels.boundary.guiding.slots import choose_slot
from warp_psdr.kernels.boundary.guiding.techniques import Guide
from warp_psdr.kernels.boundary.path_space.secondary import make_source_sink
from warp_psdr.kernels.boundary.silhouette.aim import (
    SLOT_DIRECTION,
    SLOT_SILHOUETTE,
    TangentAim,
    make_light_aim,
    make_square_aim,
)
from warp_psdr.kernels.boundary.silhouette.delivery import make_delivery
from warp_psdr.kernels.boundary.silhouette.ends import is_beside_curve, make_sensor_end, make_source_end, with_density
from warp_psdr.kernels.boundary.silhouette.grid_points import (
    VOXEL_ITEM,
    GridItems,
    TouchPoint,
    choose_item,
    crease_point,
    crease_side,
    curve_density,
    curve_direction,
    curve_point,
    eye_in_voxels,
    from_voxels,
    item_parts,
    make_touch_sink,
    surface_point,
    touch_curvature,
)
from warp_psdr.kernels.boundary.silhouette.grid_sampling import own_density, own_direction
from warp_psdr.kernels.boundary.silhouette.network_points import network_curve_point, network_surface_point
from warp_psdr.kernels.boundary.silhouette.spline_points import (
    SLOT_ROOT,
    spline_curvature,
    spline_curve_density,
    spline_curve_point,
    spline_direction,
    spline_surface_point,
)
from warp_psdr.kernels.boundary.transport import Segment, make_source, make_transport
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.notes import NOTE_POINT, make_note
from warp_psdr.kernels.primitive.affine import step_off_primitive
from warp_psdr.kernels.primitive.network import network_of
from warp_psdr.kernels.primitive.sdfgrid import Grid, grid_of, pack
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.structs import Camera, Scene, Triangle
from warp_psdr.kernels.vertex import PathConfig


@functools.cache
def make_outline(cubic: bool):
    """Return ``outline_at(tri, g, point, w) -> vec3``: tangent of a crease, or of the silhouette rays along w see."""
    direction_of = spline_direction if cubic else curve_direction

    @wp.func
    def outline_at(tri: Triangle, g: Grid, point: TouchPoint, w: wp.vec3) -> wp.vec3:
        if point.crease == 1:
            return point.along
        return from_voxels(tri, g, direction_of(point, eye_in_voxels(tri, g, w, True), True))

    return outline_at


@functools.cache
def make_touching_segment(config: PathConfig, cubic: bool = False):
    """Return ``segment(scene, moving, found, tri, g, n, point, aim, direct) -> Segment``; n is the item's place.

    ``cubic``: of smooth grids. ``aim.light`` is -1 where its direction is drawn by itself, ``direct`` as in
    ``path_space/secondary.py``. The scale is one over the density of what was drawn, in the measures above.
    """
    source_end = make_source_end(config)
    sensor_end = make_sensor_end(config)
    curvature_of = spline_curvature if cubic else touch_curvature
    direction_of = spline_direction if cubic else curve_direction
    density_of = spline_curve_density if cubic else curve_density

    @wp.func
    def towards_density(
        tri: Triangle, g: Grid, point: TouchPoint, y: wp.vec3, distant: wp.bool, w: wp.vec3
    ) -> wp.float32:
        """Density of a point of an item that a light's point y sees, but for that of y."""
        if point.crease == 1:
            return point.density
        t = direction_of(point, eye_in_voxels(tri, g, y, distant), distant)
        return density_of(t) / wp.length(wp.cross(from_voxels(tri, g, t), w))

    @wp.func
    def touching_segment(
        scene: Scene,
        moving: wp.array(dtype=wp.int32),
        found: GridItems,
        tri: Triangle,
        g: Grid,
        n: wp.int32,
        touched: TouchPoint,
        aim: TangentAim,
        direct: wp.bool,
    ) -> Segment:
        r = Segment()
        r.w = aim.w
        point = touched
        r.step = step_off_primitive(scene, tri)
        curvature = wp.float32(0.0)
        r.boundary_normal = -point.out
        if point.crease == 1:
            side = crease_side(point, r.w)
            if side == 0.0:
                return r
            r.boundary_normal = side * wp.cross(point.along, r.w)
            point.out = -wp.normalize(r.boundary_normal)
        else:
            curvature = curvature_of(tri, g, point, r.w)
            if curvature <= 0.0:
                return r
        r.x = point.x + r.step * point.out
        r.source = r.x
        end = source_end(scene, moving, r, point.face, point.x, aim, n < found.aimed, direct)
        if end.valid == 0:
            return r
        shown = wp.float32(found.aimed)
        density = wp.float32(0.0)
        if end.delta:
            density = (1.0 - found.share) * towards_density(tri, g, point, aim.eye, aim.distant, r.w)
            density /= shown
        else:
            density = found.share * own_density(tri, g, point, curvature) / wp.float32(found.items.shape[0])
            if end.towards > 0.0:
                distant = end.segment.face2 < 0
                towards = end.towards * (towards_density(tri, g, point, end.y, distant, r.w) / shown)
                density += (1.0 - found.share) * towards
        if density <= 0.0:
            return r
        r = with_density(sensor_end(scene, moving, end.segment, end.any_moves), end, aim, density)
        if r.valid == 1 and point.crease == 0:
            if is_beside_curve(scene, r, point.face, curvature):
                r.valid = 0
        return r

    return touching_segment


@functools.cache
def make_secondary_grid_kernel(
    config: PathConfig,
    role: str,
    camera_moves: bool,
    light_pose: bool,
    guided: bool = False,
    indirect: bool = False,
    cubic: bool = False,
    network: bool = False,
):
    """Return the kernel: one thread a sample (arguments as in ``silhouette/secondary.py``); ``cubic``: smooth grids.

    ``network`` beside ``cubic``: networks, whose cells are the voxels of smooth grids.
    """
    evaluates = role in ("target", "ends")
    in_cube = guided or evaluates
    lit = bool(config.area or config.lights)
    light_aim = make_light_aim(config) if lit and not in_cube else None
    square_aim = make_square_aim(config) if lit and in_cube else None
    cube = make_cube(evaluates) if in_cube else None
    write_ends = make_ends(config.primitives) if role == "ends" else None
    segment_at = make_touching_segment(config, cubic)
    outline_at = make_outline(cubic) if role == "samples" else None
    accumulate_touch = None if evaluates else make_touch_sink(role, cubic, network)
    record_of = network_of if network else grid_of
    smooth_curve_point = network_curve_point if network else spline_curve_point
    smooth_surface_point = network_surface_point if network else spline_surface_point
    accumulate_source = None if evaluates else make_source_sink(role, light_pose, config.primitives)
    source = make_source(config, True)
    source = make_indirect(source) if indirect else source
    transport = make_transport(config, role, camera_moves, source) if role != "ends" else None
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_4d = draw.sample_4d
    note_place = make_note(config.noted)

    deliver = make_delivery(role, TouchPoint, transport, accumulate_touch, accumulate_source, write_ends)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def secondary_grid(
        # Scene:
        scene: Scene,
        camera: Camera,
        found: GridItems,
        moving: wp.array(dtype=wp.int32),
        guide: Guide,
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
        # Of creases the direction, of voxels a coordinate of the place and theta.
        uv = wp.vec2(u4[0], u4[1])
        across = u4[2]
        factor = wp.float32(1.0)
        if wp.static(in_cube):
            at = cube(guide, found.share, number, job.samples, u4)
            by_itself = at.own
            uv = wp.vec2(wp.float32(at.u[1]), wp.float32(at.u[2]))
            across = uv[0]
            n, along, size = choose_slot(found.slots, by_itself, at.u[0])
            factor = at.weight / (size * wp.float32(wp.where(by_itself, found.items.shape[0], found.aimed)))
        else:
            jitter = sample_1d(sampler, SLOT_SILHOUETTE)
            u = (wp.float64(number) + wp.float64(jitter)) / wp.float64(job.samples)
            by_itself = u < wp.float64(found.share)
            count = found.items.shape[0]
            if by_itself:
                u = u / wp.float64(found.share)
            else:
                u = (u - wp.float64(found.share)) / wp.float64(1.0 - found.share)
                count = found.aimed
            n, along = choose_item(found, count, u)
        item = found.items[n]
        tri = scene.triangles[item[0]]
        g = record_of(scene, tri)
        parts = item_parts(g, item[1])
        aim = TangentAim()
        aim.light = -1
        point = TouchPoint()
        choice = wp.float32(0.0)
        if wp.static(cubic):
            choice = sample_1d(sampler, wp.static(SLOT_ROOT))
            if by_itself:
                point = smooth_surface_point(scene, tri, g, parts, along, across, choice)
        elif parts[3] != VOXEL_ITEM:
            point = crease_point(scene, tri, g, parts, along)
        elif by_itself:
            point = surface_point(scene, tri, g, parts, along, across)
        if by_itself and point.valid == 1:
            aim.w = own_direction(point, uv)
        if wp.static(lit):
            if not by_itself:
                if wp.static(in_cube):
                    aim = square_aim(scene, tri.normal, at.u[1], at.u[2])
                else:
                    aim = light_aim(scene, tri.normal, u4)
                if aim.valid == 0:
                    return
                if wp.static(cubic):
                    seen = eye_in_voxels(tri, g, aim.eye, aim.distant)
                    point = smooth_curve_point(scene, tri, g, parts, seen, aim.distant, along, choice)
                elif parts[3] == VOXEL_ITEM:
                    eye = eye_in_voxels(tri, g, aim.eye, aim.distant)
                    point = curve_point(scene, tri, g, parts, eye, aim.distant, along)
                aim.w = aim.eye
                if not aim.distant:
                    aim.w = wp.normalize(aim.eye - point.x)
        if point.valid == 0:
            return
        point.face = item[0]
        s = segment_at(scene, moving, found, tri, g, n, point, aim, job.max_depth == 2)
        if s.valid == 0:
            return
        held = pack(point.q)
        note_place(scene, NOTE_POINT, point.face, held[0], held[1], point.x, s.w, s.radiance)
        if wp.static(evaluates):
            s.scale *= factor * wp.length(s.boundary_normal)
        else:
            s.scale /= wp.float32(job.samples)
        if wp.static(guided):
            s.scale *= factor
        if wp.static(cubic):
            s.scale *= point.roots
        tangent = point.along
        if wp.static(role == "samples"):
            tangent = outline_at(tri, g, point, s.w)
        deliver(scene, camera, sampler, number, job, point, tangent, s, target, image_out)

    return secondary_grid
