"""Transport of a boundary segment x_1 -> x_2 to the sensor: the walk from x_1, its connections, and the adjoints.

The estimators of discontinuities between two path vertices share this file (as ``path_space/secondary.py``,
``silhouette/secondary.py`` and ``shading_normals/indirect_terminator.py``). They differ in how they find a segment and
in what moves the discontinuity. A segment contributes the sum over k of W_k L_k: W_k is the connection of the walk's
k-th vertex, and L_k the radiance past the occluder behind k vertices, whose number max_depth bounds. x_1 slides along a
pixel's ray for k = 1 and is a material point for k > 1. Walk and source are independent given the segment, so one path,
cut at different lengths, gives all L_k (``detector.Incident``). If x_2 lies on a light, L_k = E_2 + R_k: E_2 is known
without a ray, and the scattered part R_k is estimated by R_k / p with probability p.
"""

import functools
from collections.abc import Callable

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.coincident import pass_together
from warp_psdr.kernels.boundary.detector import (
    ROW_COUNT,
    Incident,
    Walk,
    constant,
    make_incident,
    make_walk,
    radiance_behind,
    scaled,
    serves_length,
)
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.invalid import count_invalid, vanishes
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.notes import NOTE_SENSOR, NOTE_SOURCE, NOTE_WALK, make_note
from warp_psdr.kernels.primitive.affine import is_primitive
from warp_psdr.kernels.primitive.dispatch import has_slides, make_adjoint_sink, make_point_at, slides_on
from warp_psdr.kernels.rng import Sampler, branch_of, make_sampler
from warp_psdr.kernels.sensor.camera import make_camera_sink, make_lens
from warp_psdr.kernels.sensor.projection import make_splat
from warp_psdr.kernels.step import leaving_step
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint, point_on
from warp_psdr.kernels.vertex import PathConfig

#: A path goes on from this fraction of a segment's length in front of the light that the segment met, at least.
BEFORE_LIGHT = 1.0e-3
#: Sample slots of the point of the lens that sees the walk, and of the walk, whose vertices count from one. Those in
#: front belong to the segment.
SLOT_LENS, SLOT_WALK = 3, 3
#: p: what lights scatter is little beside what they emit; where both are equal, the second moment doubles at most.
#: Its slot is the camera's in the numbers of the path towards the source.
BEHIND_LIGHT = 0.2
SLOT_BEHIND_LIGHT = 0


@wp.struct
class Segment:
    """A boundary segment and its two ends."""

    valid: wp.int32
    x: wp.vec3  # x_b, moved off the occluder
    step: wp.float32  # how far
    w: wp.vec3  # towards the source
    source: wp.vec3  # where the ray towards the source starts
    boundary_normal: wp.vec3  # sin(phi) n
    t1: wp.float32
    t2: wp.float32  # |x_2 - x_b|; not set for point-like lights
    tau: wp.float32
    scale: wp.float32  # share of the jump / (pdf_l pdf_sigma)
    face1: wp.int32
    u1: wp.float32
    v1: wp.float32
    face2: wp.int32  # -1: infinity or a point-like light
    u2: wp.float32
    v2: wp.float32
    light: wp.int32  # point-like light, else -1
    known: wp.int32  # 1: ``radiance`` is what x_2 sends, and all that counts
    radiance: wp.vec3


@wp.func
def before_light(scene: Scene, s: Segment) -> wp.vec3:
    """Where a path goes on towards the light x_2: just in front of it, for what its surface scatters.

    A ray from x_b, which is moved off the edge, misses a small light. But at a contact x_b is as near, and moved off
    the light, too. (An exact shape is where the ray met it.)
    """
    tri = scene.triangles[s.face2]
    before = wp.max(BEFORE_LIGHT * s.t2, leaving_step(scene, s.face2) / wp.abs(wp.dot(tri.normal, s.w)))
    o = s.source
    if before < s.t2 and not is_primitive(tri):
        o = point_on(tri, s.u2, s.v2) - before * s.w
    return o


