"""Optical path lengths of the light that a path vertex sends to the camera.

Emission E_n and the next-event estimate D_n of a vertex arrive at different times, so they are kept apart. E_n has gone
ell_n = sum_{k <= n} eta_k |x_k - x_{k-1}|, with eta_k the index of refraction of the segment's medium. D_n has gone
ell_n + eta |y - x_n|, with the light point y.

Derivation: ``docs/theory/transient.md#lengths-of-paths``.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import EMITTER_AREA, EMITTER_POINT
from warp_psdr.kernels.emitter.spot import load_column
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.primitive.dispatch import make_point_at
from warp_psdr.kernels.reading import load_vec3
from warp_psdr.kernels.sensor.time_gate import TimeGates
from warp_psdr.kernels.structs import Emitter, Scene
from warp_psdr.kernels.vertex import LightConfig, PathVertex, SurfaceConfig


@wp.struct
class TimedVertex:
    """What a vertex sends, and how far it has gone [optical path length, world units]."""

    length: wp.float32  # ell_n
    segment: wp.float32  # factor of |x_n - x_{n-1}| in it: an index of refraction, or 0
    link: wp.float32  # eta |y - x_n|; 0: there is no light point
    eta: wp.float32
    emission: wp.vec3  # E_n, its MIS weight included
    direct: wp.vec3  # D_n, likewise


@wp.func
def lamp_position(scene: Scene, emitter: Emitter) -> wp.vec3:
    """Where a light without area is: a point light, a spot or a projector."""
    if emitter.kind == EMITTER_POINT:
        return load_vec3(scene.values, emitter.to_world)
    return load_column(scene.values, emitter.to_world, 3)


@functools.cache
def make_next_event_point(primitives: tuple[int, ...], area: tuple[int, ...]):
    """Return ``light_point(scene, vertex) -> vec3``: the light point that next-event estimation found."""
    point_at = make_point_at(primitives)

    @wp.func
    def light_point(scene: Scene, vertex: PathVertex) -> wp.vec3:
        emitter = scene.emitters[vertex.light]
        if wp.static(bool(area)):
            if emitter.kind == EMITTER_AREA:
                return point_at(scene, scene.triangles[vertex.light_face], vertex.light_u, vertex.light_v)
        return lamp_position(scene, emitter)

    return light_point


@functools.cache
def make_timed_vertex(surfaces: SurfaceConfig, lights: LightConfig):
    """Return ``timed_vertex(scene, gates, vertex, first, eta, before) -> TimedVertex``.

    ``first``: it is the one that the camera sees, and ``vertex.o`` where the camera's ray starts, unclipped. ``eta``:
    index of refraction in front of the vertex, ``before``: ell_{n-1}.
    """
    point_at = make_point_at(surfaces.primitives)
    light_point = make_next_event_point(surfaces.primitives, lights.area)
    emitted = make_interaction(surfaces, lights).emitted

    @wp.func
    def timed_vertex(
        scene: Scene, gates: TimeGates, vertex: PathVertex, first: wp.bool, eta: wp.float32, before: wp.float32
    ) -> TimedVertex:
        r = TimedVertex()
        r.length = before
        r.eta = eta
        if vertex.face < 0:
            return r
        r.segment = wp.where(first and gates.unwarp == 1, 0.0, eta)
        x = point_at(scene, scene.triangles[vertex.face], vertex.u, vertex.v)
        r.length += r.segment * wp.length(x - vertex.o)
        if wp.static(emitted is not None):
            if vertex.e_weight > 0.0:
                r.emission = vertex.e_weight * emitted(scene, vertex.face, vertex.u, vertex.v, vertex.d)
        if vertex.light >= 0:
            # Where both are there, what ``path.py`` added up.
            r.direct = vertex.direct - r.emission
            r.link = eta * wp.length(light_point(scene, vertex) - x)
        return r

    return timed_vertex
