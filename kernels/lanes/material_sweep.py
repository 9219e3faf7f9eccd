"""The backward sweep of ``sweep.py`` over paths side by side, for requests of material values alone.

All paths are swept from their n-th vertex to the one before together, from the last vertex down. This takes a few
products, after which the vertices have no order any more; they wait until they fill the lanes (``waiting_lanes.py``).
``place_lanes.py`` finds their points again; the radiance of the light that was drawn is kept. A model's adjoint is a
loop over all lanes, as its value is, unless the model branches (``model_lanes.py``). Delta lobes are differentiated
lane by lane, and gradients are added lane by lane, for two paths may meet the same material. A diffuse vertex is only a
few products, so diffuse materials are swept one path after the other, which is faster.
"""

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.bsdf.dispatch import is_diffuse
from warp_psdr.kernels.constants import LOBE_NONE, LOBE_SMOOTH
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.sinks import make_material_sink_of_each
from warp_psdr.kernels.invalid import count_invalid, finite
from warp_psdr.kernels.lanes.lanes import ROWS, stack_rows, word_of
from warp_psdr.kernels.lanes.model_lanes import make_adjoints_of_each
from warp_psdr.kernels.lanes.path_lanes import LanePaths
from warp_psdr.kernels.lanes.sweep_sinks import SweptPath, make_chosen
from warp_psdr.kernels.lanes.waiting_lanes import make_queue
from warp_psdr.kernels.math import where3
from warp_psdr.kernels.scattering import samples_lights
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint
from warp_psdr.kernels.vertex import PathConfig


@wp.struct
class RadianceCarry:
    """L_{n+1}."""

    radiance: wp.vec3


@wp.struct
class WeighedVertex:
    """A vertex that scatters, with the weights of its two scattering values in the gradient."""

    scatters: wp.int32  # 0: it does not, and is left out
    lane: wp.int32  # of its path
    face: wp.int32
    u: wp.float32
    v: wp.float32
    d: wp.vec3  # of the ray that found it
    lit: wp.int32  # 1: a light was found
    light_wi: wp.vec3
    light_w: wp.vec3
    lobe: wp.int32
    wo: wp.vec3
    w: wp.vec3


@wp.struct
class ScatteringWeight:
    """A direction that a vertex scatters to, and what its value is weighted by in the gradient."""

    wo: wp.vec3  # local
    w: wp.vec3


def sweeps_materials(config: PathConfig, wanted: GradientRequest) -> bool:
    """Whether the sweep serves a request: numbers of materials alone, of other than diffuse ones, under lights.

    Where all models branch, one path after the other is as fast.
    """
    models = [f for f in make_interaction(config.surfaces, config.lights).bsdf.each if f.eval is not None]
    if all(f.branches for f in models):
        return False
    others = wanted.geometry or wanted.to_uv or wanted.radiance or wanted.paired or bool(wanted.lights)
    return samples_lights(config.lights, config.surfaces.bsdfs) and not (
        others or config.through or config.surfaces.primitives or is_diffuse(config.surfaces.bsdfs)
    )


