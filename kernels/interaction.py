"""The interaction of a ray with a surface: the point, its frame, its material and its scattering functions.

Every loop that meets surfaces uses this file (paths, walks towards the sensor, chains through mirrors and glass,
photons, edge sampling, the sweep, forward mode). ``make_interaction`` gives the record of the point and functions of
that record. What a scene does not need (dp/du, a second side, interpolated normals) is not compiled.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.bsdf.dispatch import BsdfFunctions, make_bsdf
from warp_psdr.kernels.emitter.area import make_area
from warp_psdr.kernels.generated import make_struct
from warp_psdr.kernels.material import make_material
from warp_psdr.kernels.math import aligned_tangent, any_tangent, to_local, to_world
from warp_psdr.kernels.measures import make_measures, measures_metric
from warp_psdr.kernels.primitive.dispatch import make_leaving, make_partials, make_surface_at
from warp_psdr.kernels.reading import bsdf_at, emitter_at, shape_at, triangle_at
from warp_psdr.kernels.step import step_beside
from warp_psdr.kernels.structs import BsdfSample, Scattered, Scene, Triangle
from warp_psdr.kernels.surface import Surface
from warp_psdr.kernels.vertex import LightConfig, SurfaceConfig


@wp.struct
class Frame:
    """Shading frame on the side of the incoming ray."""

    n: wp.vec3
    s: wp.vec3
    t: wp.vec3
    side: wp.float32  # +1, or -1 on the back of a two-sided material


@functools.cache
def make_interaction_record(material: type) -> type:
    """Return the Warp struct ``Interaction`` for a scene's record of material values.

    Its members: ``x`` the point, ``ng`` the unit geometric normal, ``frame``, ``wi`` the local direction towards where
    the ray came from, ``step`` by which rays leave the surface (world units), ``shape`` its number, ``model`` the
    number of the scattering model, ``slots`` where the numbers of the material's textures start, ``material`` its
    values. From ``model`` on it is what ``Scene.baked`` holds of every scattering record.
    """
    types = {
        "x": wp.vec3,
        "ng": wp.vec3,
        "frame": Frame,
        "wi": wp.vec3,
        "step": wp.float32,
        "shape": wp.int32,
        "model": wp.int32,
        "slots": wp.int32,
        "material": material,
    }
    name = "Interaction_" + material.key.rsplit(".", 1)[-1]
    return make_struct(name, types)


@functools.cache
def make_side(two_sided: bool):
    """Return ``side_of(scene, bsdf, behind) -> (side, scattering record of that side)``; ``behind``: at the back."""

    @wp.func
    def side_of(scene: Scene, bsdf: wp.int32, behind: wp.bool) -> tuple[wp.float32, wp.int32]:
        side = wp.float32(1.0)
        record = wp.int32(bsdf)
        if wp.static(two_sided):
            front = bsdf_at(scene, bsdf)
            back = behind and front.two_sided == 1
            side = wp.where(back, -1.0, 1.0)
            record = wp.where(back, front.back, bsdf)
        return side, record

    return side_of


@functools.cache
def make_framing(tangent: bool):
    """Return ``frame_on(side, n, dpdu) -> Frame``; ``tangent``: s follows dp/du, for anisotropic models."""

    @wp.func
    def frame_on(side: wp.float32, n: wp.vec3, dpdu: wp.vec3) -> Frame:
        f = Frame()
        f.side = side
        f.n = side * n
        if wp.static(tangent):
            f.s = aligned_tangent(f.n, dpdu)
        else:
            f.s = any_tangent(f.n)
        f.t = wp.cross(f.n, f.s)
        return f

    return frame_on


@wp.func
def enter_frame(frame: Frame, w: wp.vec3) -> wp.vec3:
    """Local coordinates of a world direction."""
    return to_local(frame.s, frame.t, frame.n, w)


@wp.func
def leave_frame(frame: Frame, w: wp.vec3) -> wp.vec3:
    """World direction of local coordinates."""
    return to_world(frame.s, frame.t, frame.n, w)


class InteractionParts(NamedTuple):
    """The steps of ``Interactions.at``, which paths side by side take one by one.

    Attributes:
        surface_of: ``(scene, tri, u, v) -> Surface``.
        surface_of_triangle: the same, ``tri`` a triangle.
        side_of: ``(scene, surface, behind) -> (side, number of the scattering record)``; ``behind``: the ray arrives at
            the back.
        complete: ``(scene, at: record, number, side, surface, face, u, v) -> record`` with those material values that
            vary over a surface, beside those of ``Scene.baked``. None: there are none.
        put_together: ``(scene, at: record, side, tri, surface, d) -> record`` with all but what ``Scene.baked`` has.
    """

    surface_of: wp.Function
    surface_of_triangle: wp.Function
    side_of: wp.Function
    complete: wp.Function | None
    put_together: wp.Function


class Interactions(NamedTuple):
    """The record of a point and its functions; ``at`` is a record, ``d`` the direction of the ray that found it.

    Attributes:
        record: the struct, see ``make_interaction_record``.
        bsdf: the scene's scattering functions.
        surface: ``(scene, face, u, v) -> Surface``: the differential geometry alone.
        at: ``(scene, face, u, v, d) -> record``.
        on: ``(scene, surface, face, u, v, d) -> record``, for whoever needs the surface as well.
        offset: ``(at, w) -> vec3``: where a ray with the world direction ``w`` starts.
        emitted: ``(scene, face, u, v, d) -> vec3``: radiance that the surface sends against ``d``; None: no surface is
            a light.
        sample: ``(at, u, v: vec2) -> BsdfSample``: draw a direction from any lobe.
        eval: ``(at, wo) -> vec3``: smooth lobes, f_s times the cosine, ``wo`` local. None: all are delta lobes.
        pdf: ``(at, wo) -> float32``: solid angle, of the smooth part of ``sample``.
        eval_vjp: ``(at, wo, w) -> adjoint``: gradient of ``dot(w, eval)``.
        scatter: ``(at, lobe) -> Scattered``: direction and weight of a delta lobe. None: there is none.
        scatter_vjp: ``(at, lobe, w, a_wo) -> adjoint``.
        parts: the steps of ``at``.
    """

    record: type
    bsdf: BsdfFunctions
    surface: wp.Function
    at: wp.Function
    on: wp.Function
    offset: wp.Function
    emitted: wp.Function | None
    sample: wp.Function
    eval: wp.Function | None
    pdf: wp.Function | None
    eval_vjp: wp.Function | None
    scatter: wp.Function | None
    scatter_vjp: wp.Function | None
    parts: InteractionParts


@functools.cache
def make_parts(surfaces: SurfaceConfig, record: type) -> InteractionParts:
    """Return the steps that make a ``record`` of the scene's interactions."""
    surface_of = make_surface_at(surfaces.smooth, surfaces.flat, surfaces.uv, surfaces.tangent, surfaces.primitives)
    step_off = make_leaving(surfaces.primitives)
    side_of_record = make_side(surfaces.two_sided)
    frame_on = make_framing(surfaces.tangent)

    @wp.func
    def side_of(scene: Scene, surface: Surface, behind: wp.bool) -> tuple[wp.float32, wp.int32]:
        side, number = side_of_record(scene, shape_at(scene, surface.shape).bsdf, behind)
        return side, number

    @wp.func
    def put_together(scene: Scene, at: record, side: wp.float32, tri: Triangle, surface: Surface, d: wp.vec3) -> record:
        at.x = surface.x
        at.ng = surface.ng
        at.frame = frame_on(side, surface.n, surface.tangent)
        at.wi = enter_frame(at.frame, -d)
        at.step = step_off(scene, tri)
        at.shape = surface.shape
        return at

    of_triangle = make_surface_at(surfaces.smooth, surfaces.flat, surfaces.uv, surfaces.tangent, ())
    return InteractionParts(surface_of, of_triangle, side_of, _make_complete(surfaces, record), put_together)


