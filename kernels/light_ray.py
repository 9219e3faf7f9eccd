"""Rays that leave the lights: a light drawn by its power, a point on it, a direction, and the flux of the ray.

With the density p of the ray (selection, place, direction), the flux of a sample is W / p. W is what the light sends
per unit of that measure: L cos(theta) for areas, the intensity for points, and L times the area of a disk that covers
the scene for light from infinity.

Derivation: ``docs/theory/light_tracing.md#rays-that-leave-lights``.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import (
    EMITTER_DIRECTIONAL_AREA,
    EMITTER_POINT,
    EMITTER_PROJECTOR,
    EMITTER_SPOT,
    EMITTER_TEXTURED_SPOT,
    PI,
    SPOTS,
    TEXTURE_CONSTANT,
    TWO_PI,
)
from warp_psdr.kernels.emitter.area import density_on, make_area
from warp_psdr.kernels.emitter.dispatch import make_lights
from warp_psdr.kernels.emitter.spot import RADIANS_PER_DEGREE, load_column
from warp_psdr.kernels.math import any_tangent, to_world
from warp_psdr.kernels.reading import emitter_at, load_vec3, texture_record, triangle_at
from warp_psdr.kernels.sampling import (
    square_to_cosine_hemisphere,
    square_to_disk,
    square_to_sphere,
    square_to_triangle,
)
from warp_psdr.kernels.scattering import make_light_draw
from warp_psdr.kernels.sensor.camera import half_width
from warp_psdr.kernels.step import step_off_triangle
from warp_psdr.kernels.structs import Emitter, Scene
from warp_psdr.kernels.surface import point_on
from warp_psdr.kernels.texture.texture import make_texture
from warp_psdr.kernels.vertex import LightConfig, PathVertex

#: The sphere that rays from infinity cover is larger than the scene's by so much, for rounding.
COVER = 1.0e-4


@wp.struct
class LightRay:
    """A ray that leaves a light."""

    emitter: wp.int32
    face: wp.int32  # area light: triangle and barycentrics of the point, else -1
    u: wp.float32
    v: wp.float32
    o: wp.vec3
    d: wp.vec3
    #: Of lights at a finite distance without area: where they are, and 1; else 0.
    position: wp.vec3
    from_point: wp.int32
    scale: wp.float32  # flux over radiance, intensity or irradiance
    flux: wp.vec3  # W, over the density of the ray


@wp.struct
class AimedDirection:
    """A direction that a light without area sends light in, and the inverse of its density [sr]."""

    d: wp.vec3
    inv_pdf: wp.float32


@wp.func
def cone_height(scene: Scene, emitter: Emitter) -> wp.float32:
    """1 - cos of the cutoff angle of a spot, without cancellation: its solid angle over two pi."""
    half_sine = wp.sin(0.5 * RADIANS_PER_DEGREE * scene.values[emitter.cutoff])
    return 2.0 * half_sine * half_sine


@wp.func
def in_cone(scene: Scene, emitter: Emitter, u: wp.vec2) -> AimedDirection:
    """Uniform in the cone of a spot."""
    height = cone_height(scene, emitter)
    below = height * u[1]
    r = wp.sqrt(below * (2.0 - below))
    axis = wp.normalize(load_column(scene.values, emitter.to_world, 2))
    s = any_tangent(axis)
    aimed = AimedDirection()
    aimed.d = to_world(
        s, wp.cross(axis, s), axis, wp.vec3(r * wp.cos(TWO_PI * u[0]), r * wp.sin(TWO_PI * u[0]), 1.0 - below)
    )
    aimed.inv_pdf = TWO_PI * height
    return aimed


@wp.func
def in_frame(scene: Scene, emitter: Emitter, u: wp.vec2) -> AimedDirection:
    """Uniform over the image of a projector."""
    values = scene.values
    texture = texture_record(scene, emitter.texture)
    aspect = wp.float32(wp.max(texture.width, 1)) / wp.float32(wp.max(texture.height, 1))
    t = half_width(values[emitter.cutoff])
    x_axis = load_column(values, emitter.to_world, 0)
    y_axis = load_column(values, emitter.to_world, 1)
    z_axis = load_column(values, emitter.to_world, 2)
    d = ((1.0 - 2.0 * u[0]) * t) * x_axis + ((1.0 - 2.0 * u[1]) * t / aspect) * y_axis + z_axis
    length = wp.length(d)
    aimed = AimedDirection()
    aimed.d = d / length
    # dw = |det M| dp dq / |M (p, q, 1)|^3, as of the camera (``sensor/projection.py``).
    volume = wp.abs(wp.dot(wp.cross(x_axis, y_axis), z_axis))
    aimed.inv_pdf = 4.0 * t * t / aspect * volume / (length * length * length)
    return aimed


@functools.cache
def make_light_ray(lights: LightConfig):
    """Return ``light_ray(scene, sphere, u4, u2) -> LightRay``; ``sphere``: center and radius, it holds the scene."""
    pick, _draw = make_light_draw(lights)
    kinds = lights.others
    emitted = make_area(lights.area).emitted if lights.area else None
    sample = make_lights(kinds, None, ()).sample if kinds else None
    constant_at = make_texture((TEXTURE_CONSTANT,))

    @wp.func
    def leave_point(
        scene: Scene, sphere: wp.vec4, index: wp.int32, position: wp.vec3, aimed: AimedDirection
    ) -> LightRay:
        """Light without area at a finite distance: I / p."""
        emitter = emitter_at(scene, index)
        r = LightRay()
        r.o = position
        r.d = aimed.d
        r.position = position
        r.from_point = 1
        r.scale = aimed.inv_pdf / emitter.probability
        # The irradiance of a facing surface as far away as the scene is large, times the squared distance.
        x = position + sphere[3] * aimed.d
        seen = sample(scene, emitter, x, wp.vec2(0.0, 0.0))
        r.flux = (r.scale * wp.length_sq(x - position)) * seen.radiance
        return r

    @wp.func
    def leave_infinity(scene: Scene, sphere: wp.vec4, index: wp.int32, u: wp.vec2, place: wp.vec2) -> LightRay:
        """Light from infinity: L or E times the area of the disk that covers the scene."""
        emitter = emitter_at(scene, index)
        r = LightRay()
        center = wp.vec3(sphere[0], sphere[1], sphere[2])
        ls = sample(scene, emitter, center, u)
        disk = square_to_disk(place)
        s = any_tangent(ls.wi)
        r.d = -ls.wi
        r.o = center + sphere[3] * (ls.wi + disk[0] * s + disk[1] * wp.cross(ls.wi, s))
        if not ls.pdf <= 0.0:
            r.scale = PI * sphere[3] * sphere[3] / (ls.pdf * emitter.probability)
            r.flux = r.scale * ls.radiance
        return r

    @wp.func
    def leave_flat(scene: Scene, index: wp.int32, u: wp.float32, place: wp.vec2) -> LightRay:
        """Directional area light: any of its triangles, a uniform point on it; along the normal."""
        emitter = emitter_at(scene, index)
        r = LightRay()
        k = wp.min(wp.int32(u * wp.float32(emitter.face_count)), emitter.face_count - 1)
        tri = triangle_at(scene, emitter.first_face + k)
        barycentrics = square_to_triangle(place)
        r.d = tri.normal
        r.o = point_on(tri, barycentrics[0], barycentrics[1]) + step_off_triangle(scene, tri) * tri.normal
        area = 0.5 * wp.length(wp.cross(tri.p1 - tri.p0, tri.p2 - tri.p0))
        r.scale = area * wp.float32(emitter.face_count) / emitter.probability
        r.flux = r.scale * constant_at(scene, emitter.texture, 0, 0.0, 0.0, wp.vec2(0.0, 0.0))
        return r

    @wp.func
    def leave_other(scene: Scene, sphere: wp.vec4, index: wp.int32, u4: wp.vec4, u2: wp.vec2) -> LightRay:
        """Lights that are no area lights."""
        emitter = emitter_at(scene, index)
        place = wp.vec2(u4[2], u4[3])
        if wp.static(EMITTER_POINT in kinds):
            if emitter.kind == EMITTER_POINT:
                anywhere = AimedDirection()
                anywhere.d = square_to_sphere(place)
                anywhere.inv_pdf = 4.0 * PI
                return leave_point(scene, sphere, index, load_vec3(scene.values, emitter.to_world), anywhere)
        if wp.static(bool(SPOTS & set(kinds))):
            if emitter.kind == EMITTER_SPOT or emitter.kind == EMITTER_TEXTURED_SPOT:
                position = load_column(scene.values, emitter.to_world, 3)
                return leave_point(scene, sphere, index, position, in_cone(scene, emitter, place))
        if wp.static(EMITTER_PROJECTOR in kinds):
            if emitter.kind == EMITTER_PROJECTOR:
                position = load_column(scene.values, emitter.to_world, 3)
                return leave_point(scene, sphere, index, position, in_frame(scene, emitter, place))
        if wp.static(EMITTER_DIRECTIONAL_AREA in kinds):
            if emitter.kind == EMITTER_DIRECTIONAL_AREA:
                return leave_flat(scene, index, u4[1], place)
        return leave_infinity(scene, sphere, index, place, u2)

    @wp.func
    def leave_area(scene: Scene, index: wp.int32, face: wp.int32, u: wp.vec2, v: wp.vec2) -> LightRay:
        """Area light: a uniform point, a direction by its cosine."""
        emitter = emitter_at(scene, index)
        tri = triangle_at(scene, face)
        barycentrics = square_to_triangle(u)
        r = LightRay()
        r.u = barycentrics[0]
        r.v = barycentrics[1]
        s = any_tangent(tri.normal)
        r.d = to_world(s, wp.cross(tri.normal, s), tri.normal, square_to_cosine_hemisphere(v))
        r.o = point_on(tri, r.u, r.v) + step_off_triangle(scene, tri) * tri.normal
        r.scale = PI / (density_on(scene, emitter, face, tri) * emitter.probability)
        r.flux = r.scale * emitted(scene, emitter, face, r.u, r.v, -tri.normal)
        return r

    @wp.func
    def light_ray(scene: Scene, sphere: wp.vec4, u4: wp.vec4, u2: wp.vec2) -> LightRay:
        index, face = pick(scene, wp.vec2(u4[0], u4[1]))
        r = LightRay()
        if wp.static(bool(lights.area) and not kinds):
            r = leave_area(scene, index, face, wp.vec2(u4[2], u4[3]), u2)
        elif wp.static(bool(lights.area)):
            if face >= 0:
                r = leave_area(scene, index, face, wp.vec2(u4[2], u4[3]), u2)
            else:
                r = leave_other(scene, sphere, index, u4, u2)
        else:
            r = leave_other(scene, sphere, index, u4, u2)
        r.emitter = index
        r.face = face
        return r

    return light_ray


@wp.func
def light_vertex(ray: LightRay) -> PathVertex:
    """The light as next-event estimation finds it from where the ray ends."""
    found = PathVertex()
    found.light = ray.emitter
    found.light_face = ray.face
    found.light_u = ray.u
    found.light_v = ray.v
    found.light_wi = -ray.d
    return found


@wp.func
def radiance_scale(ray: LightRay, x: wp.vec3) -> wp.float32:
    """Flux over what the light's ``sample`` gives as radiance at x, where the ray ends."""
    return wp.where(ray.from_point == 1, ray.scale * wp.length_sq(x - ray.position), ray.scale)
