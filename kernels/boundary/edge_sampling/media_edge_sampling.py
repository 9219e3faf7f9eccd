"""Edge sampling in media: silhouette edges as the vertices of a camera path see them, on surfaces and in the medium.

The estimator is that of ``edge_sampling.py`` with dI = sum_k T_k f L_full sin(phi) n . ( x_b' - (1 - tau) x_1' - tau
z_2' ) / (t_1^2 pdf_l). A vertex in the medium has the phase function for f, without a cosine; its sigma_s is in T_k.
L_full is the radiance at x_1 of the whole ray past the occluder, up to the surface z_2. A vertex rides on a fraction of
the ray that found it. Paths are therefore recorded and swept from their ends, and each vertex hands part of its adjoint
on towards the camera.

Derivation: ``docs/theory/media.md#edges-seen-from-media``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.coincident import edge_share
from warp_psdr.kernels.boundary.edge_sampling.drawn_edge import SLOT_LIGHT, DrawnEdge, make_drawn_edge
from warp_psdr.kernels.boundary.edge_sampling.edge_tree import EdgeTrees
from warp_psdr.kernels.boundary.edge_sampling.vertex_lobes import make_vertex_lobes
from warp_psdr.kernels.boundary.local_form import Edges, edge_behind, edge_step
from warp_psdr.kernels.boundary.media_radiance import make_end_radiance, make_media_incident
from warp_psdr.kernels.boundary.path_space.media_ride import make_media_ride
from warp_psdr.kernels.boundary.path_space.media_walk import MediaWalk, Sight
from warp_psdr.kernels.boundary.path_space.secondary import make_segment_sink
from warp_psdr.kernels.boundary.transport import Segment
from warp_psdr.kernels.constants import FAR, LOBE_NULL
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.invalid import count_invalid, finite, vanishes
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.medium.line import AHEAD, make_line
from warp_psdr.kernels.medium.passage import medium_towards
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path import make_camera_start
from warp_psdr.kernels.path_media import MediaState, collision_point, make_media_step, media_path_from
from warp_psdr.kernels.phase.dispatch import make_phase
from warp_psdr.kernels.primitive.dispatch import make_position
from warp_psdr.kernels.rng import SALT_X, SALT_Y, Sampler, independent_4d, pcg4d, sampler_at
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_origin
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig


@wp.struct
class ViewingVertex:
    """A vertex of a camera path, and the ray on which it was found; ``walk.weight``: its throughput."""

    walk: MediaWalk
    depth: wp.int32  # vertices in front of it
    start: wp.vec3  # y: where the ray's direction was drawn
    d: wp.vec3
    near: wp.float32  # where the ray crosses its last interface: distance from y
    near_face: wp.int32  # -1: it crosses none
    near_u: wp.float32
    near_v: wp.float32


@wp.struct
class ViewingState:
    """What one vertex hands to the next; ``ray`` has the start and the last interface of the ray."""

    media: MediaState
    ray: ViewingVertex


@wp.struct
class MediaEdge:
    """A boundary segment from a path vertex, and f L_full / (t_1^2 pdf_l)."""

    segment: Segment
    drawn: DrawnEdge
    value: wp.vec3


@functools.cache
def make_viewing_vertex(walk: PathConfig):
    """Return ``next_vertex(scene, sampler, state, max_depth, rr_depth) -> (ViewingVertex, ViewingState)``.

    Interfaces are passed; the vertex is not alive if the path has ended.
    """
    media_step = make_media_step(walk, False)
    position, _cross_of = make_position(walk.surfaces.primitives)

    @wp.func
    def next_vertex(
        scene: Scene, sampler: Sampler, before: ViewingState, max_depth: wp.int32, rr_depth: wp.int32
    ) -> tuple[ViewingVertex, ViewingState]:
        r = before.ray
        r.walk.alive = 0
        state = before
        while state.media.path.alive == 1 and r.walk.alive == 0:
            path = state.media.path
            r.depth = path.depth
            r.d = path.d
            step, after = media_step(scene, sampler, state.media, max_depth, rr_depth)
            state.media = after
            if step.collides or step.surface.face >= 0:
                if step.collides:
                    x = collision_point(step)
                else:
                    x = position(scene.triangles[step.surface.face], step.surface.u, step.surface.v)
                if not step.collides and step.surface.lobe == LOBE_NULL:
                    r.near = wp.dot(x - r.start, path.d)
                    r.near_face = step.surface.face
                    r.near_u = step.surface.u
                    r.near_v = step.surface.v
                else:
                    r.walk.alive = 1
                    r.walk.collides = step.collides
                    r.walk.face = step.surface.face
                    r.walk.u = step.surface.u
                    r.walk.v = step.surface.v
                    r.walk.x = x
                    r.walk.to = path.d
                    r.walk.medium = step.medium
                    r.walk.weight = step.surface.throughput
        state.ray = ViewingVertex()
        state.ray.start = state.media.path.o
        state.ray.near_face = -1
        return r, state

    return next_vertex


@functools.cache
def make_media_edge(config: PathConfig, tree: bool, candidates: int, traces: bool):
    """Return ``media_edge(scene, edges, trees, seen, sampler, source, max_depth, rr_depth) -> MediaEdge``.

    ``seen`` is the path's vertex, ``sampler`` draws the edge, ``source`` the path beyond. ``traces``: light may come
    from more than what is at the segment's end. The value is 0 where there is no segment.
    """
    assert config.media is not None
    interaction = make_interaction(config.surfaces, config.lights)
    surface_lobes, volume_lobes = make_vertex_lobes(config.surfaces, config.lights)
    draw_edge = make_drawn_edge(tree, candidates)
    phase = make_phase(config.media.phases)
    line, _medium_at = make_line(config)
    end_radiance = make_end_radiance(config.lights)
    media_incident = make_media_incident(config) if traces else None
    emissive = config.media.emissive
    scatters = interaction.eval is not None

    @wp.func
    def media_edge(
        scene: Scene,
        edges: Edges,
        trees: EdgeTrees,
        seen: ViewingVertex,
        sampler: Sampler,
        source: Sampler,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> MediaEdge:
        r = MediaEdge()
        x1 = seen.walk.x
        k = seen.depth + 1
        last = k + 1 == max_depth
        u4 = independent_4d(sampler, SLOT_LIGHT)
        medium = seen.walk.medium
        f = wp.vec3(0.0, 0.0, 0.0)
        o = x1
        drawn = DrawnEdge()
        # ---- An edge, and what the vertex scatters from there ----
        if seen.walk.collides:
            drawn = draw_edge(scene, edges, trees, volume_lobes(scene, x1, u4, last), x1, sampler)
            if drawn.point.edge < 0:
                return r
            f = wp.vec3(1.0, 1.0, 1.0) * phase.eval(scene, scene.media.records[medium], x1, seen.d, drawn.w)
        else:
            if wp.static(scatters):
                at = interaction.at(scene, seen.walk.face, seen.walk.u, seen.walk.v, seen.d)
                if at.wi[2] <= 0.0:
                    return r
                drawn = draw_edge(scene, edges, trees, surface_lobes(scene, at, u4, last), x1, sampler)
                if drawn.point.edge < 0:
                    return r
                f = interaction.eval(at, enter_frame(at.frame, drawn.w))
                o = interaction.offset(at, drawn.w)
                medium = medium_towards(scene, at.shape, at.ng, seen.d, drawn.w, medium)
        if drawn.side == 0.0 or vanishes(f):
            return r
        # ---- The ray past the occluder, on its outside ----
        point = drawn.point
        step = edge_step(scene, edges, point.edge)
        s = Segment()
        s.light = -1
        s.t1 = drawn.t1
        s.boundary_normal = drawn.side * wp.cross(drawn.tangent, drawn.w)
        s.x = point.x - (step / drawn.sine) * s.boundary_normal
        behind = wp.min(edge_behind(scene, step), 0.5 * s.t1)
        reach = wp.length(s.x - o)
        s.w = (s.x - o) / reach
        ahead = line(scene, source, AHEAD, o, s.w, FAR, medium, 1)
        if ahead.lost or (ahead.face >= 0 and ahead.t < reach - behind):
            return r
        s.face2 = ahead.face
        s.u2 = ahead.u
        s.v2 = ahead.v
        if ahead.face >= 0:
            s.tau = s.t1 / (s.t1 + wp.max(ahead.t - reach, 0.0))
        radiance = wp.cw_mul(ahead.transmittance, end_radiance(scene, s.face2, s.u2, s.v2, s.w))
        if wp.static(traces):
            if wp.static(emissive) or max_depth < 0 or k + 2 <= max_depth:
                radiance += media_incident(scene, source, medium, o, s.w, k, max_depth, rr_depth).total
        # pdf_l = q boost / scale, q = density sin(phi) / t_1^2; t_1^2 cancels against the measure.
        share = edge_share(scene, edges, point, drawn.tangent, s.w, drawn.side)
        r.value = (share * drawn.scale / (drawn.density * drawn.sine)) * wp.cw_mul(f, radiance)
        r.segment = s
        r.drawn = drawn
        return r

    return media_edge


@functools.cache
def make_media_edge_sampling_kernel(
    config: PathConfig,
    walk: PathConfig,
    role: str,
    camera_moves: bool,
    grids_move: bool,
    tree: bool,
    candidates: int,
    traces: bool,
    block: int,
    longest: int,
):
    """Return the kernel: one thread a sample of a pixel.

    Args:
        config: what the scene needs.
        walk: the same without lights, which the camera's path does not look for.
        role: "reverse" (``adjoint`` is read, ``target`` receives the gradient) or "forward" (``target`` holds the
            tangents, ``image_out`` receives the derivative image).
        camera_moves: a parameter of the camera is differentiated.
        grids_move: grids of media have derivatives.
        tree: choose edges with the hierarchies.
        candidates: edges that are resampled.
        traces: light may come from more than what is at a segment's end.
        block: the number of vertices kept at a time.
        longest: most vertices of a path.
    """
    start = make_camera_start(walk)
    camera_origin = make_camera_origin(config.camera)
    next_vertex = make_viewing_vertex(walk)
    media_edge = make_media_edge(config, tree, candidates, traces)
    accumulate_segment = make_segment_sink(role, False)
    by_camera, by_surface = make_media_ride(config, role, camera_moves, grids_move)
    channels = 3 if role == "forward" else 1
    blocks = -(-longest // block)

    @wp.func
    def handed_on(
        scene: Scene,
        camera: Camera,
        target: wp.array(dtype=wp.float32),
        sample: CameraSample,
        seen: ViewingVertex,
        g: wp.vec3,
    ) -> tuple[wp.vec3, wp.float32]:
        """Scatter the adjoint of a vertex; what is left for the one in front of it."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        t = wp.dot(seen.walk.x - seen.start, seen.d)
        if seen.depth == 0:
            sight = Sight()
            sight.at.origin = seen.start
            sight.at.sample = sample
            sight.d = seen.d
            sight.t = t
            sight.line.near = seen.near
            sight.line.near_face = seen.near_face
            sight.line.near_u = seen.near_u
            sight.line.near_v = seen.near_v
            return wp.vec3(0.0, 0.0, 0.0), by_camera(scene, camera, target, seen.walk, sight, g)
        after = MediaWalk()
        after.x = seen.start
        after.to = seen.d
        after.near = t - seen.near
        after.near_face = seen.near_face
        after.near_u = seen.near_u
        after.near_v = seen.near_v
        left, dot = by_surface(scene, target, seen.walk, after, g)
        return left, dot

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def media_edge_sampling(
        # Scene:
        scene: Scene,
        camera: Camera,
        edges: Edges,
        trees: EdgeTrees,
        # In:
        job: SampleJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        number = job.first + wp.tid()
        pixel = number // job.samples
        px = pixel % camera.crop_width
        py = pixel // camera.crop_width
        delta = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(role == "reverse"):
            delta = job.image_adjoint[py, px]
            if vanishes(delta):
                return
        sampler = sampler_at(pixel, number % job.samples, job.seed)
        started, sample = start(scene, camera, px, py, sampler)
        state = ViewingState()
        state.media = media_path_from(started, camera.medium)
        state.ray.start = camera_origin(scene, camera, sample)
        state.ray.near_face = -1
        limit = wp.int32(longest)
        if job.max_depth >= 0:
            limit = wp.min(job.max_depth, limit)
        scale = 1.0 / wp.float32(job.samples)
        total = wp.vec3(0.0, 0.0, 0.0)
        dropped = wp.float32(0.0)
        record = wp.zeros(shape=(wp.static(block),), dtype=ViewingVertex)
        states = wp.zeros(shape=(wp.static(blocks),), dtype=ViewingState)
        # Adjoints of the vertex that is swept, by channel.
        carried = wp.zeros(shape=(wp.static(channels),), dtype=wp.vec3)
        # Blocks are traced from the first to the last, and swept, and traced again, from the last to the first.
        b = wp.int32(0)
        tracing = wp.bool(True)
        while b >= 0:
            states[b] = state
            count = wp.int32(0)
            while state.media.path.alive == 1 and count < wp.static(block):
                seen, state = next_vertex(scene, sampler, state, limit, job.rr_depth)
                if seen.walk.alive == 1:
                    record[count] = seen
                    count += 1
            if tracing and state.media.path.alive == 1 and b + 1 < wp.static(blocks):
                b += 1
            else:
                tracing = False
                for n in range(count):
                    at = record[count - 1 - n]
                    if job.max_depth < 0 or at.depth + 1 < job.max_depth:
                        words = pcg4d(job.seed, wp.uint32(at.depth + 1), SALT_X, SALT_Y)
                        branch = sampler
                        branch.seed = words.x
                        source = sampler
                        source.seed = words.y
                        found = media_edge(scene, edges, trees, at, branch, source, job.max_depth, job.rr_depth)
                        value = scale * wp.cw_mul(at.walk.weight, found.value)
                        if not vanishes(value):
                            s = found.segment
                            w = wp.float32(1.0)
                            if wp.static(role == "reverse"):
                                w = wp.dot(delta, value)
                            speed = accumulate_segment(scene, target, edges, found.drawn.point, s, w)
                            g = (s.tau - 1.0) * s.boundary_normal
                            if wp.static(role == "reverse"):
                                dropped += speed
                                carried[0] = carried[0] + w * g
                            else:
                                total += speed * value
                                for channel in range(wp.static(channels)):
                                    carried[channel] = carried[channel] + value[channel] * g
                    for channel in range(wp.static(channels)):
                        if not vanishes(carried[channel]):
                            left, dot = handed_on(scene, camera, target, sample, at, carried[channel])
                            carried[channel] = left
                            if wp.static(role == "reverse"):
                                dropped += dot
                            else:
                                total[channel] = total[channel] + dot
                b -= 1
                if b >= 0:
                    state = states[b]
        if dropped != 0.0 or not finite(total):
            count_invalid(scene, sampler_at(number, 0, job.seed))  # its number in the term
        elif wp.static(role == "forward"):
            wp.atomic_add(image_out, py, px, total)

    return media_edge_sampling