@functools.cache
def _make_measure(surfaces: SurfaceConfig, record: type) -> wp.Function | None:
    """Return ``measure(scene, at: record, side, surface, face, u, v) -> record``: values that the geometry gives."""
    measured = make_measures(surfaces.bsdfs, surfaces.material)
    if measured is None:
        return None
    partials, frame_on = make_partials(surfaces.primitives), make_framing(surfaces.tangent)

    @wp.func
    def measure(
        scene: Scene, at: record, side: wp.float32, surface: Surface, face: wp.int32, u: wp.float32, v: wp.float32
    ) -> record:
        metric = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(measures_metric(surfaces.material)):
            frame = frame_on(side, surface.n, surface.tangent)
            dp_du, dp_dv = partials(scene, triangle_at(scene, face), u, v)
            metric = wp.vec3(wp.dot(dp_du, frame.s), wp.dot(dp_dv, frame.s), wp.dot(dp_dv, frame.t))
        at.material = measured(at.material, side, metric)
        return at

    return measure


def _make_complete(surfaces: SurfaceConfig, record: type) -> wp.Function | None:
    """Return ``complete`` of ``InteractionParts``."""
    varied_at = make_material(surfaces.bsdfs, surfaces.material, surfaces.primitives, varied=True)
    measure = _make_measure(surfaces, record)
    if varied_at is None and measure is None:
        return None

    @wp.func
    def complete(
        scene: Scene,
        at: record,
        number: wp.int32,
        side: wp.float32,
        surface: Surface,
        face: wp.int32,
        u: wp.float32,
        v: wp.float32,
    ) -> record:
        if wp.static(varied_at is not None):
            if bsdf_at(scene, number).varied == 1:
                at.material = varied_at(scene, at.material, at.slots, face, u, v, surface.uv)
        if wp.static(measure is not None):
            at = measure(scene, at, side, surface, face, u, v)
        return at

    return complete


