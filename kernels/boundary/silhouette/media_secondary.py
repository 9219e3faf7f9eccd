"""Secondary boundary of exact shapes in media: segments that touch a shape, between path vertices and volume vertices.

The touching point, its direction and their density are those of ``secondary.py``. Both ends are those of
``path_space/media_secondary.py``: x_1 is drawn along the ray from the shape and is a surface point or a volume vertex,
L_full is the radiance at x_1 of the whole ray past the shape, and a walk carries importance to the camera.

Derivation: ``docs/theory/media.md#shapes-without-triangles``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.guiding.techniques import Guide
from warp_psdr.kernels.boundary.path_space.edge_segment import moves
from warp_psdr.kernels.boundary.path_space.media_secondary import make_media_source
from warp_psdr.kernels.boundary.path_space.media_transport import make_media_transport
from warp_psdr.kernels.boundary.path_space.media_walk import MediaWalk, make_leaves_first, make_media_walk
from warp_psdr.kernels.boundary.path_space.secondary import make_source_sink
from warp_psdr.kernels.boundary.silhouette.aim import TangentAim
from warp_psdr.kernels.boundary.silhouette.drawn_touch import make_drawn_touch
from warp_psdr.kernels.boundary.silhouette.ends import is_beside_curve, make_source_end, with_density
from warp_psdr.kernels.boundary.silhouette.table import touch_of
from warp_psdr.kernels.boundary.silhouette.touch import DrawnItem
from warp_psdr.kernels.boundary.transport import Segment
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.medium.line import make_line
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.primitive.affine import step_off_primitive
from warp_psdr.kernels.rng import Sampler, sampler_at
from warp_psdr.kernels.sensor.camera import make_eye
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig


@functools.cache
def make_media_touching_segment(config: PathConfig, family: str, traces: bool):
    """Return ``segment(scene, sampler, moving, found, drawn, point, aim, eye, medium) -> (Segment, MediaWalk)``.

    ``traces``: more than what the segment's end emits may come along it. ``medium``: that of the camera. The scale is
    one over the density of what was drawn, as of ``make_touching_segment``.
    """
    touch = touch_of(family, config.surfaces.primitives, config.sampler)
    items, point_type, passing_at = touch.items, touch.point, touch.passing
    own_density, aimed_density = touch.own_density, touch.aimed_density
    source_end = make_source_end(config)
    first_vertex, _sight, _extend = make_media_walk(config)
    leaves_first = make_leaves_first(config.surfaces.primitives)
    _line, medium_at = make_line(config)

    @wp.func
    def media_touching_segment(
        scene: Scene,
        sampler: Sampler,
        moving: wp.array(dtype=wp.int32),
        found: items,
        drawn: DrawnItem,
        point: point_type,
        aim: TangentAim,
        eye: wp.vec3,
        medium: wp.int32,
    ) -> tuple[Segment, MediaWalk]:
        r = Segment()
        first = MediaWalk()
        r.w = aim.w
        passing = passing_at(scene, point, r.w, step_off_primitive(scene, scene.triangles[drawn.face]), FAR)
        if passing.shows == 0 or passing.crease == 1:
            return r, first
        r.boundary_normal = passing.normal
        r.step = passing.beside
        r.x = point.x + r.step * passing.out
        r.source = r.x
        here = medium_at(scene, eye, r.x, medium)
        end = source_end(scene, sampler, here, moving, r, point.face, point.x, aim, drawn.aims, wp.static(not traces))
        if end.valid == 0:
            return r, first
        density = wp.float32(0.0)
        if not end.delta:
            density = own_density(scene, found, point, drawn, r.w, passing.curvature)
        if end.towards > 0.0:
            density += aimed_density(scene, found, point, drawn, r.w, end)
        if not density > 0.0:
            return r, first
        # ---- Towards the sensor ----
        first = first_vertex(scene, sampler, r.x, -r.w, eye, here)
        if first.alive == 0:
            return r, first
        r = end.segment
        r.t1 = wp.dot(r.x - first.x, r.w)
        if r.t1 <= r.step:
            return r, first
        if not first.collides:
            if end.any_moves + moves(scene, moving, first.face) == 0:
                return r, first
            r.face1 = first.face
            if passing.curvature > 0.0 and is_beside_curve(scene, r, point.face, passing.curvature):
                return r, first
        r.radiance = wp.cw_mul(end.passed, r.radiance)
        r.source = r.x - (r.t1 - leaves_first(scene, first, r.w, r.t1)) * r.w
        r.valid = 1
        return with_density(r, end, aim, density), first

    return media_touching_segment


@functools.cache
def make_media_secondary_silhouette_kernel(
    config: PathConfig,
    role: str,
    camera_moves: bool,
    light_pose: bool,
    family: str,
    deep: bool,
    grids_move: bool = False,
    guided: bool = False,
):
    """Return the kernel: one thread a sample (arguments as in ``path_space/media_secondary.py``).

    ``family``: a touch's.
    """
    touch = touch_of(family, config.surfaces.primitives, config.sampler)
    items, point_type, weigh = touch.items, touch.point, touch.weigh
    evaluates = role == "target"
    emissive = config.media is not None and config.media.emissive
    traces = deep or emissive
    drawn_touch = make_drawn_touch(config, family, guided, evaluates)
    segment_at = make_media_touching_segment(config, family, traces)
    accumulate_point = None if evaluates else touch.make_sink(role)
    accumulate_source = None if evaluates else make_source_sink(role, light_pose, config.surfaces.primitives)
    _first, transport = make_media_transport(
        config,
        role,
        camera_moves,
        grids_move,
        make_media_source(config) if traces else None,
        deep=deep,
        ends=0 if emissive else 3,
    )
    eye_of = make_eye(config.camera)

    @wp.func
    def accumulate(
        scene: Scene, target: wp.array(dtype=wp.float32), point: point_type, s: Segment, w: wp.float32
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        total = accumulate_point(scene, target, point, w * s.boundary_normal)
        return accumulate_source(scene, target, s, w, total)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def media_secondary_silhouette(
        # Scene:
        scene: Scene,
        camera: Camera,
        found: items,
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
        drawn, point, aim = drawn_touch(scene, found, guide, sampler, number, job.samples)
        if point.valid == 0:
            return
        eye = eye_of(scene, camera, point.x)
        s, first = segment_at(scene, sampler, moving, found, drawn, point, aim, eye, camera.medium)
        if s.valid == 0:
            return
        scale = s.scale
        if wp.static(evaluates):
            scale = weigh(point, drawn, scale, 1.0, wp.length(s.boundary_normal))
        else:
            scale = weigh(point, drawn, scale, wp.float32(job.samples), 1.0)
        sent = wp.cw_mul(first.transmittance, s.radiance)
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = accumulate(scene, target, point, s, 1.0)
        total, dropped = transport(
            scene, camera, sampler, s, first, first.medium, eye, scale, sent, rest, job, target, image_out
        )
        if wp.static(evaluates):
            target[number] = total
        elif wp.static(role == "reverse"):
            if total != 0.0:
                dropped += accumulate(scene, target, point, s, total)
                if dropped != 0.0:
                    count_invalid(scene, sampler)

    return media_secondary_silhouette
