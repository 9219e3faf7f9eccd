"""The contribution of one crossing of a line and a discontinuity: one term of the sum in ``line_search.py``."""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.kernels.boundary.path_space.light_frame import make_frame_sink
from warp_psdr.kernels.boundary.path_space.secondary import make_segment_sink, make_source_sink
from warp_psdr.kernels.boundary.specular.chain_edges import Crossing
from warp_psdr.kernels.boundary.specular.chain_outlines import make_outline_sink
from warp_psdr.kernels.boundary.specular.chain_pullback import Visit, make_chain_pullback
from warp_psdr.kernels.boundary.specular.discontinuity import make_crossing
from warp_psdr.kernels.boundary.specular.media_chain import make_follow_media_chain
from warp_psdr.kernels.boundary.specular.ray_differential import RayDifferential, make_film_differential
from warp_psdr.kernels.boundary.specular.specular_chain import (
    Block,
    film_at,
    film_point,
    make_follow_chain,
    make_identity,
    make_start,
)
from warp_psdr.kernels.boundary.specular.triangle_borders import Tables
from warp_psdr.kernels.boundary.transport import Segment
from warp_psdr.kernels.constants import EMITTER_PROJECTOR
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.invalid import count_invalid, vanishes
from warp_psdr.kernels.notes import NOTE_EDGE, make_note
from warp_psdr.kernels.phase.dispatch import make_phase
from warp_psdr.kernels.primitive.dispatch import has_sliding, make_adjoint_sink
from warp_psdr.kernels.rng import Sampler, branch_of
from warp_psdr.kernels.sensor.camera import CameraSample
from warp_psdr.kernels.sensor.projection import make_splat
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint
from warp_psdr.kernels.texture.steps import make_slide_sink
from warp_psdr.kernels.vertex import PathConfig


@wp.struct
class Line:
    """The search along a line, and the path to the block in which it lies."""

    throughput: wp.vec3  # of the path, over the density of the line
    camera: CameraSample  # of the path
    q: wp.vec2  # its place on the film
    count: wp.int32  # its vertices
    slot: wp.int32  # first sample slot of the search
    max_depth: wp.int32
    rr_depth: wp.int32


