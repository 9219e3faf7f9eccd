"""Discontinuities seen through mirrors and glass in media, by searching along lines.

As in ``line_search.py``, but a path has volume vertices, at each of which a block starts, too, with F = f_p L. L is the
radiance of whole rays (``media_chain.py``), and a volume vertex rides on a fraction of its ray (``chain_pullback.py``).

Derivation: ``docs/theory/media.md#mirrors-and-glass-beside-media``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.kernels.boundary.specular.chain_pullback import Visit
from warp_psdr.kernels.boundary.specular.line_search import (
    ARC_CELLS,
    ARC_LENGTH,
    FILM_CELLS,
    SLOTS_PER_SEARCH,
    UNIFORM_SHARE,
    make_film_line,
    make_search,
)
from warp_psdr.kernels.boundary.specular.specular_chain import MAX_CHAIN, Block, step_from
from warp_psdr.kernels.boundary.specular.triangle_borders import Tables
from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import FAR, INV_FOUR_PI, LOBE_NULL, LOBE_SMOOTH, TWO_PI
from warp_psdr.kernels.interaction import enter_frame, leave_frame, make_interaction
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.invalid import finite
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.math import any_tangent
from warp_psdr.kernels.medium.grid_span import span_length, span_of
from warp_psdr.kernels.medium.interface import make_interface
from warp_psdr.kernels.medium.passage import is_lost
from warp_psdr.kernels.medium.volume import GRID
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path_media import collision_point, make_media_step, media_path_from
from warp_psdr.kernels.phase.dispatch import make_phase
from warp_psdr.kernels.primitive.dispatch import make_position
from warp_psdr.kernels.reading import texture_record
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.sampling import square_to_sphere
from warp_psdr.kernels.sensor.camera import make_camera_ray
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, path_from

#: Most vertices of a path that are kept: volume vertices ride on those before them, up to a surface.
MEDIA_WINDOW = 40
MEDIA_VISITS = MEDIA_WINDOW + MAX_CHAIN


@functools.cache
def make_media_line_search_kernel(
    config: PathConfig, wanted: GradientRequest, role: str, light_pose: bool, grids_move: bool
):
    """Return the kernel (``line_search.py``); ``grids_move``: grids of media have derivatives."""
    assert config.media is not None
    camera_ray, _camera_origin = make_camera_ray(config.camera)
    film_line = make_film_line(config.camera, config.sampler)
    search = make_search(config, wanted, role, light_pose, grids_move)
    media_step = make_media_step(config, False)
    is_interface, behind_of = make_interface(config)
    interaction = make_interaction(config.surfaces, config.lights)
    has_smooth = interaction.eval is not None
    phase = make_phase(config.media.phases)
    grids = config.media.grids
    position, _cross_of = make_position(config.surfaces.primitives)
    sample_4d = make_sampler(config.sampler).sample_4d

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def media_line_search(
        # Scene:
        scene: Scene,
        camera: Camera,
        edges: Edges,
        tables: Tables,
        # In:
        job: SampleJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        number = job.first + wp.tid()
        sampler = sampler_at(number, 0, job.seed)
        visits = wp.zeros(shape=(MEDIA_VISITS,), dtype=Visit)
        block, line = film_line(camera, job, number, sampler)
        search(
            scene, camera, edges, tables, block, line, FILM_CELLS, visits, sampler, job.image_adjoint, target, image_out
        )
        scale = line.throughput[0]
        ray = camera_ray(scene, camera, line.camera)
        started = path_from(ray.o + ray.t_min * ray.d, ray.d, ray.t_max - ray.t_min, 0)
        state = media_path_from(started, camera.medium)
        start = ray.o  # where the direction of the ray was drawn
        near = Visit()  # the last surface that is not there on the way from there
        near.near_face = -1
        count = wp.int32(0)  # of the vertices that are kept
        lost = wp.int32(0)  # 1: not all of them are
        slot = line.slot
        through = wp.int32(0)  # 1: a mirror or glass came before
        attached = wp.int32(1)
        while state.path.alive == 1 and state.path.depth + 2 <= line.max_depth:
            path = state.path
            medium = state.medium
            step, state = media_step(scene, sampler, state, job.max_depth, job.rr_depth)
            vertex = step.surface
            visit = near
            visit.face = vertex.face
            visit.u = vertex.u
            visit.v = vertex.v
            visit.o = start
            visit.d = vertex.d
            visit.lobe = vertex.lobe
            visit.attached = attached
            visit.far_face = vertex.face
            visit.far_u = vertex.u
            visit.far_v = vertex.v
            visit.far = FAR
            if vertex.face >= 0:
                x = position(scene.triangles[vertex.face], vertex.u, vertex.v)
                visit.far = wp.dot(x - start, vertex.d)
            if not step.collides and vertex.lobe == LOBE_NULL and is_interface(scene, vertex.face):
                near.near = visit.far
                near.near_face = vertex.face
                near.near_u = vertex.u
                near.near_v = vertex.v
            else:
                slot += SLOTS_PER_SEARCH
                if step.collides:
                    visit.medium = 1 + medium
                    visit.x = collision_point(step)
                    before = wp.dot(path.o - start, vertex.d)
                    if vertex.face >= 0:
                        visit.stretch = wp.max(visit.far - before, step.t)
                    if wp.static(grids):
                        m = scene.media.records[medium]
                        if m.sigma_t_channels == GRID:
                            ends = wp.where(vertex.face >= 0, before + visit.stretch, FAR)
                            grid = texture_record(scene, m.sigma_t)
                            origin = vertex.o - before * vertex.d
                            visit.stretch = span_length(span_of(scene, grid, origin, vertex.d, before, ends))
                    hit = RayHit()
                    hit.face = vertex.face
                    hit.u = vertex.u
                    hit.v = vertex.v
                    hit = behind_of(scene, hit, vertex.d, path.t_max, path.depth)
                    visit.face = hit.face
                    visit.u = hit.u
                    visit.v = hit.v
                if attached == 0 and not step.collides and vertex.lobe <= LOBE_SMOOTH:
                    # A material point: nothing is pulled back past it.
                    count = 0
                    lost = 0
                if count == MEDIA_WINDOW:
                    lost = 1
                    count -= 1
                visits[count] = visit
                count += 1
                # ---- A line of directions from there ----
                from_y = Block()
                from_y.medium = medium
                from_y.shape = -1
                from_y.arrives = vertex.d
                from_y.ell = ARC_LENGTH
                from_y.depth = path.depth + 1
                from_y.pattern = block.pattern
                from_y.first = through
                v4 = sample_4d(sampler, slot)
                w0 = square_to_sphere(wp.vec2(v4[1], v4[2]))
                again = (v4[0] - UNIFORM_SHARE) / (1.0 - UNIFORM_SHARE)
                found = wp.bool(False)
                density = wp.float32(0.0)
                if lost == 0 and finite(vertex.throughput):
                    if step.collides:
                        m = scene.media.records[medium]
                        if v4[0] >= UNIFORM_SHARE:
                            w0 = phase.sample(scene, m, visit.x, vertex.d, wp.vec2(v4[1], v4[2]))
                        density = phase.eval(scene, m, visit.x, vertex.d, w0)
                        from_y.x = visit.x
                        found = wp.bool(True)
                    elif vertex.face >= 0:
                        if wp.static(has_smooth):
                            g = interaction.at(scene, vertex.face, vertex.u, vertex.v, vertex.d)
                            from_y.shape = g.shape
                            if interaction.bsdf.has_smooth(g.model) and not is_lost(
                                scene, g.shape, g.ng, vertex.d, medium
                            ):
                                found = wp.bool(True)
                                if v4[0] >= UNIFORM_SHARE:
                                    bs = interaction.sample(g, again, wp.vec2(v4[1], v4[2]))
                                    w0 = leave_frame(g.frame, bs.wo)
                                    found = not (bs.pdf <= 0.0) and bs.lobe == LOBE_SMOOTH
                                density = interaction.pdf(g, enter_frame(g.frame, w0))
                                from_y.x = g.x
                                from_y.n = g.ng
                                from_y.step = step_from(scene, vertex.face, g.step)
                if found:
                    pdf = UNIFORM_SHARE * INV_FOUR_PI + (1.0 - UNIFORM_SHARE) * density
                    side = any_tangent(w0)
                    angle = TWO_PI * v4[3]
                    from_y.w0 = w0
                    from_y.w1 = wp.cos(angle) * side + wp.sin(angle) * wp.cross(w0, side)
                    line.throughput = (scale / pdf) * vertex.throughput
                    line.count = count
                    line.slot = slot + 1
                    search(
                        scene, camera, edges, tables, from_y, line, ARC_CELLS, visits, sampler,
                        job.image_adjoint, target, image_out,
                    )  # fmt: skip
                start = state.path.o
                near.near_face = -1
                attached = wp.where(vertex.lobe > LOBE_SMOOTH, 1, 0)
                if attached == 1:
                    through = 1

    return media_line_search
