"""Secondary boundary in media: discontinuities between two path vertices [ZYZ21], in the local form.

As in ``secondary.py``, but x_1 is drawn along the ray from the edge point and is a surface point or a volume vertex.
The importance W_1 of a volume vertex has the additional measure dt_1, and a walk carries it to the camera
(``media_walk.py``). L_full is the radiance at x_1 of the whole ray past the occluder: the emission of x_2, and what a
path from x_1 finds on the way there and behind.

Derivation: ``docs/theory/media.md#boundaries-in-media``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.coincident import edge_share
from warp_psdr.kernels.boundary.detector import Incident
from warp_psdr.kernels.boundary.guiding.techniques import Guide, make_techniques, octant_point
from warp_psdr.kernels.boundary.local_form import EdgePoint, Edges, edge_behind
from warp_psdr.kernels.boundary.media_radiance import make_end_radiance, make_media_incident
from warp_psdr.kernels.boundary.path_space.direction import Direction, wedge_at
from warp_psdr.kernels.boundary.path_space.edge_segment import edge_segment, moves
from warp_psdr.kernels.boundary.path_space.media_transport import make_media_transport
from warp_psdr.kernels.boundary.path_space.media_walk import make_leaves_first
from warp_psdr.kernels.boundary.path_space.secondary import SLOT_DIRECTION, SLOT_EDGE, make_segment_sink
from warp_psdr.kernels.boundary.transport import Segment
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.invalid import count_invalid, vanishes
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.medium.coefficients import exp_minus
from warp_psdr.kernels.medium.line import AHEAD, ClearLine, make_line
from warp_psdr.kernels.medium.volume import GRID
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.phase.sggx import make_extinction_along
from warp_psdr.kernels.primitive.affine import is_primitive_at
from warp_psdr.kernels.rng import Sampler, make_sampler, sampler_at
from warp_psdr.kernels.sensor.camera import make_eye
from warp_psdr.kernels.step import leaving_step
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig


@functools.cache
def make_media_source(config: PathConfig):
    """Return ``source(scene, sampler, segment, medium, k, max_depth, rr_depth) -> Incident``, less what x_2 emits."""
    media_incident = make_media_incident(config)

    @wp.func
    def source(
        scene: Scene,
        sampler: Sampler,
        s: Segment,
        medium: wp.int32,
        k: wp.int32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> Incident:
        return media_incident(scene, sampler, medium, s.source, s.w, k, max_depth, rr_depth)

    return source


@functools.cache
def make_media_segment(config: PathConfig, deep: bool):
    """Return ``segment(scene, camera, edges, moving, sampler, point, direction, eye)``.

    ``deep``: light may come from more than what is at the segment's end.

    The results are a Segment but for its x_1, and the line from the edge towards the source, whose medium is that at
    the edge. ``t1`` of the Segment is how far beyond the edge the ray to x_1 starts, ``known`` is not 0 if what the
    segment joins moves.
    """
    line, medium_at = make_line(config)
    assert config.media is not None
    grids = config.media.grids
    extinction_along = make_extinction_along(config.media.phases)
    end_radiance = make_end_radiance(config.lights)

    @wp.func
    def is_round(scene: Scene, face: wp.int32) -> wp.bool:
        if wp.static(not config.lights.shining):
            return False
        return is_primitive_at(scene, face)

    @wp.func
    def segment(
        scene: Scene,
        camera: Camera,
        edges: Edges,
        moving: wp.array(dtype=wp.int32),
        sampler: Sampler,
        point: EdgePoint,
        direction: Direction,
        eye: wp.vec3,
    ) -> tuple[Segment, ClearLine]:
        ahead = ClearLine()
        along = wp.normalize(point.p1 - point.p0)
        r, side, moved = edge_segment(scene, edges, moving, point, along, direction.w)
        if side == 0.0:
            return r, ahead
        r.known = moved
        behind = edge_behind(scene, r.step)
        r.source = r.x - behind * r.w
        r.t1 = behind
        medium = medium_at(scene, eye, r.x, camera.medium)
        # Towards the source, as in ``secondary.py``.
        reach = wp.float32(FAR)
        if direction.light >= 0:
            reach = wp.min(direction.distance + behind, FAR)
        elif direction.aimed == 1 and direction.distance < 0.5 * FAR and not is_round(scene, direction.face):
            plane = scene.triangles[direction.face].normal
            shift = wp.dot(plane, point.x - r.x) / wp.dot(plane, r.w)
            margin = (r.step + leaving_step(scene, direction.face)) / wp.abs(wp.dot(plane, r.w))
            reach = wp.max(direction.distance + shift - margin, 0.0) + behind
        ahead = line(scene, sampler, AHEAD, r.source, r.w, reach, medium, 1)
        if ahead.lost:
            return r, ahead
        if direction.light >= 0 or direction.aimed == 1:
            if ahead.face >= 0:
                return r, ahead
            r.light = direction.light
            r.face2 = direction.face
            r.u2 = direction.u
            r.v2 = direction.v
            r.t2 = direction.distance
            if direction.light >= 0:
                r.face2 = -1
                r.radiance = direction.irradiance
        else:
            r.face2 = ahead.face
            r.u2 = ahead.u
            r.v2 = ahead.v
            r.t2 = wp.max(ahead.t - behind, 0.0)
            if ahead.face >= 0 and ahead.t <= behind + r.step:
                r.t1 = -behind
        if r.light < 0:
            if r.face2 >= 0:
                r.known += moves(scene, moving, r.face2)
            r.radiance = end_radiance(scene, r.face2, r.u2, r.v2, r.w)
        ahead.medium = medium  # that at the edge
        in_grid = wp.bool(False)
        if wp.static(grids):
            if medium >= 0:
                in_grid = scene.media.records[medium].sigma_t_channels == GRID
        if medium >= 0 and not in_grid:
            # From r.source to where the ray to x_1 starts both have the transmittance, 1 in grids but for rounding.
            twice = exp_minus(extinction_along(scene, scene.media.records[medium], r.w).sigma_t, -(r.t1 + behind))
            ahead.transmittance = wp.cw_mul(ahead.transmittance, twice)
        r.radiance = wp.cw_mul(ahead.transmittance, r.radiance)
        r.scale = edge_share(scene, edges, point, along, r.w, side)
        if (wp.static(deep) and r.light < 0) or not vanishes(r.radiance):
            r.valid = 1
        return r, ahead

    return segment


@functools.cache
def make_media_secondary_kernel(
    config: PathConfig,
    role: str,
    camera_moves: bool,
    light_pose: bool,
    deep: bool,
    grids_move: bool = False,
    guided: bool = False,
):
    """Return the kernel: one thread a sample (arguments as in ``secondary.py``, "reverse", "forward" or "target").

    ``deep``: paths may have more than two vertices behind the camera. ``grids_move``: grids of media have derivatives.
    """
    evaluates = role == "target"
    # A medium that shines does so in front of the first surface, too.
    emissive = config.media is not None and config.media.emissive
    traces = deep or emissive
    segment_at = make_media_segment(config, traces)
    first_vertex, transport = make_media_transport(
        config,
        role,
        camera_moves,
        grids_move,
        make_media_source(config) if traces else None,
        deep=deep,
        ends=0 if emissive else 3,
    )
    accumulate_segment = None if evaluates else make_segment_sink(role, light_pose, config.surfaces.primitives)
    eye_of = make_eye(config.camera)
    leaves_first = make_leaves_first(config.surfaces.primitives)
    sample_aim, density, place = make_techniques(config.lights, guided)
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_4d = draw.sample_4d

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def media_secondary(
        # Scene:
        scene: Scene,
        camera: Camera,
        edges: Edges,
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
        if wp.static(evaluates):
            if guide.points.shape[0] > 0:
                aim = place(scene, edges, guide.points[number], guide.technique)
            else:
                box = number // job.samples
                at = octant_point(guide.low[box], guide.high[box], (number - box * job.samples) % 8, u4)
                aim = place(scene, edges, at, guide.technique)
        else:
            jitter = u4[0]
            if wp.static(not guided):
                jitter = sample_1d(sampler, SLOT_EDGE)
            u = (wp.float64(number) + wp.float64(jitter)) / wp.float64(job.samples)
            aim = sample_aim(scene, edges, guide, u, u4)
        point = aim.point
        point.sample = number
        if aim.direction.valid == 0:
            return
        eye = eye_of(scene, camera, point.x)
        s, ahead = segment_at(scene, camera, edges, moving, sampler, point, aim.direction, eye)
        if s.valid == 0:
            return
        pdf = density(scene, edges, guide, wedge_at(scene, edges, point), aim, s.face2, s.u2, s.v2, s.t2)
        first = first_vertex(scene, sampler, s.x + s.t1 * s.w, -s.w, eye, ahead.medium)
        if first.alive == 0:
            return
        s.t1 = wp.dot(s.x - first.x, s.w)
        if s.t1 <= s.step:
            return
        s.known += 1
        if not first.collides:
            s.known += moves(scene, moving, first.face) - 1
        if s.known == 0:
            return
        distance = s.t2
        if s.face2 >= 0 or (s.light >= 0 and distance < 0.5 * FAR):
            s.tau = s.t1 / (s.t1 + distance)
        sent = wp.cw_mul(first.transmittance, s.radiance)
        if wp.static(evaluates):
            scale = s.scale * wp.length(s.boundary_normal) * wp.length(point.p1 - point.p0) / (point.pdf * pdf)
        else:
            scale = s.scale * wp.length(point.p1 - point.p0) / (point.pdf * pdf * wp.float32(job.samples))
        s.source = s.x - (s.t1 - leaves_first(scene, first, s.w, s.t1)) * s.w
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = accumulate_segment(scene, target, edges, point, s, 1.0)
        total, dropped = transport(
            scene, camera, sampler, s, first, first.medium, eye, scale, sent, rest, job, target, image_out
        )
        if wp.static(evaluates):
            target[number] = total
        elif wp.static(role == "reverse"):
            if total != 0.0:
                dropped += accumulate_segment(scene, target, edges, point, s, total)
                if dropped != 0.0:
                    count_invalid(scene, sampler)

    return media_secondary