@functools.cache
def make_line_sink(config: PathConfig, wanted: GradientRequest, role: str, light_pose: bool, grids_move: bool):
    """Return ``accumulate_crossings(scene, camera, edges, tables, block, line, low, high, weight, visits, ...)``.

    Adds what lies between the neighbouring points ``low`` and ``high`` of a line, as ``weight`` crossings.
    """
    start_at = make_start(config.camera)
    film_differential = make_film_differential(config.camera)
    identity = make_identity(config)
    among_media = config.media is not None
    follow_chain = make_follow_media_chain(config) if among_media else make_follow_chain(config)
    phase = make_phase(config.media.phases) if config.media is not None else None
    crossing_at = make_crossing(config)
    pull = make_chain_pullback(config, wanted, role, grids_move)
    accumulate_segment = make_segment_sink(role, light_pose, config.surfaces.primitives)
    accumulate_source = make_source_sink(role, light_pose, config.surfaces.primitives)
    sliding = has_sliding(config.surfaces.primitives)
    accumulate_outline = make_outline_sink(role, config.surfaces.primitives)
    accumulate_vertex = make_adjoint_sink(role, False, False, False, False, False, True, config.surfaces.primitives)
    accumulate_slide = make_slide_sink(role) if config.surfaces.steps else None
    projects = light_pose and EMITTER_PROJECTOR in config.lights.others
    accumulate_frame = make_frame_sink(role) if projects else None
    interaction = make_interaction(config.surfaces, config.lights)
    has_smooth = interaction.eval is not None
    splat, gather = make_splat()
    note_place = make_note(config.noted)

    @wp.func
    def accumulate_point(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        s: Segment,
        face: wp.int32,
        u: wp.float32,
        v: wp.float32,
        g: wp.vec3,
    ) -> wp.float32:
        """Scatter the adjoint g of a material point."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        adjoint = VertexAdjoint()
        adjoint.x = g
        accumulated = accumulate_vertex(scene, target, face, u, v, adjoint, False, s.x, s.w)
        return accumulated.dot

    @wp.func
    def beside_crossing(
        scene: Scene,
        camera: Camera,
        tables: Tables,
        block: Block,
        s: wp.float32,
        step: wp.float32,
        max_depth: wp.int32,
        links: wp.int32,
    ) -> wp.float32:
        """A step away from s, in either direction, where the first ``links`` vertices are those at s; else s itself.

        On the curve itself what is met wavers by roundings: the line may cross it an odd number of times there.
        """
        name = identity(scene, camera, tables.group, tables.interpolated, tables.steps, block, s, max_depth, links)
        for k in range(2):
            away = s + (1.0 - 2.0 * wp.float32(k)) * step
            if name == identity(
                scene, camera, tables.group, tables.interpolated, tables.steps, block, away, max_depth, links
            ):
                return away
        return s

    @wp.func
    def jump_at(
        scene: Scene,
        camera: Camera,
        tables: Tables,
        block: Block,
        line: Line,
        low: wp.float32,
        high: wp.float32,
        r: Crossing,
        visits: wp.array(dtype=Visit),
        sampler: Sampler,
    ) -> wp.vec3:
        """F_high - F_low, or the side that counts."""
        jump = wp.vec3(0.0, 0.0, 0.0)
        branch = branch_of(sampler, 1 + line.slot)
        for k in range(2):
            sign = 2.0 * wp.float32(k) - 1.0
            s = wp.where(k == 0, low, high)
            if r.side == 0 or wp.float32(r.side) == sign:
                if r.low_lies != 0:
                    s -= sign * wp.float32(r.low_lies) * r.aside
                elif r.aside > 0.0:
                    links = r.last - line.count + 2
                    s = beside_crossing(scene, camera, tables, block, s, sign * r.aside, line.max_depth, links)
                f = follow_chain(scene, camera, block, s, branch, line.max_depth, line.rr_depth)
                if wp.static(among_media):
                    if block.film == 0 and block.shape < 0:
                        m = scene.media.records[block.medium]
                        ray = start_at(scene, camera, block, s)
                        f *= phase.eval(scene, m, block.x, block.arrives, ray.d)
                if wp.static(has_smooth):
                    if block.film == 0 and (wp.static(not among_media) or block.shape >= 0):
                        y = visits[line.count - 1]
                        g = interaction.at(scene, y.face, y.u, y.v, y.d)
                        ray = start_at(scene, camera, block, s)
                        f = wp.cw_mul(f, interaction.eval(g, enter_frame(g.frame, ray.d)))
                jump += sign * f
        return jump

    @wp.func
    def accumulate_crossings(
        scene: Scene,
        camera: Camera,
        edges: Edges,
        tables: Tables,
        block: Block,
        line: Line,
        low: wp.float32,
        high: wp.float32,
        weight: wp.float32,
        visits: wp.array(dtype=Visit),
        sampler: Sampler,
        adjoint: wp.array2d(dtype=wp.vec3),
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        a = RayDifferential()
        b = RayDifferential()
        if block.film == 1:
            at = film_at(block, low)
            a = film_differential(scene, camera, at, block.lens, block.e)
            b = film_differential(scene, camera, at, block.lens, wp.vec2(-block.e[1], block.e[0]))
        else:
            angle = low * block.ell
            a.d = wp.cos(angle) * block.w1 - wp.sin(angle) * block.w0
            b.d = wp.cross(block.w0, block.w1)
        which = wp.int32(0)
        sides = wp.int32(1)
        while which < sides:
            r = crossing_at(
                scene, camera, edges, tables, block, low, high, which, a, b, visits, line.count, line.max_depth
            )
            sides = 1 + r.both
            which += 1
            if wp.static(sliding):
                if block.film == 0 and r.edge != 2:
                    # What a segment's other end is tied to.
                    r.segment.face1 = visits[line.count - 1].face
                    r.segment.u1 = visits[line.count - 1].u
                    r.segment.v1 = visits[line.count - 1].v
            squared = r.phi_a * r.phi_a + r.phi_b * r.phi_b
            if r.valid == 1 and not (squared <= 0.0):
                if r.edge == 1:
                    place = r.point.x
                    note_place(scene, NOTE_EDGE, r.point.edge, r.point.s, 0.0, place, r.segment.w, line.throughput)
                jump = jump_at(scene, camera, tables, block, line, low, high, r, visits, sampler)
                scale = 2.0 * weight * r.phi_a / (squared * block.ell)
                value = scale * wp.cw_mul(line.throughput, jump)
                at_q = line.q
                seen = line.camera
                if block.film == 1:
                    at_q = film_at(block, low)
                    seen = CameraSample()
                    seen.film = film_point(camera, at_q)
                    seen.lens = block.lens
                w = wp.float32(1.0)
                if wp.static(role == "reverse"):
                    w = wp.dot(gather(camera, at_q, adjoint), value)
                if not vanishes(value) and w != 0.0:
                    start = VertexAdjoint()
                    start.x = w * r.start.x
                    start.u = w * r.start.u
                    start.v = w * r.start.v
                    start.n = w * r.start.n
                    start.c = w * r.start.c
                    speed = pull(
                        scene, target, camera, seen, visits, r.last, start, w * r.o_before, w * r.a_o, w * r.a_d
                    )
                    if r.edge == 2:
                        met = r.segment
                        speed += accumulate_point(
                            scene, target, met, met.face2, met.u2, met.v2, w * met.boundary_normal
                        )
                        if met.face1 >= 0:
                            speed += accumulate_point(
                                scene, target, met, met.face1, met.u1, met.v1, w * r.boundary_normal1
                            )
                    if wp.static(config.surfaces.steps):
                        if r.edge == 4:
                            end = visits[r.last]
                            tri = scene.triangles[end.face]
                            speed += accumulate_slide(scene, target, r.step.texture, r.step.axis, tri, end.u, end.v, w)
                    if wp.static(accumulate_frame is not None):
                        if r.edge == 5:
                            of_image = wp.vec2(r.segment.u2, r.segment.v2)
                            light = scene.emitters[r.segment.light]
                            g = w * r.segment.boundary_normal
                            speed += accumulate_frame(scene, target, light, of_image, r.segment.tau, g)
                    if r.edge == 1:
                        speed += accumulate_segment(scene, target, edges, r.point, r.segment, w)
                    if wp.static(bool(config.surfaces.primitives)):
                        if r.edge == 3:
                            moved = w * r.segment.boundary_normal
                            speed = accumulate_source(scene, target, r.segment, w, speed)
                            speed += accumulate_outline(scene, target, r.outline, moved)
                    if wp.static(sliding):
                        if wp.length_sq(r.tied) > 0.0:
                            y = visits[line.count - 1]
                            speed += accumulate_point(scene, target, r.segment, y.face, y.u, y.v, w * r.tied)
                    if wp.static(role == "forward"):
                        splat(scene, sampler, camera, at_q, speed * value, image_out)
                    elif wp.static(role == "reverse"):
                        if speed != 0.0:
                            count_invalid(scene, sampler)

    return accumulate_crossings
