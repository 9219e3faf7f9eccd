"""Projector: a pinhole that throws an image along +z of its pose, given by what the image does at distance 1.

``irradiance`` E is the radiance that a white diffuse screen at z = 1, perpendicular to the axis, sends back. With
d = x - o of length r and z = d . axis, a facing surface at x receives

    pi s E(uv) r / z^3 = pi s E(uv) / (z^2 cos(theta)),

because the intensity is pi s E / cos(theta)^3 and falls with r^2. The image is read at
u = (1 - x / (z t)) / 2 and v = (1 - a y / (z t)) / 2, t = tan(fov / 2) and a = width / height; beyond [0, 1]^2 and
behind the pinhole it is dark, so that the frame of an image whose border is not black is an edge of light.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor, differentiable
from warp_psdr.kernels.constants import EMITTER_PROJECTOR, PI, TEXTURE_BITMAP, TEXTURE_CONSTANT
from warp_psdr.kernels.emitter.point import DeltaLightFunctions
from warp_psdr.kernels.emitter.spot import load_column
from warp_psdr.kernels.reading import texture_record
from warp_psdr.kernels.sensor.camera import half_width
from warp_psdr.kernels.sink import make_sink
from warp_psdr.kernels.structs import Emitter, LightAdjoint, LightSample, Scene
from warp_psdr.kernels.texture.texture import make_texture, make_texture_sink

KINDS = (TEXTURE_CONSTANT, TEXTURE_BITMAP)


@differentiable
@wp.func
def projector_dot(
    x: wp.vec3, position: wp.vec3, axis: wp.vec3, irradiance: wp.vec3, w: wp.vec3, a_wi: wp.vec3
) -> wp.float32:
    """Local factor: what arrives at x, and its direction; ``axis`` of any length, ``irradiance`` at z = 1."""
    d = x - position
    r = wp.length(d)
    z = wp.dot(d, axis) / wp.length(axis)
    return wp.static(PI) * wp.dot(w, irradiance) * (r / z) / (z * z) - wp.dot(a_wi, d) / r


@differentiable
@wp.func
def frame_dot(
    d: wp.vec3,
    x_axis: wp.vec3,
    y_axis: wp.vec3,
    z_axis: wp.vec3,
    fov: wp.float32,
    aspect: wp.float32,
    a_uv: wp.vec2,
) -> wp.float32:
    """Local factor: where the image is read in the direction d, of any length; by the pose's inverse."""
    scale = -0.5 / (wp.dot(wp.cross(x_axis, y_axis), d) * half_width(fov))
    across, up = wp.dot(wp.cross(y_axis, z_axis), d), wp.dot(wp.cross(z_axis, x_axis), d)
    return a_uv[0] * (0.5 + scale * across) + a_uv[1] * (0.5 + scale * aspect * up)


@wp.func
def image_aspect(scene: Scene, e: Emitter) -> wp.float32:
    """Width over height of a projector's image."""
    t = texture_record(scene, e.texture)
    return wp.float32(wp.max(t.width, 1)) / wp.float32(wp.max(t.height, 1))


@wp.func
def place_in_frame(scene: Scene, e: Emitter, d: wp.vec3) -> wp.vec3:
    """Where the image is read, and 1; the third is 0 beyond the frame and behind the pinhole."""
    values = scene.values
    x_axis, y_axis = load_column(values, e.to_world, 0), load_column(values, e.to_world, 1)
    z_axis = load_column(values, e.to_world, 2)
    if wp.dot(z_axis, d) <= 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    fov = values[e.cutoff]
    aspect = image_aspect(scene, e)
    u = frame_dot(d, x_axis, y_axis, z_axis, fov, aspect, wp.vec2(1.0, 0.0))
    v = frame_dot(d, x_axis, y_axis, z_axis, fov, aspect, wp.vec2(0.0, 1.0))
    # NaN passes, and makes the sample invalid.
    outside = u < 0.0 or u > 1.0 or v < 0.0 or v > 1.0
    return wp.vec3(u, v, wp.where(outside, 0.0, 1.0))


