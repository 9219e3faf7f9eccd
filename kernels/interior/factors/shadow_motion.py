"""Segments to lights through media while their ends move: the transmittance, and the point of the light.

Derivation: ``docs/theory/media.md#what-moves``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.constants import EMITTER_AREA, EMITTER_DIRECTIONAL, EMITTER_POINT, FAR, PHASE_SGGX
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.shadow_crossings import make_crossed_surface
from warp_psdr.kernels.medium.interface import make_interface_sink
from warp_psdr.kernels.medium.null_surface import make_null_surface
from warp_psdr.kernels.medium.passage import MOST_INTERFACES, medium_towards
from warp_psdr.kernels.path_media import MediaVertex
from warp_psdr.kernels.phase.sggx import flake_area_slope, flakes_of, make_extinction_along
from warp_psdr.kernels.primitive.dispatch import make_adjoint_sink
from warp_psdr.kernels.sink import make_sink, make_sink_vec3
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.surface import VertexAdjoint
from warp_psdr.kernels.vertex import LightConfig, PathConfig, SurfaceConfig


@wp.struct
class ShadowAdjoint:
    """Adjoint of the ray of a segment to a light: of its start, its direction and its length."""

    o: wp.vec3
    d: wp.vec3
    length: wp.float32
    dot: wp.float32


@functools.cache
def make_thinning(kinds: tuple[int, ...]):
    """Return ``(thinning, turning)`` for the kinds of phase functions of a scene.

    ``thinning(scene, medium, d, w) -> float32``: adjoint of a length along d in a medium, ``w`` as of
    ``make_shadow_sink``.
    ``turning(scene, medium, d, length, w) -> vec3``: adjoint of d, on which the extinction of microflakes depends.
    """
    extinction_along = make_extinction_along(kinds)

    @wp.func
    def thinning(scene: Scene, medium: wp.int32, d: wp.vec3, w: wp.vec3) -> wp.float32:
        if medium < 0:
            return 0.0
        return -wp.dot(extinction_along(scene, scene.media.records[medium], d).sigma_t, w)

    @wp.func
    def turning(scene: Scene, medium: wp.int32, d: wp.vec3, length: wp.float32, w: wp.vec3) -> wp.vec3:
        if medium >= 0 and length < FAR:
            m = scene.media.records[medium]
            if m.phase == PHASE_SGGX:
                return length * thinning(scene, medium, d, w) * flake_area_slope(flakes_of(scene, m.g), d)
        return wp.vec3(0.0, 0.0, 0.0)

    return thinning, turning


@functools.cache
def make_shadow_sink(config: PathConfig, role: str):
    """Return ``accumulate_shadow(scene, target, vertex, w) -> ShadowAdjoint``.

    ``w`` is the adjoint of the logarithm of the transmittance to the vertex's light, by channel. The segment is walked
    again.
    """
    shadow_crossing = make_crossed_surface(config.rays, config.surfaces.primitives)
    is_interface, past = make_null_surface(config.surfaces, config.lights)
    accumulate_crossing = make_interface_sink(role, config.surfaces.primitives)
    assert config.media is not None
    flakes = PHASE_SGGX in config.media.phases
    thinning, turning = make_thinning(config.media.phases)

    @wp.func
    def accumulate_shadow(
        scene: Scene, target: wp.array(dtype=wp.float32), v: MediaVertex, w: wp.vec3
    ) -> ShadowAdjoint:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        r = ShadowAdjoint()
        start = v.shadow_o
        inside = v.shadow_medium
        r.length = thinning(scene, inside, v.shadow_d, w)
        crossings = wp.int32(0)
        while crossings <= MOST_INTERFACES:
            t = wp.dot(start - v.shadow_o, v.shadow_d)
            hit = shadow_crossing(scene, v, crossings, start, v.shadow_t - t)
            crossings += 1
            if wp.static(flakes):
                rest = wp.where(hit.face >= 0, hit.t, v.shadow_t - t)
                r.d += turning(scene, inside, v.shadow_d, rest, w)
            if is_interface(scene, hit.face):
                at = past(scene, hit.face, hit.u, hit.v, v.shadow_d)
                inside = medium_towards(scene, at.shape, at.ng, v.shadow_d, v.shadow_d, inside)
                beyond = thinning(scene, inside, v.shadow_d, w)
                a = accumulate_crossing(scene, target, hit.face, hit.u, hit.v, v.shadow_d, t + hit.t, r.length - beyond)
                r.o += a.o
                r.d += a.d
                r.dot += a.dot
                r.length = beyond
                start = at.o
            else:
                crossings = MOST_INTERFACES + 1
        if v.shadow_t >= 0.5 * FAR:
            r.length = 0.0
        return r

    return accumulate_shadow


@functools.cache
def make_light_end_sink(surfaces: SurfaceConfig, lights: LightConfig, wanted: GradientRequest, role: str):
    """Return ``accumulate_end(scene, target, vertex, w) -> (bool, float32)``.

    ``w`` is the adjoint of the point of the vertex's light; False: the light has none.
    """
    accumulate_vertex = make_adjoint_sink(
        role, False, False, False, False, False, False, surfaces.primitives if lights.shining else ()
    )
    sink = make_sink(role)
    sink3 = make_sink_vec3(role)

    @wp.func
    def accumulate_end(
        scene: Scene, target: wp.array(dtype=wp.float32), v: MediaVertex, w: wp.vec3
    ) -> tuple[wp.bool, wp.float32]:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        emitter = scene.emitters[v.surface.light]
        total = wp.float32(0.0)
        if v.surface.light_face >= 0:
            if wp.static(wanted.geometry):
                adjoint = VertexAdjoint()
                adjoint.x = w
                done = accumulate_vertex(
                    scene, target, v.surface.light_face, v.surface.light_u, v.surface.light_v, adjoint, False, w, w
                )
                total = done.dot
            return True, total
        # An environment and a directional light are at infinity.
        if v.shadow_t >= 0.5 * FAR or emitter.kind == EMITTER_AREA or emitter.kind == EMITTER_DIRECTIONAL:
            return False, total
        if wp.static("pose" in wanted.lights):
            if emitter.kind == EMITTER_POINT:
                total = sink3(target, emitter.to_world, w)
            else:
                for i in range(3):
                    total += sink(target, emitter.to_world + 4 * i + 3, w[i])
        return True, total

    return accumulate_end