@functools.cache
def make_source(config: PathConfig, emission: bool = False):
    """Return ``source(scene, sampler, segment, k, max_depth, rr_depth) -> Incident``: the radiance past the occluder.

    ``emission``: ``segment.radiance`` is what x_2 emits, and all that counts where the path must end there.
    """
    incident = make_incident(config)
    sample_1d = make_sampler(config.sampler).sample_1d

    @wp.func
    def source(
        scene: Scene, sampler: Sampler, s: Segment, k: wp.int32, max_depth: wp.int32, rr_depth: wp.int32
    ) -> Incident:
        if s.known == 1:
            return constant(s.radiance, k)
        if wp.static(emission):
            if s.face2 < 0 or (max_depth >= 0 and k + 1 >= max_depth):
                return constant(s.radiance, k)
            if wp.max(s.radiance) > 0.0 and k >= rr_depth:
                # L_2 = E_2 + (L_2 - E_2): the second part by roulette.
                if sample_1d(sampler, SLOT_BEHIND_LIGHT) >= BEHIND_LIGHT:
                    ended = constant(s.radiance, k)
                    if max_depth >= 0:
                        ended.cut = ROW_COUNT  # it serves as many lengths as one that goes on
                    return ended
                o = before_light(scene, s)
                r = incident(scene, sampler, o, s.w, FAR, k, max_depth, rr_depth)
                return scaled(r, s.radiance, wp.static(1.0 / BEHIND_LIGHT))
        return incident(scene, sampler, s.source, s.w, FAR, k, max_depth, rr_depth)

    return source


