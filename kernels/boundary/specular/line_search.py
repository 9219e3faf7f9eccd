"""Discontinuities seen through mirrors and glass, by searching along lines.

Edges seen through a mirror cannot be sampled directly. A line starts at q0 in a uniform direction e, and each of its
crossings s with a discontinuity phi = 0 adds 2 phi_s (F_high - F_low) phi' / (|grad phi|^2 ell p(q0)) (Crofton's
formula). A random path down a tree of halved cells loses no crossing.

Derivation: ``docs/theory/specular.md#searching-along-lines``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.detector import NEVER
from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.kernels.boundary.specular.chain_pullback import Visit
from warp_psdr.kernels.boundary.specular.line_crossing import Line, make_line_sink
from warp_psdr.kernels.boundary.specular.specular_chain import (
    GO_ON,
    MAX_CHAIN,
    MAX_WINDOW,
    Block,
    film_point,
    make_identity,
    make_start,
    step_from,
)
from warp_psdr.kernels.boundary.specular.triangle_borders import Tables, may_meet_mirrors
from warp_psdr.kernels.constants import INV_FOUR_PI, LOBE_SMOOTH, TWO_PI
from warp_psdr.kernels.interaction import enter_frame, leave_frame, make_interaction
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.math import any_tangent
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path import make_path_step
from warp_psdr.kernels.rng import Sampler, make_sampler, sampler_at
from warp_psdr.kernels.sampling import square_to_sphere
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_ray, make_lens
from warp_psdr.kernels.sensor.film import filter_margin
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, path_from

#: Lengths of a line: pixels on the film, radians at a vertex.
FILM_LENGTH, ARC_LENGTH = 2.0, 1.0
#: Root cells of a line on the film and of an arc; both divide the finest resolution.
FILM_CELLS, ARC_CELLS = 8, 8
#: Cells of the finest resolution: an arc's are 10^-6 rad, some 16 float32 steps of a direction.
RESOLUTION = 1 << 20
#: Levels of the tree below its roots at which hidden crossings are looked for. Lines that cut off a corner hide pairs
#: with a density constant in their width w, found with probability w: the variance grows by the same amount at each
#: level, without end. Pairs narrower than 2^-12 of a cell, 10^-4 pixels or radians, are left out.
LEVELS = 12
#: Right ends of cells that wait: a cell's halves, down to the finest, and a line's roots.
STACK = 40
#: Share of the lines at a vertex that start in a uniform direction; the others follow the scattering function. Lines
#: have to start also below the horizon, from where they reach above it.
UNIFORM_SHARE = 0.25
#: Sample slots of a search, behind those of the path up to where it starts.
SLOT_SEARCH = 1000
#: Slots of one search; the last of the first one's is the lens's.
SLOTS_PER_SEARCH = 64
SLOT_LENS = SLOT_SEARCH + SLOTS_PER_SEARCH - 1
#: Vertices that are kept of a path with a chain.
MAX_VISITS = MAX_WINDOW + MAX_CHAIN


@functools.cache
def make_search(config: PathConfig, wanted: GradientRequest, role: str, light_pose: bool, grids_move: bool):
    """Return ``search(scene, camera, edges, tables, block, line, cells, visits, sampler, adjoint, target, image)``.

    It adds the crossings of one line, which has so many root ``cells``. Arguments are those of the kernel below.
    """
    start_at = make_start(config.camera)
    identity = make_identity(config)
    accumulate_crossings = make_line_sink(config, wanted, role, light_pose, grids_move)
    sample_1d = make_sampler(config.sampler).sample_1d

    @wp.func
    def name_at(
        scene: Scene, camera: Camera, tables: Tables, block: Block, s: wp.float32, max_depth: wp.int32
    ) -> wp.uint32:
        """The identity; 1 without tracing a ray that meets no mirror, where the first segment is others'."""
        if block.first == 0:
            ray = start_at(scene, camera, block, s)
            if not may_meet_mirrors(tables, ray.o, ray.d):
                return wp.uint32(1)
        return identity(scene, camera, tables.group, tables.interpolated, tables.steps, block, s, max_depth, 0)

    @wp.func
    def search(
        scene: Scene,
        camera: Camera,
        edges: Edges,
        tables: Tables,
        block: Block,
        line: Line,
        cells: wp.int32,
        visits: wp.array(dtype=Visit),
        sampler: Sampler,
        adjoint: wp.array2d(dtype=wp.vec3),
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        max_depth = line.max_depth
        # Right ends of the cells to visit, the next one on top.
        ends = wp.zeros(shape=(STACK,), dtype=wp.int32)
        names = wp.zeros(shape=(STACK,), dtype=wp.uint32)
        top = wp.int32(0)
        unit = 1.0 / wp.float32(RESOLUTION)
        for k in range(cells):
            ends[top] = (RESOLUTION // cells) * (cells - k)
            names[top] = name_at(scene, camera, tables, block, unit * wp.float32(ends[top]), max_depth)
            top += 1
        left = wp.int32(0)
        left_name = name_at(scene, camera, tables, block, 0.0, max_depth)
        # The path down the tree: its cell starts as a random root.
        cell = wp.int32(sample_1d(sampler, line.slot) * wp.float32(cells))
        lower = cell * (RESOLUTION // cells)
        size = RESOLUTION // cells
        lower_name = left_name
        if cell > 0:
            lower_name = names[cells - cell]
        upper_name = names[cells - 1 - cell]
        chance = 1.0 / wp.float32(cells)
        weight = wp.float32(1.0)
        level = wp.int32(0)
        active = wp.bool(True)
        while active:
            # All crossings of the cells that wait.
            while top > 0:
                end = ends[top - 1]
                name = names[top - 1]
                if name == left_name:
                    left = end
                    top -= 1
                elif end - left > 1:
                    middle = (left + end) // 2
                    ends[top] = middle
                    names[top] = name_at(scene, camera, tables, block, unit * wp.float32(middle), max_depth)
                    top += 1
                else:
                    low = unit * wp.float32(left)
                    high = unit * wp.float32(end)
                    left = end
                    left_name = name
                    top -= 1
                    accumulate_crossings(
                        scene, camera, edges, tables, block, line, low, high, weight, visits, sampler,
                        adjoint, target, image_out,
                    )  # fmt: skip
            # One cell further down.
            active = level < LEVELS
            if active:
                u = sample_1d(sampler, line.slot + 1 + level)
                half = size // 2
                name = name_at(scene, camera, tables, block, unit * wp.float32(lower + half), max_depth)
                if lower_name == upper_name and name != lower_name:
                    left = lower
                    left_name = lower_name
                    ends[0] = lower + size
                    names[0] = upper_name
                    ends[1] = lower + half
                    names[1] = name
                    top = 2
                    weight = 1.0 / chance
                chance *= 0.5
                size = half
                if u < 0.5:
                    upper_name = name
                else:
                    lower += half
                    lower_name = name
                level += 1
        return

    return search


@functools.cache
def make_film_line(camera_kind: int, sampler_kind: str):
    """Return ``film_line(camera, job, number, sampler) -> (Block, Line)``: a line on the film, and its path's camera.

    The throughput of the Line is what all of the path's lines are scaled with.
    """
    lens_point = make_lens(camera_kind)
    draw = make_sampler(sampler_kind)
    sample_2d = draw.sample_2d
    sample_4d = draw.sample_4d

    @wp.func
    def film_line(camera: Camera, job: SampleJob, number: wp.int32, sampler: Sampler) -> tuple[Block, Line]:
        u4 = sample_4d(sampler, 0)
        # A point of the film, and of its surroundings as far as lines and filter reach; stratified over the pixels.
        margin = filter_margin(camera) + FILM_LENGTH
        width = wp.float32(camera.crop_width) + 2.0 * margin
        height = wp.float32(camera.crop_height) + 2.0 * margin
        pixels = camera.crop_width * camera.crop_height
        stratum = number % pixels
        column = wp.float32(stratum % camera.crop_width) + u4[0]
        row = wp.float32(stratum // camera.crop_width) + u4[1]
        if number >= (job.samples // pixels) * pixels:
            column = u4[0] * wp.float32(camera.crop_width)
            row = u4[1] * wp.float32(camera.crop_height)
        q = wp.vec2(
            column * width / wp.float32(camera.crop_width) - margin,
            row * height / wp.float32(camera.crop_height) - margin,
        )
        sample = CameraSample()
        sample.film = film_point(camera, q)
        sample.lens = lens_point(sample_2d(sampler, SLOT_LENS))
        scale = width * height / wp.float32(job.samples)
        pattern = wp.uint32(0)
        for k in range(4):
            bits = sample_4d(sampler, SLOT_SEARCH + k)
            for j in range(4):
                if bits[j] < GO_ON:
                    pattern = pattern | (wp.uint32(1) << wp.uint32(4 * k + j))
        block = Block()
        block.film = 1
        block.q0 = q
        block.e = wp.vec2(wp.cos(TWO_PI * u4[2]), wp.sin(TWO_PI * u4[2]))
        block.lens = sample.lens
        block.ell = FILM_LENGTH
        block.pattern = pattern
        block.medium = camera.medium
        block.shape = -1
        line = Line()
        line.throughput = wp.vec3(scale, scale, scale)
        line.camera = sample
        line.q = q
        line.slot = SLOT_SEARCH + 4
        line.max_depth = wp.where(job.max_depth < 0, NEVER, job.max_depth)
        line.rr_depth = job.rr_depth
        return block, line

    return film_line


@functools.cache
def make_line_search_kernel(config: PathConfig, wanted: GradientRequest, role: str, light_pose: bool):
    """Return the kernel of the boundary term through mirrors and glass: one thread a path.

    Arguments are those of ``path_space/secondary.py``. In media it is that of ``media_line_search.py``.
    """
    camera_ray, _camera_origin = make_camera_ray(config.camera)
    film_line = make_film_line(config.camera, config.sampler)
    search = make_search(config, wanted, role, light_pose, False)
    path_step = make_path_step(config, False)
    interaction = make_interaction(config.surfaces, config.lights)
    has_smooth = interaction.eval is not None
    sample_4d = make_sampler(config.sampler).sample_4d

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def line_search(
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
        visits = wp.zeros(shape=(MAX_VISITS,), dtype=Visit)
        block, line = film_line(camera, job, number, sampler)
        search(
            scene, camera, edges, tables, block, line, FILM_CELLS, visits, sampler, job.image_adjoint, target, image_out
        )
        if wp.static(has_smooth):
            scale = line.throughput[0]
            ray = camera_ray(scene, camera, line.camera)
            state = path_from(ray.o + ray.t_min * ray.d, ray.d, ray.t_max - ray.t_min, 0)
            depth = wp.int32(0)
            count = wp.int32(0)  # of the vertices that are kept
            lost = wp.int32(0)  # 1: not all of them are
            slot = line.slot
            through = wp.int32(0)  # 1: a mirror or glass came before
            attached = wp.int32(1)
            while state.alive == 1 and depth + 2 <= line.max_depth:
                before = state.o
                vertex, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
                slot += SLOTS_PER_SEARCH
                visit = Visit()
                visit.face = vertex.face
                visit.u = vertex.u
                visit.v = vertex.v
                visit.o = wp.where(depth == 0, ray.o, before)
                visit.d = vertex.d
                visit.lobe = vertex.lobe
                visit.attached = attached
                depth += 1
                if count == MAX_WINDOW:
                    lost = 1
                    visits[count - 2] = visits[count - 1]
                    count -= 1
                visits[count] = visit
                count += 1
                if attached == 0 and vertex.lobe <= LOBE_SMOOTH and count > 2:
                    # A material point: nothing is pulled back past it, but for what it slides along (form S).
                    visits[0] = visits[count - 2]
                    visits[1] = visit
                    count = 2
                    lost = 0
                if vertex.face >= 0:
                    g = interaction.at(scene, vertex.face, vertex.u, vertex.v, vertex.d)
                    if interaction.bsdf.has_smooth(g.model) and lost == 0:
                        v4 = sample_4d(sampler, slot)
                        w0 = square_to_sphere(wp.vec2(v4[1], v4[2]))
                        found = wp.bool(True)
                        if v4[0] >= UNIFORM_SHARE:
                            again = (v4[0] - UNIFORM_SHARE) / (1.0 - UNIFORM_SHARE)
                            bs = interaction.sample(g, again, wp.vec2(v4[1], v4[2]))
                            w0 = leave_frame(g.frame, bs.wo)
                            found = not (bs.pdf <= 0.0) and bs.lobe == LOBE_SMOOTH
                        density = interaction.pdf(g, enter_frame(g.frame, w0))
                        pdf = UNIFORM_SHARE * INV_FOUR_PI + (1.0 - UNIFORM_SHARE) * density
                        if found:
                            side = any_tangent(w0)
                            angle = TWO_PI * v4[3]
                            from_y = Block()
                            from_y.x = g.x
                            from_y.n = g.ng
                            from_y.step = step_from(scene, vertex.face, g.step)
                            from_y.w0 = w0
                            from_y.w1 = wp.cos(angle) * side + wp.sin(angle) * wp.cross(w0, side)
                            from_y.ell = ARC_LENGTH
                            from_y.depth = depth
                            from_y.pattern = block.pattern
                            from_y.first = through
                            line.throughput = (scale / pdf) * vertex.throughput
                            line.count = count
                            line.slot = slot + 1
                            search(
                                scene, camera, edges, tables, from_y, line, ARC_CELLS, visits, sampler,
                                job.image_adjoint, target, image_out,
                            )  # fmt: skip
                    attached = wp.where(vertex.lobe > LOBE_SMOOTH, 1, 0)
                    if attached == 1:
                        through = 1

    return line_search
