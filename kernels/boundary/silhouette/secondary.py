"""Secondary boundary at smooth silhouettes and rims: segments between two path vertices that touch a shape.

The local form (``local_form.py``) at a point x_b of a smooth surface has the measure kappa_n dA dtheta in place of
sin(phi) dl dsigma, with the tangent direction theta and the normal curvature kappa_n along the segment. The balance
heuristic joins two techniques: uniform in area and theta, and a point of a light with the silhouette that it sees, for
which kappa_n dA dtheta = |dx/du x w| du dsigma. Point, spot and directional lights give the direction. At rims the
measure is |dx/du x w| du dsigma; the direction w is uniform or leads to a light. A rim of two surfaces is a silhouette
where both lie on one side.

Derivation: ``docs/theory/implicit.md#secondary-silhouettes``, ``#rims``, ``#rims-that-join``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.depth import make_indirect
from warp_psdr.kernels.boundary.guiding.cube import make_cube, make_ends
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
from warp_psdr.kernels.boundary.silhouette.dispatch import (
    choose_outline,
    make_coordinates,
    make_silhouette_sink,
    make_silhouettes,
)
from warp_psdr.kernels.boundary.silhouette.edge_on import EDGEWISE, is_beside
from warp_psdr.kernels.boundary.silhouette.ends import is_beside_curve, make_sensor_end, make_source_end, with_density
from warp_psdr.kernels.boundary.silhouette.exact_touch import OutlineItems
from warp_psdr.kernels.boundary.silhouette.point import SilhouettePoint
from warp_psdr.kernels.boundary.silhouette.rim import is_open_end, make_neighbour, make_rims
from warp_psdr.kernels.boundary.transport import Segment, make_source, make_transport
from warp_psdr.kernels.constants import INV_FOUR_PI, INV_TWO_PI, TWO_PI
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.math import any_tangent
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.notes import NOTE_POINT, make_note
from warp_psdr.kernels.primitive.affine import step_off_primitive
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.sampling import square_to_sphere
from warp_psdr.kernels.structs import Camera, Scene, Triangle
from warp_psdr.kernels.vertex import PathConfig


@functools.cache
def make_silhouette_segment(config: PathConfig):
    """Return ``segment(scene, moving, tri, point, rim, aim, share, direct) -> Segment``.

    ``aim.light`` is -1 where its direction is drawn uniformly, as of the fraction ``share`` of the segments; ``direct``
    as in ``path_space/secondary.py``. Its scale is one over the density of what was drawn, in the measure above.
    """
    silhouettes = make_silhouettes(config.primitives)
    rims = make_rims(config.primitives)
    source_end = make_source_end(config)
    sensor_end = make_sensor_end(config)

    @wp.func
    def around(tri: Triangle, rim: wp.bool, eye: wp.vec3, distant: wp.bool, q: wp.vec3, w: wp.vec3) -> wp.float32:
        """|dx/du x w| of the silhouette from an eye, or of a rim."""
        rate = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(rims is not None):
            if rim:
                rate = rims.rate(tri, q)
        if wp.static(silhouettes is not None):
            if not rim:
                rate = silhouettes.rate(tri, eye, distant, q)
        return wp.length(wp.cross(rate, w))

    @wp.func
    def uniform_density(share: wp.float32, tri: Triangle, rim: wp.bool, q: wp.vec3, w: wp.vec3) -> wp.float32:
        """Density of what is uniform, in area and theta, or in u and the direction, times the share of it."""
        if wp.static(rims is not None):
            if rim:
                return share * INV_FOUR_PI / wp.length(wp.cross(rims.rate(tri, q), w))
        if wp.static(silhouettes is not None):
            return share * INV_TWO_PI * silhouettes.density(tri, q) / silhouettes.curvature(tri, q, w)
        return 0.0

    @wp.func
    def segment(
        scene: Scene,
        moving: wp.array(dtype=wp.int32),
        tri: Triangle,
        point: SilhouettePoint,
        rim: wp.bool,
        aim: TangentAim,
        share: wp.float32,
        direct: wp.bool,
    ) -> Segment:
        r = Segment()
        r.w = aim.w
        r.boundary_normal = -point.out
        r.step = step_off_primitive(scene, tri)
        r.x = point.x + r.step * point.out
        r.source = r.x
        end = source_end(scene, moving, r, point.face, point.x, aim, share < 1.0, direct)
        if end.valid == 0:
            return r
        density = wp.float32(0.0)
        if end.delta:
            density = (1.0 - share) / around(tri, rim, aim.eye, aim.distant, point.q, r.w)
        else:
            density = uniform_density(share, tri, rim, point.q, r.w)
            if end.towards > 0.0:
                density += (1.0 - share) * end.towards / around(tri, rim, end.y, end.segment.face2 < 0, point.q, r.w)
        if density <= 0.0:
            return r
        r = with_density(sensor_end(scene, moving, end.segment, end.any_moves), end, aim, density)
        if wp.static(silhouettes is not None):
            if r.valid == 1 and not rim:
                if is_beside_curve(scene, r, point.face, silhouettes.curvature(tri, point.q, r.w)):
                    r.valid = 0
        return r

    return segment


@functools.cache
def make_secondary_silhouette_kernel(
    config: PathConfig,
    role: str,
    camera_moves: bool,
    light_pose: bool,
    guided: bool = False,
    indirect: bool = False,
):
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``).

    There is a role more, "ends": ``target`` receives what the ends of segments are (``guiding/cube.py``).
    """
    evaluates = role in ("target", "ends")
    in_cube = guided or evaluates
    silhouettes = make_silhouettes(config.primitives)
    rims = make_rims(config.primitives)
    neighbour = make_neighbour(config.primitives)
    coordinates = make_coordinates(config.primitives)
    lit = bool(config.area or config.lights)
    light_aim = make_light_aim(config) if lit and not in_cube else None
    square_aim = make_square_aim(config) if lit and in_cube else None
    cube = make_cube(evaluates) if in_cube else None
    write_ends = make_ends(config.primitives) if role == "ends" else None
    segment_at = make_silhouette_segment(config)
    accumulate_silhouette = None if evaluates else make_silhouette_sink(role)
    accumulate_source = None if evaluates else make_source_sink(role, light_pose, config.primitives)
    source = make_source(config, True)
    source = make_indirect(source) if indirect else source
    transport = make_transport(config, role, camera_moves, source) if role != "ends" else None
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_4d = draw.sample_4d
    note_place = make_note(config.noted)

    deliver = make_delivery(role, SilhouettePoint, transport, accumulate_silhouette, accumulate_source, write_ends)

    @wp.func
    def outline_at(tri: Triangle, rim: wp.bool, q: wp.vec3, w: wp.vec3) -> wp.vec3:
        """Tangent of a rim, or of the silhouette that rays along w see."""
        if wp.static(rims is not None):
            if rim:
                return rims.rate(tri, q)
        if wp.static(silhouettes is not None):
            return silhouettes.rate(tri, w, True, q)
        return w

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def secondary_silhouette(
        # Scene:
        scene: Scene,
        camera: Camera,
        found: OutlineItems,
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
        uv = wp.vec2(u4[0], u4[1])
        if wp.static(in_cube):
            at = cube(guide, found.share, number, job.samples, u4)
            u = at.u[0]
            uniform = at.own
            uv = wp.vec2(wp.float32(at.u[1]), wp.float32(at.u[2]))
        else:
            jitter = sample_1d(sampler, SLOT_SILHOUETTE)
            u = (wp.float64(number) + wp.float64(jitter)) / wp.float64(job.samples)
            uniform = u < wp.float64(found.share)
            if uniform:
                u = u / wp.float64(found.share)
            else:
                u = (u - wp.float64(found.share)) / wp.float64(1.0 - found.share)
        n, along = choose_outline(found.items, u)
        item = found.items[n]
        rim = item.number < 0
        face = wp.where(rim, -1 - item.number, item.number)
        tri = scene.triangles[face]
        aim = TangentAim()
        aim.light = -1
        point = SilhouettePoint()
        if uniform:
            if wp.static(rims is not None):
                if rim:
                    aim.w = square_to_sphere(uv)
                    point = rims.seen(tri, face, along, aim.w, True)
            if wp.static(silhouettes is not None):
                if not rim:
                    point = silhouettes.place(tri, face, wp.vec2(along, uv[0]))
                    s_axis = any_tangent(point.out)
                    t_axis = wp.cross(point.out, s_axis)
                    theta = TWO_PI * uv[1]
                    aim.w = wp.cos(theta) * s_axis + wp.sin(theta) * t_axis
        else:
            if wp.static(lit):
                if wp.static(in_cube):
                    aim = square_aim(scene, tri.normal, at.u[1], at.u[2])
                else:
                    aim = light_aim(scene, tri.normal, u4)
                if aim.valid == 0:
                    return
                if wp.static(rims is not None):
                    if rim:
                        point = rims.seen(tri, face, along, aim.eye, aim.distant)
                if wp.static(silhouettes is not None):
                    if not rim:
                        point = silhouettes.seen(tri, face, aim.eye, aim.distant, along)
                aim.w = aim.eye
                if not aim.distant:
                    aim.w = wp.normalize(aim.eye - point.x)
        if point.valid == 0:
            return
        if wp.static(rims is not None):
            if rim and not is_open_end(item, point.q):
                return
        if wp.static(neighbour is not None):
            if rim and item.neighbours[0] >= 0:
                if not is_beside(neighbour.into(scene, item, point.x), -point.out, aim.w, EDGEWISE):
                    return
        s = segment_at(scene, moving, tri, point, rim, aim, found.share, job.max_depth == 2)
        if s.valid == 0:
            return
        held = coordinates(tri, point.q)
        note_place(scene, NOTE_POINT, face, held[0], held[1], point.x, s.w, s.radiance)
        if wp.static(evaluates):
            s.scale *= wp.float32(found.items.shape[0])
        else:
            s.scale *= wp.float32(found.items.shape[0]) / wp.float32(job.samples)
        if wp.static(in_cube):
            s.scale *= at.weight
        tangent = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(role == "samples"):
            tangent = outline_at(tri, rim, point.q, s.w)
        deliver(scene, camera, sampler, number, job, point, tangent, s, target, image_out)

    return secondary_silhouette
