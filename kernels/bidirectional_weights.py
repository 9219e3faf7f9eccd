"""Weights of bidirectional paths: the balance heuristic over all edges at which a path may be cut in two.

A path x_0 ... x_k, y from the camera to a light may be cut at the edge x_m x_(m+1): the camera draws the front part,
and the light the back part. The density of one cut over that of the next is a quotient of local densities. Both
subpaths therefore carry the sum of these quotients over all cuts behind them, as two numbers ``near`` and ``far``
[Vea97, section 10.2.1]. Russian roulette is left out of the densities, because weights only need to add up to one.

Derivation: ``docs/theory/light_tracing.md#all-cuts-of-a-path``.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import (
    EMITTER_CONSTANT,
    EMITTER_DIRECTIONAL_AREA,
    EMITTER_ENVMAP,
    EMITTER_POINT,
    EMITTER_PROJECTOR,
    EMITTER_SPOT,
    EMITTER_TEXTURED_SPOT,
    FOUR_PI,
    PI,
    SPOTS,
    TWO_PI,
)
from warp_psdr.kernels.emitter.area import area_density, pdf_area
from warp_psdr.kernels.emitter.directionalarea import covers
from warp_psdr.kernels.emitter.dispatch import make_lights
from warp_psdr.kernels.emitter.spot import load_column
from warp_psdr.kernels.light_ray import COVER, LightRay, cone_height
from warp_psdr.kernels.reading import emitter_at, shape_at, texture_record, triangle_at
from warp_psdr.kernels.sensor.camera import half_width
from warp_psdr.kernels.structs import Emitter, Scene
from warp_psdr.kernels.vertex import LightConfig, PathState

#: Cosines count as no less where one is divided by, as light paths do (``light_path.py``).
LEAST_COSINE = 1.0e-6
#: The sums count as no more, so that their products with 0 are 0.
MOST = 1.0e30


@wp.struct
class Cuts:
    """Sums over the cuts behind a vertex, relative to the cut in front of it.

    ``near``: the cut right behind it, without the vertex's own densities; ``far``: all others, without the density of
    the direction back.
    """

    near: wp.float32
    far: wp.float32


@wp.func
def cuts_at(near: wp.float32, far: wp.float32, cosine: wp.float32) -> Cuts:
    """The sums at a vertex that is met with the given cosine."""
    inverse = 1.0 / wp.max(cosine, LEAST_COSINE)
    return Cuts(wp.min(near * inverse, MOST), wp.min(far * inverse, MOST))


@wp.func
def cuts_of(cuts: Cuts, back: wp.float32, leaving: wp.float32) -> wp.float32:
    """Sum at a vertex that the path leaves with a cosine; ``back``: density of the direction back, from the other side.

    Times a density, per solid angle from the next vertex and steradian there, it compares with that of the direction.
    """
    return wp.min((cuts.near + cuts.far * back) * leaving, MOST)


@wp.func
def covering_disk(scene: Scene) -> wp.float32:
    """Area of the disk that rays from infinity start on."""
    radius = wp.static(0.5 * (1.0 + COVER)) * scene.media.extent
    return PI * radius * radius


@wp.func
def frame_density(scene: Scene, light: Emitter, d: wp.vec3) -> wp.float32:
    """Density per solid angle with which a projector's rays take the direction d, of ``light_ray.in_frame``."""
    texture = texture_record(scene, light.texture)
    aspect = wp.float32(wp.max(texture.width, 1)) / wp.float32(wp.max(texture.height, 1))
    t = half_width(scene.values[light.cutoff])
    x_axis = load_column(scene.values, light.to_world, 0)
    y_axis = load_column(scene.values, light.to_world, 1)
    z_axis = load_column(scene.values, light.to_world, 2)
    across = wp.cross(x_axis, y_axis)
    volume = wp.abs(wp.dot(across, z_axis))
    length = volume / wp.max(wp.abs(wp.dot(across, d)), 1.0e-12 * volume)
    return aspect * length * length * length / (4.0 * t * t * volume)