@wp.func
def lies_in_frame(scene: Scene, light: wp.int32, x: wp.vec3) -> wp.bool:
    """Whether a point lies in the cone of an image; true of lights of other kinds."""
    record = scene.emitters[light]
    if record.kind != EMITTER_PROJECTOR:
        return True
    place = place_in_frame(scene, record, x - load_column(scene.values, record.to_world, 3))
    return place[2] > 0.0


@functools.cache
def make_projector(role: str | None, wanted: tuple[str, ...]) -> DeltaLightFunctions:
    """Return the functions of the projector (see `DeltaLightFunctions`).

    Args:
        role: "reverse", "forward", or None for a light that is not differentiated.
        wanted: "radiance" scatters to the irradiance (constant or texels) and to the scale, "pose" to the matrix and to
            the field of view. The derivative is that inside of the frame, whose edge is the boundary term's.
    """
    texture_at = make_texture(KINDS)

    @wp.func
    def sample(scene: Scene, e: Emitter, x: wp.vec3, u: wp.vec2) -> LightSample:
        result = LightSample()
        result.face = -1
        result.delta = 1
        d = x - load_column(scene.values, e.to_world, 3)
        squared = wp.dot(d, d)
        if not squared <= 0.0:  # NaN passes
            result.distance = wp.sqrt(squared)
            result.wi = -d / result.distance
            result.pdf = 1.0
            place = place_in_frame(scene, e, d)
            if place[2] > 0.0:
                axis = load_column(scene.values, e.to_world, 2)
                z = wp.dot(d, axis) / wp.length(axis)
                factor = wp.static(PI) * scene.values[e.scale] * (result.distance / z) / (z * z)
                result.radiance = factor * texture_at(scene, e.texture, 0, 0.0, 0.0, wp.vec2(place[0], place[1]))
        return result

    if role is None:
        return DeltaLightFunctions(sample, None)
    accumulate_texture = make_texture_sink(role, KINDS, "radiance" in wanted, False, True)
    sink = make_sink(role)

    @wp.func
    def sample_vjp(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        e: Emitter,
        x: wp.vec3,
        wi: wp.vec3,
        w: wp.vec3,
        a_wi: wp.vec3,
    ) -> LightAdjoint:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        result = LightAdjoint()
        values = scene.values
        m = e.to_world
        position = load_column(values, m, 3)
        d = x - position
        if wp.length_sq(d) <= 0.0:
            return result
        z_axis = load_column(values, m, 2)
        place = place_in_frame(scene, e, d)
        uv = wp.vec2(place[0], place[1])
        lit = place[2] > 0.0
        weight = w
        axis = z_axis
        irradiance = wp.vec3(0.0, 0.0, 0.0)
        if lit:
            irradiance = texture_at(scene, e.texture, 0, 0.0, 0.0, uv)
        else:  # the direction alone; an axis on which z cannot vanish
            weight = wp.vec3(0.0, 0.0, 0.0)
            axis = d
        scale = values[e.scale]
        d_x, d_position, d_axis, d_product, _w, _a = wp.grad(projector_dot)(
            x, position, axis, scale * irradiance, weight, a_wi
        )
        result.x = d_x
        if wp.static("pose" in wanted):
            for i in range(wp.static(3)):
                result.dot += sink(target, m + 4 * i + 3, d_position[i])
        if lit:
            accumulated = accumulate_texture(scene, target, e.texture, 0, 0.0, 0.0, uv, scale * d_product)
            x_axis, y_axis = load_column(values, m, 0), load_column(values, m, 1)
            g_d, g_x, g_y, g_z, g_fov, _aspect, _a_uv = wp.grad(frame_dot)(
                d, x_axis, y_axis, z_axis, values[e.cutoff], image_aspect(scene, e), accumulated.uv
            )
            result.x += g_d
            if wp.static("radiance" in wanted):
                result.dot += accumulated.dot + sink(target, e.scale, wp.dot(d_product, irradiance))
            if wp.static("pose" in wanted):
                for i in range(wp.static(3)):
                    result.dot += sink(target, m + 4 * i, g_x[i]) + sink(target, m + 4 * i + 1, g_y[i])
                    result.dot += sink(target, m + 4 * i + 2, g_z[i] + d_axis[i])
                    result.dot += sink(target, m + 4 * i + 3, -g_d[i])
                result.dot += sink(target, e.cutoff, g_fov)
        return result

    return DeltaLightFunctions(sample, sample_vjp)
