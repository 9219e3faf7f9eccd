"""The radiance that arrives along a ray through media, for what the camera sees on either side of an edge.

It is that of the path tracer of ``path_media.py``; ``detector.py`` has that without media.

Derivation: ``docs/theory/media.md#boundaries-in-media``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.detector import IncidentRadiance
from warp_psdr.kernels.medium.line import make_line
from warp_psdr.kernels.path_media import make_media_step, media_path_from
from warp_psdr.kernels.primitive.dispatch import make_position
from warp_psdr.kernels.rng import Sampler
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import PathConfig, path_from


@functools.cache
def make_media_radiance(config: PathConfig):
    """Return ``media_radiance(scene, sampler, medium, o, d, t_max, max_depth, rr_depth) -> IncidentRadiance``.

    Its surface is the first one that is there.
    """
    line, _medium_at = make_line(config)
    media_step = make_media_step(config, False)
    position, _cross_of = make_position(config.primitives)

    @wp.func
    def media_radiance(
        scene: Scene,
        sampler: Sampler,
        medium: wp.int32,
        o: wp.vec3,
        d: wp.vec3,
        t_max: wp.float32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> IncidentRadiance:
        r = IncidentRadiance()
        seen = line(scene, o, d, t_max, medium, 0)
        r.face = seen.face
        if seen.face >= 0:
            r.x = position(scene.triangles[seen.face], seen.u, seen.v)
        state = media_path_from(path_from(o, d, t_max, 0), medium)
        while state.path.alive == 1:
            vertex, state = media_step(scene, sampler, state, max_depth, rr_depth)
            r.radiance += wp.cw_mul(vertex.surface.throughput, vertex.surface.direct)
        return r

    return media_radiance