def make_material_sweep(config: PathConfig, wanted: GradientRequest, paths: LanePaths) -> tuple[int, wp.Function]:
    """Return the number of rows that it takes, and the function that sweeps the paths that ``paths`` has traced.

    ``sweep_all(scene, camera, target, scale, adjoint, count, always, rows)`` as of ``make_lane_sweep``.

    Args:
        config: what the scene needs.
        wanted: what is differentiated, see ``sweeps_materials``.
        paths: how its paths are traced; of their vertices the radiance is kept.
    """
    width, on_places, states, hits = paths.width, paths.on_places, paths.states, paths.hits
    places, choices, surfaces = on_places.places, on_places.choices, on_places.surfaces
    interaction = make_interaction(config.surfaces, config.lights)
    algebra = interaction.bsdf.algebra
    swept, carries, vertices, weights, adjoints = stack_rows(
        width, paths.end, SweptPath, RadianceCarry, WeighedVertex, ScatteringWeight, interaction.bsdf.record
    )
    queue = make_queue(width, (vertices,))
    scatters_row = vertices.first + word_of(WeighedVertex, "scatters")
    record = interaction.bsdf.record
    add_adjoints = make_adjoints_of_each(config.surfaces, config.lights, width, places, weights, adjoints)
    chosen = make_chosen(paths)
    accumulate_material = make_material_sink_of_each(config.surfaces, wanted)
    scatter_vjp = interaction.scatter_vjp
    has_delta = scatter_vjp is not None

    @wp.func
    def begin_sweep(
        scene: Scene,
        scale: wp.float32,
        adjoint: wp.array2d(dtype=wp.vec3),
        count: wp.int32,
        always: wp.int32,
        rows: ROWS,
    ) -> wp.int32:
        """Choose the paths; the most vertices that one of them has."""
        most = wp.int32(0)
        j = wp.int32(0)
        while j < width:
            path = SweptPath()
            if j < count:
                path = chosen(scene, scale, adjoint, j, always, rows)
                most = wp.max(most, path.vertices)
            swept.put(rows, j, path)
            carries.put(rows, j, RadianceCarry())
            j += 1
        return most

    @wp.func
    def weigh_vertices(n: wp.int32, rows: ROWS):
        """D_n and beta_n L_{n+1} of the n-th vertices; then L_n."""
        zero = wp.vec3(0.0, 0.0, 0.0)
        j = wp.int32(0)
        while j < width:
            vertex = paths.vertex(rows, j, n)
            path = swept.get(rows, j)
            carry = carries.get(rows, j)
            there = n < path.vertices
            on = there and vertex.face >= 0
            r = WeighedVertex()
            r.scatters = wp.where(on and (vertex.lobe != LOBE_NONE or vertex.light >= 0), 1, 0)
            r.lane = j
            r.face = vertex.face
            r.u = vertex.u
            r.v = vertex.v
            r.d = vertex.d
            r.lit = wp.where(vertex.light >= 0, 1, 0)
            r.light_wi = vertex.light_wi
            a_n = wp.cw_mul(path.delta, vertex.throughput)
            r.light_w = vertex.light_weight * wp.cw_mul(a_n, paths.light(rows, j, n).radiance)
            r.lobe = vertex.lobe
            r.wo = vertex.wo
            r.w = vertex.inv_pdf * wp.cw_mul(a_n, carry.radiance)
            vertices.put(rows, j, r)
            radiance = vertex.direct + wp.cw_mul(vertex.beta, carry.radiance)
            carry.radiance = where3(there, radiance, zero)
            carries.put(rows, j, carry)
            j += 1

    @wp.func
    def revisit(count: wp.int32, rows: ROWS):
        """The rays that found the vertices, and what they met."""
        j = wp.int32(0)
        while j < width:
            vertex = vertices.get(rows, j)
            state = states.get(rows, j)
            hit = hits.get(rows, j)
            state.alive = wp.where(j < count, 1, 0)
            state.d = vertex.d
            hit.face = wp.where(j < count, vertex.face, -1)
            hit.u = vertex.u
            hit.v = vertex.v
            states.put(rows, j, state)
            hits.put(rows, j, hit)
            j += 1

    @wp.func
    def clear_adjoints(rows: ROWS):
        j = wp.int32(0)
        while j < width:
            adjoints.put(rows, j, record())
            j += 1

    @wp.func
    def weigh_light(rows: ROWS):
        zero = wp.vec3(0.0, 0.0, 0.0)
        j = wp.int32(0)
        while j < width:
            vertex = vertices.get(rows, j)
            lit = choices.get(rows, j).on == 1 and vertex.lit == 1
            wo = enter_frame(places.get(rows, j).frame, vertex.light_wi)
            weight = ScatteringWeight()
            weight.wo = where3(lit, wo, wp.vec3(0.0, 0.0, 1.0))
            weight.w = where3(lit, vertex.light_w, zero)
            weights.put(rows, j, weight)
            j += 1

    @wp.func
    def weigh_onward(rows: ROWS):
        zero = wp.vec3(0.0, 0.0, 0.0)
        j = wp.int32(0)
        while j < width:
            vertex = vertices.get(rows, j)
            smooth = choices.get(rows, j).on == 1 and vertex.lobe == LOBE_SMOOTH
            wo = enter_frame(places.get(rows, j).frame, vertex.wo)
            weight = ScatteringWeight()
            weight.wo = where3(smooth, wo, wp.vec3(0.0, 0.0, 1.0))
            weight.w = where3(smooth, vertex.w, zero)
            weights.put(rows, j, weight)
            j += 1

    @wp.func
    def accumulate_adjoints(scene: Scene, target: wp.array(dtype=wp.float32), count: wp.int32, rows: ROWS):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        for j in range(count):
            at = places.get(rows, j)
            vertex = vertices.get(rows, j)
            a_material = adjoints.get(rows, j)
            if wp.static(has_delta):
                if vertex.lobe > LOBE_SMOOTH:
                    fa = scatter_vjp(at, vertex.lobe, vertex.w, wp.vec3(0.0, 0.0, 0.0))
                    a_material = algebra.add(a_material, fa.material)
            uv = surfaces.get(rows, j).uv
            _adjoint, lost = accumulate_material(
                scene, target, at.slots, vertex.face, vertex.u, vertex.v, uv, a_material, VertexAdjoint(), at.model
            )
            path = swept.get(rows, vertex.lane)
            path.lost += lost
            swept.put(rows, vertex.lane, path)

    @wp.func
    def sweep_waiting(scene: Scene, target: wp.array(dtype=wp.float32), front: wp.int32, count: wp.int32, rows: ROWS):
        """``count`` of the vertices that wait, from ``front`` on."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        queue.take(rows, front)
        revisit(count, rows)
        standing = on_places.meet(scene, rows)
        models = on_places.stand(scene, standing, rows)
        clear_adjoints(rows)
        half = wp.int32(0)
        while half < 2:  # one call of what is large
            if half == 0:
                weigh_light(rows)
            else:
                weigh_onward(rows)
            add_adjoints(models, standing, rows)
            half += 1
        accumulate_adjoints(scene, target, count, rows)

    @wp.func
    def sweep_all(
        scene: Scene,
        camera: Camera,
        target: wp.array(dtype=wp.float32),
        scale: wp.float32,
        adjoint: wp.array2d(dtype=wp.vec3),
        count: wp.int32,
        always: wp.int32,
        rows: ROWS,
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        n = begin_sweep(scene, scale, adjoint, count, always, rows)
        waiting = wp.int32(0)
        while n + waiting > 0:
            if n > 0:
                n -= 1
                weigh_vertices(n, rows)
                waiting = queue.append(rows, scatters_row, waiting)
            swept_now = wp.min(waiting, width)
            if swept_now == width or (n == 0 and swept_now > 0):
                waiting -= swept_now
                sweep_waiting(scene, target, waiting, swept_now, rows)
        for j in range(count):
            path = swept.get(rows, j)
            if path.vertices > 0 and (path.lost != 0.0 or not finite(carries.get(rows, j).radiance)):
                count_invalid(scene, paths.lane_samples.get(rows, j).sampler)

    return adjoints.end, sweep_all
