"""What the camera sees of a point of a curve on the film, and the radiance beside it, in media and without them.

In media both radiances start just in front of the point, times the transmittance up to there: what is scattered in
front of that is common to both sides.

Derivation: ``docs/theory/media.md#boundaries-in-media``.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.boundary.detector import IncidentRadiance, make_incident_radiance
from warp_psdr.kernels.boundary.forwards import make_hidden
from warp_psdr.kernels.boundary.media_radiance import make_media_radiance
from warp_psdr.kernels.medium.line import BEFORE, ClearLine, make_line
from warp_psdr.kernels.rng import Sampler
from warp_psdr.kernels.sensor.projection import FilmPoint
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig


class FilmSight(NamedTuple):
    """Functions of rays from the camera.

    Attributes:
        hidden: ``(scene, camera, sampler, start, at) -> bool``: whether anything is between the camera and a place.
        before: ``(scene, camera, sampler, at, d, length) -> ClearLine``: up to a distance from the near plane. Without
            media its transmittance is 1.
        radiance: ``(scene, sampler, medium, o, d, t_max, max_depth, rr_depth) -> IncidentRadiance``.
    """

    hidden: wp.Function
    before: wp.Function
    radiance: wp.Function


@functools.cache
def make_film_sight(config: PathConfig, inside: bool = True) -> FilmSight:
    """Return the functions; ``inside`` as of ``make_hidden``."""
    if config.media is None:
        return _sight_without_media(config, inside)
    line, _medium_at = make_line(config)

    @wp.func
    def hidden_in_media(scene: Scene, camera: Camera, sampler: Sampler, start: wp.vec3, at: FilmPoint) -> wp.bool:
        ray = start - at.origin
        length = wp.length(ray)
        if length <= at.near:
            return False
        ray = ray / length
        seen = line(scene, sampler, -1, at.origin + at.near * ray, ray, length - at.near, camera.medium, 0)
        return seen.face >= 0 or seen.lost

    @wp.func
    def before_in_media(
        scene: Scene, camera: Camera, sampler: Sampler, at: FilmPoint, d: wp.vec3, length: wp.float32
    ) -> ClearLine:
        return line(scene, sampler, BEFORE, at.origin + at.near * d, d, length, camera.medium, 0)

    return FilmSight(hidden_in_media, before_in_media, make_media_radiance(config))


def _sight_without_media(config: PathConfig, inside: bool) -> FilmSight:
    hidden_from = make_hidden(config.rays, config.surfaces.primitives, inside)
    incident_radiance = make_incident_radiance(config)

    @wp.func
    def hidden_before(scene: Scene, camera: Camera, sampler: Sampler, start: wp.vec3, at: FilmPoint) -> wp.bool:
        return hidden_from(scene, start, at.origin, at.near)

    @wp.func
    def clear_before(
        scene: Scene, camera: Camera, sampler: Sampler, at: FilmPoint, d: wp.vec3, length: wp.float32
    ) -> ClearLine:
        r = ClearLine()
        r.transmittance = wp.vec3(1.0, 1.0, 1.0)
        return r

    @wp.func
    def radiance_ahead(
        scene: Scene,
        sampler: Sampler,
        medium: wp.int32,
        o: wp.vec3,
        d: wp.vec3,
        t_max: wp.float32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> IncidentRadiance:
        return incident_radiance(scene, sampler, o, d, t_max, 0, max_depth, rr_depth)

    return FilmSight(hidden_before, clear_before, radiance_ahead)
