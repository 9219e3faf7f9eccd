"""The adjoint of a chain's ray, carried back along the path that sent it.

As in the interior term (``interior/replay.py``), a point of the path is attached to the ray that found it if a camera
or a delta lobe sent that ray, and is a material point otherwise. This file is the backward sweep
(``interior/factors/sweep.py``) for one ray in place of a radiance. It ends at the camera, or at the first material
point whose predecessor does not matter.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.path_space.media_ride import make_along
from warp_psdr.kernels.constants import LOBE_SMOOTH
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.nearness import make_nearness
from warp_psdr.kernels.interior.factors.pullback import make_frame_vjp
from warp_psdr.kernels.interior.factors.sinks import make_material_sink
from warp_psdr.kernels.medium.interface import make_interface, make_interface_sink
from warp_psdr.kernels.primitive.dispatch import has_sliding, make_adjoint_sink, make_position, slides_on
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_sink
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint, make_vertex_sink, normalize_vjp
from warp_psdr.kernels.vertex import PathConfig


@wp.struct
class Visit:
    """A vertex of the path and the ray (o, d) that found it."""

    face: wp.int32
    u: wp.float32
    v: wp.float32
    o: wp.vec3
    d: wp.vec3
    lobe: wp.int32  # in which the path goes on
    attached: wp.int32  # 1: to that ray
    #: These describe a volume vertex, whose ``face``, u and v are those of the first surface behind it that is there.
    medium: wp.int32  # from one; 0: the vertex is on a surface
    x: wp.vec3
    stretch: wp.float32  # as of ``make_nearness``
    near: wp.float32  # distances at which its stretch of the ray begins and ends
    near_face: wp.int32  # -1: the stretch begins where the ray does
    near_u: wp.float32
    near_v: wp.float32
    far: wp.float32
    far_face: wp.int32  # -1: it has no end
    far_u: wp.float32
    far_v: wp.float32


@wp.struct
class Ridden:
    """What a volume vertex leaves of its adjoint for the ray on which it was found, or for where that ray starts."""

    o: wp.vec3
    d: wp.vec3
    dot: wp.float32


@functools.cache
def make_ride_visit(config: PathConfig, role: str, grids_move: bool):
    """Return ``ride_visit(scene, target, visit, g) -> Ridden`` for the adjoint g of a volume vertex.

    It keeps its fraction of its ray, which is attached to a camera or a delta lobe, or runs from the vertex before to
    the material point of the first surface behind (``docs/theory/media.md#what-moves``).
    """
    along = make_along(config.media, role, grids_move)
    accumulate_crossing = make_interface_sink(role, config.surfaces.primitives)
    accumulate_vertex = make_vertex_sink(role, False, False, False, False, False, False)
    is_interface, _behind = make_interface(config)
    position, _cross_of = make_position(config.surfaces.primitives)

    @wp.func
    def ride_visit(scene: Scene, target: wp.array(dtype=wp.float32), v: Visit, g: wp.vec3) -> Ridden:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        r = Ridden()
        t = wp.dot(v.x - v.o, v.d)
        rides = along(scene, target, v.medium - 1, v.x, v.d, t, v.near, v.far, g)
        r.o = rides.o
        r.d = rides.d
        r.dot = rides.dot
        a_far = rides.far
        if v.near_face >= 0:
            a = accumulate_crossing(scene, target, v.near_face, v.near_u, v.near_v, v.d, v.near, rides.near)
            r.o += a.o
            r.d += a.d
            r.dot += a.dot
        if v.far_face >= 0 and (v.attached == 1 or is_interface(scene, v.far_face)):
            a = accumulate_crossing(scene, target, v.far_face, v.far_u, v.far_v, v.d, v.far, a_far)
            r.o += a.o
            r.d += a.d
            r.dot += a.dot
            a_far = 0.0
        if v.attached == 0:
            if v.face >= 0:
                length = wp.length(position(scene.triangles[v.face], v.u, v.v) - v.o)
                adjoint = VertexAdjoint()
                adjoint.x = a_far * v.d + normalize_vjp(v.d, length, r.d)
                r.o -= adjoint.x
                r.dot += accumulate_vertex(scene, target, v.face, v.u, v.v, adjoint, False, v.d, v.d).dot
            r.d = wp.vec3(0.0, 0.0, 0.0)
        return r

    return ride_visit


@functools.cache
def make_chain_pullback(config: PathConfig, wanted: GradientRequest, role: str, grids_move: bool):
    """Return ``pull(scene, target, camera, sample, visits, last, start, o_before, a_o, a_d) -> float``.

    ``visits[:last + 1]`` is the path, (a_o, a_d) the adjoint of the ray that leaves its last vertex, ``start`` further
    adjoints of that vertex, and ``o_before`` one of the position before it. -1: the ray leaves the camera. The result
    is 0 in reverse mode and the derivative in forward mode.
    """
    interaction = make_interaction(config.surfaces, config.lights)
    scatter, scatter_vjp = interaction.scatter, interaction.scatter_vjp
    frame_vjp = make_frame_vjp(config.surfaces.tangent)
    accumulate_material = make_material_sink(config.surfaces, wanted, role)
    accumulate_vertex = make_adjoint_sink(
        role,
        config.surfaces.smooth,
        config.surfaces.flat,
        config.surfaces.uv,
        config.surfaces.tangent,
        wanted.texcoords,
        True,
        config.surfaces.primitives,
    )
    accumulate_camera = make_camera_sink(role, config.camera) if wanted.camera else None
    ride_visit = make_ride_visit(config, role, grids_move) if config.media is not None else None
    sliding = has_sliding(config.surfaces.primitives)
    nearness = make_nearness(config.surfaces, config.lights)

    @wp.func
    def pull(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        camera: Camera,
        sample: CameraSample,
        visits: wp.array(dtype=Visit),
        last: wp.int32,
        start: VertexAdjoint,
        o_before: wp.vec3,
        a_o_in: wp.vec3,
        a_d_in: wp.vec3,
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        total = wp.float32(0.0)
        a_o = a_o_in
        a_d = a_d_in
        adjoint = start
        before = o_before
        j = last
        more = wp.bool(True)
        while more and j >= 0:
            visit = visits[j]
            adjoint.x += a_o
            if wp.static(scatter_vjp is not None):
                if visit.lobe > LOBE_SMOOTH:
                    surface = interaction.surface(scene, visit.face, visit.u, visit.v)
                    wi_world = -visit.d
                    at = interaction.on(scene, surface, visit.face, visit.u, visit.v, visit.d)
                    frame = at.frame
                    zero = wp.vec3(0.0, 0.0, 0.0)
                    fa = scatter_vjp(at, visit.lobe, zero, enter_frame(frame, a_d))
                    wo = scatter(at, visit.lobe).wo
                    # The local direction leaves the frame: d = F wo, the transpose of entering it.
                    turned = frame_vjp(frame, surface.tangent, wi_world, a_d, fa.wi, wo)
                    adjoint.n = adjoint.n + frame.side * turned.n
                    adjoint.tangent = adjoint.tangent + turned.tangent
                    adjoint, dot = accumulate_material(
                        scene, target, at.slots, visit.face, visit.u, visit.v, surface.uv, fa.material, adjoint
                    )
                    total += dot
                    # wi = normalize(x_{j-1} - x_j).
                    a_x = normalize_vjp(wi_world, wp.length(visit.o - surface.x), turned.wi)
                    if wp.static(ride_visit is not None):
                        if visit.attached == 0:
                            y = visits[j - 1]
                            if y.medium > 0:
                                # As in the interior term: what is lost there is regained here.
                                a_x *= nearness(scene, y.x, y.stretch, visit.face, visit.u, visit.v)
                    adjoint.x = adjoint.x - a_x
                    before += a_x
            by_ray = visit.attached == 1
            rides = wp.bool(False)
            if wp.static(ride_visit is not None):
                rides = visit.medium > 0
                if rides:
                    ridden = ride_visit(scene, target, visit, adjoint.x)
                    total += ridden.dot
                    a_o = ridden.o
                    a_d = ridden.d
            tied = wp.bool(False)
            if wp.static(sliding):
                tied = not by_ray and slides_on(scene.triangles[visit.face])
            if not rides:
                accumulated = accumulate_vertex(
                    scene, target, visit.face, visit.u, visit.v, adjoint, by_ray or tied, visit.o, visit.d
                )
                total += accumulated.dot
                if wp.static(sliding):
                    if tied:
                        # It slides along a ray that is tied to the surface of the vertex before (form S).
                        start_of = visits[j - 1]
                        of_surface = VertexAdjoint()
                        of_surface.x = accumulated.o
                        moved = accumulate_vertex(
                            scene, target, start_of.face, start_of.u, start_of.v, of_surface, False, visit.o, visit.d
                        )
                        total += moved.dot
                        accumulated.o = wp.vec3(0.0, 0.0, 0.0)
                        accumulated.d = wp.vec3(0.0, 0.0, 0.0)
                a_o = before + accumulated.o
                a_d = accumulated.d
            more = wp.length_sq(a_o) + wp.length_sq(a_d) > 0.0
            adjoint = VertexAdjoint()
            before = wp.vec3(0.0, 0.0, 0.0)
            j -= 1
        if wp.static(wanted.camera):
            if more:
                total += accumulate_camera(scene, target, camera, sample, a_o, a_d)
        return total

    return pull