@functools.cache
def make_interaction(surfaces: SurfaceConfig, lights: LightConfig, selects: bool = False) -> Interactions:
    """Return the record of a scene's interactions and its functions; ``selects``: as ``make_bsdf``'s."""
    bsdf = make_bsdf(surfaces.bsdfs, selects)
    record = make_interaction_record(bsdf.record)
    parts = make_parts(surfaces, record)
    surface_of, side_of, put_together = parts.surface_of, parts.side_of, parts.put_together
    material_at = make_material(surfaces.bsdfs, surfaces.material, surfaces.primitives)
    measure = _make_measure(surfaces, record)
    emission = make_area(lights.area, lights.shining).emitted if lights.area else None

    @wp.func
    def surface_at(scene: Scene, face: wp.int32, u: wp.float32, v: wp.float32) -> Surface:
        return surface_of(scene, triangle_at(scene, face), u, v)

    @wp.func
    def interaction_of(
        scene: Scene, tri: Triangle, surface: Surface, face: wp.int32, u: wp.float32, v: wp.float32, d: wp.vec3
    ) -> record:
        side, number = side_of(scene, surface, wp.dot(surface.n, -d) < 0.0)
        b = bsdf_at(scene, number)
        at = record()
        at.model = b.model
        at.slots = b.slots
        at.material = material_at(scene, at.material, b.slots, face, u, v, surface.uv)
        if wp.static(measure is not None):
            at = measure(scene, at, side, surface, face, u, v)
        return put_together(scene, at, side, tri, surface, d)

    @wp.func
    def interaction_on(
        scene: Scene, surface: Surface, face: wp.int32, u: wp.float32, v: wp.float32, d: wp.vec3
    ) -> record:
        return interaction_of(scene, triangle_at(scene, face), surface, face, u, v, d)

    @wp.func
    def interaction_at(scene: Scene, face: wp.int32, u: wp.float32, v: wp.float32, d: wp.vec3) -> record:
        tri = triangle_at(scene, face)
        return interaction_of(scene, tri, surface_of(scene, tri, u, v), face, u, v, d)

    @wp.func
    def sample(at: record, u: wp.float32, v: wp.vec2) -> BsdfSample:
        return bsdf.sample(at.model, at.material, at.wi, u, v)

    @wp.func
    def offset(at: record, d: wp.vec3) -> wp.vec3:
        return step_beside(at.x, at.ng, d, at.step)

    smooth = _make_smooth(bsdf, record) if bsdf.eval is not None else (None, None, None)
    delta = _make_delta(bsdf, record) if bsdf.scatter is not None else (None, None)
    emitted = _make_emitted(emission) if emission is not None else None
    return Interactions(
        record, bsdf, surface_at, interaction_at, interaction_on, offset, emitted, sample, *smooth, *delta, parts
    )


def _make_smooth(bsdf: BsdfFunctions, record: type) -> tuple[wp.Function, wp.Function, wp.Function]:
    adjoint = bsdf.adjoint

    @wp.func
    def eval_at(at: record, wo: wp.vec3) -> wp.vec3:
        return bsdf.eval(at.model, at.material, at.wi, wo)

    @wp.func
    def pdf_at(at: record, wo: wp.vec3) -> wp.float32:
        return bsdf.pdf(at.model, at.material, at.wi, wo)

    @wp.func
    def eval_vjp_at(at: record, wo: wp.vec3, w: wp.vec3) -> adjoint:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        return bsdf.eval_vjp(at.model, at.material, at.wi, wo, w)

    return eval_at, pdf_at, eval_vjp_at


def _make_delta(bsdf: BsdfFunctions, record: type) -> tuple[wp.Function, wp.Function]:
    adjoint = bsdf.adjoint

    @wp.func
    def scatter_at(at: record, lobe: wp.int32) -> Scattered:
        return bsdf.scatter(at.model, at.material, at.wi, lobe)

    @wp.func
    def scatter_vjp_at(at: record, lobe: wp.int32, w: wp.vec3, a_wo: wp.vec3) -> adjoint:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        return bsdf.scatter_vjp(at.model, at.material, at.wi, lobe, w, a_wo)

    return scatter_at, scatter_vjp_at


def _make_emitted(emission: wp.Function) -> wp.Function:
    @wp.func
    def emitted_at(scene: Scene, face: wp.int32, u: wp.float32, v: wp.float32, d: wp.vec3) -> wp.vec3:
        light = shape_at(scene, triangle_at(scene, face).shape).emitter
        radiance = wp.vec3(0.0, 0.0, 0.0)
        if light >= 0:
            radiance = emission(scene, emitter_at(scene, light), face, u, v, d)
        return radiance

    return emitted_at
