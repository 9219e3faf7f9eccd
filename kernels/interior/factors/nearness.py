"""The weight of connections of volume vertices with surfaces that are near.

Derivation: ``docs/theory/media.md#what-moves``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.dispatch import has_chain_lobes
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.primitive.dispatch import make_geometric_normal, make_position
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import LightConfig, PathVertex, SurfaceConfig

#: By how much strips next to mirrors and glass are wider: a medium that they bound reaches them everywhere.
BORDER = 5.0


@wp.func
def weight_of_half(scene: Scene, vertex: PathVertex) -> wp.float32:
    """The weight chi of the connection by which a vertex was found, where D_n and what goes on are swept apart.

    It is where the other half keeps a weight that nobody reads.
    """
    return wp.where(vertex.light >= 0, vertex.inv_pdf, vertex.light_weight)


@functools.cache
def make_nearness(surfaces: SurfaceConfig, lights: LightConfig, geometry: bool = True):
    """Return ``nearness(scene, x, stretch, face, u, v) -> float32``.

    It is the weight chi of the connection of a volume vertex x with a surface, by its distance from the tangent plane;
    ``stretch``: the length of its stretch.
    """
    position, _cross_of = make_position(surfaces.primitives)
    normal_at = make_geometric_normal(surfaces.primitives)
    chains = has_chain_lobes(surfaces.bsdfs, True)
    has_delta = make_interaction(surfaces, lights).bsdf.has_delta

    @wp.func
    def nearness(
        scene: Scene, x: wp.vec3, stretch: wp.float32, face: wp.int32, u: wp.float32, v: wp.float32
    ) -> wp.float32:
        if wp.static(not geometry):
            return 1.0
        tri = scene.triangles[face]
        a = wp.abs(wp.dot(normal_at(scene, tri, u, v), position(tri, u, v) - x))
        rho = scene.contact_ratio * wp.min(scene.radii[face], stretch)
        if wp.static(chains):
            if has_delta(scene.bsdfs[scene.shapes[tri.shape].bsdf].model):
                rho *= BORDER
        if a >= rho:
            return 1.0
        t = a / rho
        return 3.0 * t * t

    return nearness