@functools.cache
def make_first_sink(role: str, primitives: tuple[int, ...] = ()):
    """Return ``accumulate_first(scene, target, segment, w, by_ray, o, d)`` for the adjoint of x_1.

    ``by_ray``: x_1 is where the ray (o, d) meets its triangle, whose adjoint is returned, as (o, d, dot).
    """
    accumulate_vertex = make_adjoint_sink(role, False, False, False, False, False, True, primitives)

    @wp.func
    def accumulate_first(
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
        accumulated = accumulate_vertex(scene, target, segment.face1, segment.u1, segment.v1, adjoint, by_ray, o, d)
        return accumulated.o, accumulated.d, accumulated.dot

    return accumulate_first


@functools.cache
def make_found_sink(role: str, primitives: tuple[int, ...], first: Callable = make_first_sink):
    """Return ``accumulate_found(scene, target, segment, w, second) -> float``: x_1 behind the walk's second vertex.

    On grids and curves it slides along the ray from there, which is tied to that vertex' surface (form S); else it is a
    material point.
    """
    accumulate_first = first(role, primitives)
    accumulate_vertex = make_adjoint_sink(role, False, False, False, False, False, True, primitives)
    has_sliding = has_slides(primitives)

    @wp.func
    def accumulate_found(
        scene: Scene, target: wp.array(dtype=wp.float32), segment: Segment, w: wp.float32, second: Walk
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        slides = wp.bool(False)
        if wp.static(has_sliding):
            slides = slides_on(scene.triangles[segment.face1])
        o, _d, dot = accumulate_first(scene, target, segment, w, slides, second.x, second.to)
        if wp.static(has_sliding):
            if slides:
                start = VertexAdjoint()
                start.x = o
                started = accumulate_vertex(
                    scene, target, second.face, second.u, second.v, start, False, second.x, second.to
                )
                dot += started.dot
        return dot

    return accumulate_found


@functools.cache
def make_transport(
    config: PathConfig,
    role: str,
    camera_moves: bool,
    source: wp.Function,
    least: int = 1,
    first: Callable = make_first_sink,
):
    """Return ``transport(scene, camera, sampler, segment, scale, rest, max_depth, ...) -> float``.

    It walks from x_1, and at each vertex that the camera sees adds to the image (forward) or collects the adjoint
    (reverse). ``rest`` is the velocity of all but x_1 for a unit weight, which forward mode reads; the result is the
    weight of those velocities, which reverse mode has to push. x_1 itself is done here: adjoint (tau - 1) sweep.

    Args:
        config: what the scene needs.
        role: "reverse", "forward", "samples" or "target" (``path_space/secondary.py``); the last adds up what counts,
            unweighted, and neither reads nor writes derivatives.
        camera_moves: a parameter of the camera is differentiated.
        source: ``make_source`` or its like.
        least: number of path vertices behind x_1 without which ``source`` is zero.
        first: ``make_first_sink`` or its like.
    """
    connect, extend = make_walk(config)
    evaluates = role == "target"
    accumulate_first = None if evaluates else first(role, config.surfaces.primitives)
    accumulate_found = None if evaluates else make_found_sink(role, config.surfaces.primitives, first)
    point_at = make_point_at(config.surfaces.primitives)
    accumulate_camera = make_camera_sink(role, config.camera) if camera_moves and not evaluates else None
    splat, gather = make_splat()
    lens_point = make_lens(config.camera)
    sliding = 0 if config.material_first else 1  # vertices of the walk that slide along the camera's rays
    draw = make_sampler(config.sampler)
    sample_2d = draw.sample_2d
    sample_4d = draw.sample_4d
    note_place = make_note(config.noted)

    @wp.func
    def transport(
        scene: Scene,
        camera: Camera,
        sampler: Sampler,
        s: Segment,
        scale: wp.float32,
        rest: wp.float32,
        job: SampleJob,
        target: wp.array(dtype=wp.float32),
        image: wp.array2d(dtype=wp.vec3),
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        tri = scene.triangles[s.face1]
        walk = Walk()
        walk.alive = 1
        walk.face = s.face1
        walk.u = s.u1
        walk.v = s.v1
        walk.x = point_at(scene, tri, s.u1, s.v1)
        walk.to = s.w
        walk.weight = wp.vec3(1.0, 1.0, 1.0)
        lens = lens_point(sample_2d(sampler, SLOT_LENS))
        second = Walk()
        # Velocity of x_1 as the walk finds it for a unit weight (forward), or the sum of its weights (reverse).
        moved = wp.float32(0.0)
        known = wp.int32(0)
        weight = wp.float32(0.0)
        total = wp.float32(0.0)
        incident = Incident()
        note_place(scene, NOTE_SENSOR, s.face1, s.u1, s.v1, s.x, s.w, wp.vec3(scale))
        note_place(scene, NOTE_SOURCE, s.face2, s.u2, s.v2, s.x, s.w, s.radiance)
        k = wp.int32(1)
        while walk.alive == 1:
            seen = connect(scene, camera, walk, lens)
            counts = not vanishes(seen.weight)
            if k == 1 and s.light >= 0:
                counts = counts and not pass_together(seen.at.origin - walk.x, s.w, s.t1, s.step)
            asked = wp.vec3(0.0, 0.0, 0.0)
            speed = wp.float32(0.0)
            if counts:
                # What nobody asks for, or what does not move, needs no light.
                if wp.static(role == "reverse" or role == "samples"):
                    asked = gather(camera, seen.at.pixel, job.image_adjoint)
                    counts = wp.max(wp.abs(asked)) > 0.0
                if wp.static(role == "forward"):
                    if k == wp.static(sliding):
                        ray = wp.normalize(walk.x - seen.at.origin)
                        a_o, a_d, speed_1 = accumulate_first(scene, target, s, 1.0, True, seen.at.origin, ray)
                        speed = speed_1
                        if wp.static(camera_moves):
                            speed += accumulate_camera(scene, target, camera, seen.at.sample, a_o, a_d)
                    else:
                        if known == 0:
                            moved = accumulate_found(scene, target, s, 1.0, second)
                            known = 1
                        speed = moved
                    speed += rest
                    counts = speed != 0.0
            if counts:
                if not serves_length(incident, k):
                    branch = branch_of(sampler, k)
                    incident = source(scene, branch, s, k, job.max_depth, job.rr_depth)
                value = scale * wp.cw_mul(seen.weight, radiance_behind(incident, k))
                if wp.static(evaluates):
                    total += value[0] + value[1] + value[2]
                elif wp.static(role == "forward"):
                    splat(scene, sampler, camera, seen.at.pixel, speed * value, image)
                else:
                    w = wp.dot(asked, value)
                    total += w
                    if k == wp.static(sliding) and w != 0.0:
                        ray = wp.normalize(walk.x - seen.at.origin)
                        a_o, a_d, dropped = accumulate_first(scene, target, s, w, True, seen.at.origin, ray)
                        if wp.static(camera_moves):
                            dropped += accumulate_camera(scene, target, camera, seen.at.sample, a_o, a_d)
                        if dropped != 0.0:
                            count_invalid(scene, sampler)
                    else:
                        weight += w
            if job.max_depth >= 0 and k + 1 + wp.static(least) > job.max_depth:
                walk.alive = 0
            else:
                u4 = sample_4d(sampler, SLOT_WALK + k)
                walk = extend(scene, walk, u4, FAR, k >= job.rr_depth)
                if k == 1:
                    second = walk
                if walk.alive == 1:
                    note_place(scene, NOTE_WALK, walk.face, walk.u, walk.v, walk.x, -walk.to, walk.weight)
            k += 1
        if wp.static(role != "forward" and not evaluates):
            if weight != 0.0:
                if accumulate_found(scene, target, s, weight, second) != 0.0:
                    count_invalid(scene, sampler)
        return total

    return transport