@functools.cache
def make_emission_density(lights: LightConfig):
    """Return ``emission_density(scene, index, face, distance, towards, pdf, x) -> float32``.

    The density of a light's rays with which a light path meets x, per unit of area across the ray: the inverse of
    ``radiance_scale``. ``towards``: unit, from x to the light; ``pdf``: of that direction, without the selection.
    """
    kinds = set(lights.others)

    @wp.func
    def density_from(
        scene: Scene, light: Emitter, distance: wp.float32, d: wp.vec3, pdf: wp.float32, x: wp.vec3
    ) -> wp.float32:
        density = pdf / covering_disk(scene)
        if wp.static(EMITTER_POINT in kinds):
            if light.kind == EMITTER_POINT:
                density = 1.0 / (FOUR_PI * distance * distance)
        if wp.static(bool(SPOTS & kinds)):
            if light.kind == EMITTER_SPOT or light.kind == EMITTER_TEXTURED_SPOT:
                density = 1.0 / (TWO_PI * cone_height(scene, light) * distance * distance)
        if wp.static(EMITTER_PROJECTOR in kinds):
            if light.kind == EMITTER_PROJECTOR:
                density = frame_density(scene, light, d) / (distance * distance)
        if wp.static(EMITTER_DIRECTIONAL_AREA in kinds):
            if light.kind == EMITTER_DIRECTIONAL_AREA:
                density = wp.float32(0.0)
                for k in range(light.face_count):
                    tri = triangle_at(scene, light.first_face + k)
                    if density == 0.0 and covers(tri, x):
                        area = 0.5 * wp.length(wp.cross(tri.p1 - tri.p0, tri.p2 - tri.p0))
                        density = 1.0 / (area * wp.float32(light.face_count))
        return density

    @wp.func
    def emission_density(
        scene: Scene,
        index: wp.int32,
        face: wp.int32,
        distance: wp.float32,
        towards: wp.vec3,
        pdf: wp.float32,
        x: wp.vec3,
    ) -> wp.float32:
        light = emitter_at(scene, index)
        density = wp.float32(0.0)
        if wp.static(bool(lights.area)):
            if face >= 0:
                density = area_density(scene, light, face) / PI
        if wp.static(bool(kinds)):
            if face < 0:
                density = density_from(scene, light, distance, -towards, pdf, x)
        return density * light.probability

    return emission_density


@functools.cache
def make_hit_weight(lights: LightConfig, through: bool):
    """Return ``hit_weight(scene, path, hit, far) -> float32`` of light that a path from the camera hits.

    ``far``: the sum that its last vertex left.
    """
    others = make_lights(lights.others, None, ()) if lights.others else None
    environment_pdf = others.environment_pdf if others else None

    @wp.func
    def hit_weight(scene: Scene, path: PathState, face: wp.int32, t: wp.float32, far: wp.float32) -> wp.float32:
        by_light = wp.float32(0.0)
        density = wp.float32(0.0)
        if face < 0:
            if wp.static(environment_pdf is not None):
                by_light = environment_pdf(scene, path.d) * emitter_at(scene, scene.environment).probability
                density = by_light / covering_disk(scene)
        else:
            if wp.static(bool(lights.area)):
                light = shape_at(scene, triangle_at(scene, face).shape).emitter
                if light >= 0:
                    emitter = emitter_at(scene, light)
                    distance = t
                    if wp.static(through):
                        distance += wp.where(path.depth > 0, path.seen.t, 0.0)
                    by_light = pdf_area(scene, emitter, face, path.d, distance) * emitter.probability
                    density = area_density(scene, emitter, face) * emitter.probability / PI
        others = far * density
        if path.pdf > 0.0:
            others += by_light / path.pdf
        return 1.0 / (1.0 + others)

    return hit_weight


@wp.struct
class LightEnd:
    """The end of a light path at its light, seen from the first surface whose lobe is no null lobe."""

    near: wp.float32  # density of next-event estimation over that of the light's rays, over a squared distance
    far: wp.float32  # 1 over the density of the light's rays; 0: no path from the camera hits the light
    origin: wp.vec3  # from which the distance is measured
    by_distance: wp.int32  # 0: ``near`` holds no squared distance, the light's rays are parallel


@functools.cache
def make_light_end(lights: LightConfig):
    """Return ``light_end(scene, ray) -> LightEnd``."""
    kinds = set(lights.others)

    @wp.func
    def light_end(scene: Scene, ray: LightRay) -> LightEnd:
        light = emitter_at(scene, ray.emitter)
        end = LightEnd()
        end.origin = ray.o
        end.near = ray.scale * light.probability
        if ray.from_point == 1:
            end.origin = ray.position
            end.by_distance = 1
        if wp.static(bool({EMITTER_CONSTANT, EMITTER_ENVMAP} & kinds)):
            if light.kind == EMITTER_CONSTANT or light.kind == EMITTER_ENVMAP:
                end.near = covering_disk(scene)
                end.far = ray.scale
        if wp.static(bool(lights.area)):
            if ray.face >= 0:
                end.near = PI / wp.max(wp.abs(wp.dot(triangle_at(scene, ray.face).normal, ray.d)), LEAST_COSINE)
                end.far = ray.scale
                end.by_distance = 1
        return end

    return light_end
