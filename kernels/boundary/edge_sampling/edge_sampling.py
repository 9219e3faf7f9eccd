"""Unidirectional edge sampling [LADL18]: silhouette edges as every vertex of a camera path sees them.

With T_k the throughput up to vertex k and an edge point drawn by pdf_l, dI = sum_k T_k f_s(w_i, omega) L_2 sin(phi) n .
( x_b' - (1 - tau) x_1' - tau x_2' ) / (t_1^2 pdf_l). This is an angular velocity times an element of the silhouette
[LADL18, eq. 8 and 9]. Edges are resampled (``edge_tree.py``) from lobes about the scattering function and about a
light.

Derivation: ``docs/theory/edge_sampling.md#edges-as-a-path-vertex-sees-them``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.coincident import edge_share
from warp_psdr.kernels.boundary.depth import DIRECT
from warp_psdr.kernels.boundary.detector import make_incident_radiance
from warp_psdr.kernels.boundary.edge_sampling.drawn_edge import SLOT_LIGHT, make_drawn_edge
from warp_psdr.kernels.boundary.edge_sampling.edge_tree import EdgeTrees
from warp_psdr.kernels.boundary.edge_sampling.vertex_lobes import make_vertex_lobes
from warp_psdr.kernels.boundary.film_edge import BESIDE
from warp_psdr.kernels.boundary.local_form import EdgePoint, Edges, edge_behind, edge_step
from warp_psdr.kernels.boundary.path_space.secondary import Segment, make_segment_sink
from warp_psdr.kernels.boundary.transport import make_first_sink
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.invalid import count_invalid, finite, vanishes
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.notes import NOTE_EDGE, make_note
from warp_psdr.kernels.path import make_camera_start, make_path_step
from warp_psdr.kernels.rng import SALT_X, SALT_Y, Sampler, independent_4d, pcg4d, sampler_at
from warp_psdr.kernels.sensor.camera import make_camera_ray, make_camera_sink
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of


@wp.struct
class EdgeSample:
    """A boundary segment from a path vertex, and f_s / (t_1^2 pdf_l)."""

    segment: Segment
    point: EdgePoint
    value: wp.vec3


@functools.cache
def make_edge_sample(config: PathConfig, tree: bool, candidates: int):
    """Return ``edge_sample(scene, edges, trees, face, u, v, d, sampler, last) -> EdgeSample``.

    ``d`` is the direction of the ray that found the vertex; ``last``: only a light may follow.
    """
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    interaction = make_interaction(config.surfaces, config.lights)
    surface_lobes, _volume_lobes = make_vertex_lobes(config.surfaces, config.lights)
    draw_edge = make_drawn_edge(tree, candidates)

    @wp.func
    def edge_sample(
        scene: Scene,
        edges: Edges,
        trees: EdgeTrees,
        face: wp.int32,
        u: wp.float32,
        v: wp.float32,
        d: wp.vec3,
        sampler: Sampler,
        last: wp.bool,
    ) -> EdgeSample:
        r = EdgeSample()
        at = interaction.at(scene, face, u, v, d)
        if at.wi[2] <= 0.0:
            return r
        x1 = at.x
        lobes = surface_lobes(scene, at, independent_4d(sampler, SLOT_LIGHT), last)
        drawn = draw_edge(scene, edges, trees, lobes, x1, sampler)
        if drawn.point.edge < 0:
            return r
        point = drawn.point
        t1 = drawn.t1
        w = drawn.w
        side = drawn.side
        f = interaction.eval(at, enter_frame(at.frame, w))
        # Where the density is 0 so is f: both are of the same cosine. A point that is drawn is not seen end-on.
        if side == 0.0 or vanishes(f):
            return r
        # The line passes the occluder on its outside.
        step = edge_step(scene, edges, point.edge)
        m = wp.cross(drawn.tangent, w)
        x = point.x - (step * side / drawn.sine) * m
        behind = wp.min(edge_behind(scene, step), 0.5 * t1)
        o = interaction.offset(at, w)
        ray = x - o
        distance = wp.length(ray)
        if distance > behind and visibility.occluded(scene, o, ray / distance, distance - behind):
            return r
        s = Segment()
        s.light = -1
        s.x = x
        # Past the edge so closely that small lights behind it are met.
        s.source = point.x - (BESIDE * step * side / drawn.sine) * m - behind * w
        s.w = w
        s.boundary_normal = side * m
        s.t1 = t1
        s.face1 = face
        s.u1 = u
        s.v1 = v
        hit = visibility.closest(scene, s.source, w, FAR)
        s.face2 = hit.face
        if hit.face >= 0:
            s.tau = t1 / (t1 + wp.max(hit.t - behind, 0.0))
            s.u2 = hit.u
            s.v2 = hit.v
            if hit.t <= behind + step:
                # A contact may be a notch (``concave_edge.py``).
                s.source = x - behind * w
        s.valid = 1
        # pdf_l = q boost / scale, q = density sin(phi) / t_1^2; t_1^2 cancels against the measure.
        share = edge_share(scene, edges, point, drawn.tangent, w, side)
        r.value = (share * drawn.scale / (drawn.density * drawn.sine)) * f
        r.segment = s
        r.point = point
        return r

    return edge_sample


@functools.cache
def make_edge_sampling_kernel(
    config: PathConfig,
    walk: PathConfig,
    role: str,
    camera_moves: bool,
    tree: bool,
    candidates: int,
    indirect: bool = False,
):
    """Return the kernel: one thread a sample of a pixel.

    Args:
        config: what the scene needs.
        walk: the same with the sampler of camera paths and without lights, which such a path does not look for.
        role: "reverse" (``adjoint`` is read, ``target`` receives the gradient) or "forward" (``target`` holds the
            tangents, ``image_out`` receives the derivative image).
        camera_moves: a parameter of the camera is differentiated.
        tree: choose edges with the hierarchies.
        candidates: edges that are resampled.
        indirect: paths of two vertices are left out (``depth.py``).
    """
    start = make_camera_start(walk)
    _camera_ray, camera_origin = make_camera_ray(config.camera)
    path_step = make_path_step(walk, False)
    edge_sample = make_edge_sample(config, tree, candidates)
    incident_radiance = make_incident_radiance(config)
    accumulate_segment = make_segment_sink(role, False)
    accumulate_first = make_first_sink(role)
    accumulate_camera = make_camera_sink(role, config.camera) if camera_moves else None
    note_place = make_note(config.noted)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def edge_sampling(
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
        state, ray = start(scene, camera, px, py, sampler)
        origin = camera_origin(scene, camera, ray)
        scale = 1.0 / wp.float32(job.samples)
        total = wp.vec3(0.0, 0.0, 0.0)
        dropped = wp.float32(0.0)
        k = wp.int32(1)
        while state.alive == 1:
            vertex, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
            if vertex.face >= 0 and (job.max_depth < 0 or k < job.max_depth):
                words = pcg4d(job.seed, wp.uint32(k), SALT_X, SALT_Y)
                branch = sampler
                branch.seed = words.x
                drawn = edge_sample(
                    scene, edges, trees, vertex.face, vertex.u, vertex.v, vertex.d, branch, k + 1 == job.max_depth
                )
                s = drawn.segment
                if s.valid == 1:
                    at = drawn.point
                    note_place(scene, NOTE_EDGE, at.edge, at.s, 0.0, at.x, s.w, drawn.value)
                    branch.seed = words.y
                    source = incident_radiance(
                        scene, branch, s.source, s.w, FAR, k, job.max_depth, job.rr_depth
                    ).radiance
                    if wp.static(indirect):
                        if k == 1:
                            source -= incident_radiance(
                                scene, branch, s.source, s.w, FAR, k, DIRECT, job.rr_depth
                            ).radiance
                    value = scale * wp.cw_mul(wp.cw_mul(vertex.throughput, drawn.value), source)
                    if not vanishes(value):
                        w = wp.float32(1.0)
                        if wp.static(role == "reverse"):
                            w = wp.dot(delta, value)
                        a_o, a_d, speed = accumulate_first(scene, target, s, w, k == 1, origin, vertex.d)
                        speed += accumulate_segment(scene, target, edges, drawn.point, s, w)
                        if wp.static(camera_moves):
                            if k == 1:
                                speed += accumulate_camera(scene, target, camera, ray, a_o, a_d)
                        total += speed * value
                        if wp.static(role == "reverse"):
                            dropped += speed
            k += 1
        if dropped != 0.0 or not finite(total):
            count_invalid(scene, sampler_at(number, 0, job.seed))  # its number in the term
        elif wp.static(role == "forward"):
            wp.atomic_add(image_out, py, px, total)

    return edge_sampling
