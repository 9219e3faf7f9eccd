"""Properties of what the camera sees first, as integrands: mask, depth, position and shading normal.

A path has one vertex, and its "radiance" is the property, 0 where the ray leaves the scene. All estimators of boundary
terms on the film take it as such. Depth is the distance along the ray from the near clip plane.

Derivation: ``docs/theory/interior.md#properties-of-surfaces``.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import LOBE_NONE
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.rng import Sampler
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.surface import VertexAdjoint
from warp_psdr.kernels.vertex import PathConfig, PathState, PathVertex
from warp_psdr.kernels.visibility import visibility_of

#: Properties with derivatives, by their names in Mitsuba's ``aov`` integrator.
PROPERTIES = ("mask", "depth", "position", "sh_normal")


@functools.cache
def make_property_step(config: PathConfig, traced: bool):
    """Return what ``make_path_step`` returns: the camera's first vertex, with the property in place of its radiance."""
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    surface_at = make_interaction(config.surfaces, config.lights).surface

    @wp.func
    def property_step(
        scene: Scene, sampler: Sampler, state: PathState, max_depth: wp.int32, rr_depth: wp.int32
    ) -> tuple[PathVertex, PathState]:
        if wp.static(traced):
            hit = state.seen
        else:
            hit = visibility.seen(scene, state.o, state.d, state.t_max, 0)
        vertex = PathVertex()
        vertex.face = hit.face
        vertex.u = hit.u
        vertex.v = hit.v
        vertex.previous_face = -1
        vertex.o = state.o
        vertex.d = state.d
        vertex.throughput = state.throughput
        vertex.light = -1
        vertex.lobe = LOBE_NONE
        if hit.face >= 0:
            if wp.static(config.shown == "mask"):
                vertex.direct = wp.vec3(1.0, 1.0, 1.0)
            elif wp.static(config.shown == "depth"):
                vertex.direct = wp.vec3(hit.t, hit.t, hit.t)
            else:
                surface = surface_at(scene, hit.face, hit.u, hit.v)
                vertex.direct = surface.x
                if wp.static(config.shown == "sh_normal"):
                    vertex.direct = surface.n
        return vertex, PathState()

    return property_step


@functools.cache
def make_property_vjp(shown: str):
    """Return ``property_vjp(d, a) -> (VertexAdjoint, vec3)``: adjoints of the vertex, and of where its ray starts.

    ``d`` is the ray's direction, ``a`` the adjoint of the three channels.
    """

    @wp.func
    def property_vjp(d: wp.vec3, a: wp.vec3) -> tuple[VertexAdjoint, wp.vec3]:
        adjoint = VertexAdjoint()
        a_o = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(shown == "depth"):
            # t = d . (x - o), and x moves along the ray; turning the ray leaves |d| at 1.
            adjoint.x = (a[0] + a[1] + a[2]) * d
            a_o = -adjoint.x
        if wp.static(shown == "position"):
            adjoint.x = a
        if wp.static(shown == "sh_normal"):
            adjoint.n = a
        return adjoint, a_o

    return property_vjp


@functools.cache
def make_beside_edge(shown: str):
    """Return ``(own, behind)``, properties beside an edge on the film.

    ``own(x, length) -> vec3``: of the point x of the edge itself, at that distance from the near clip plane. Beside a
    smooth silhouette a ray would meet the surface far in front of it.
    ``behind(value, face, length) -> vec3``: of what a ray meets that starts at that distance from it.
    """
    depth, position = shown == "depth", shown == "position"

    @wp.func
    def own(x: wp.vec3, length: wp.float32) -> wp.vec3:
        if wp.static(depth):
            return wp.vec3(length, length, length)
        if wp.static(position):
            return x
        return wp.vec3(1.0, 1.0, 1.0)

    @wp.func
    def behind(value: wp.vec3, face: wp.int32, length: wp.float32) -> wp.vec3:
        if wp.static(depth):
            if face >= 0:
                return value + wp.vec3(length, length, length)
        return value

    return own, behind
