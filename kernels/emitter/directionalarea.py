"""Directional area light: a flat shape whose light leaves along its normal only.

Its radiance is a delta function of the direction, L delta(w - n). A point x receives light from one point of the
shape at most, its orthogonal projection y, and a facing surface the irradiance L, at any distance:

    int L delta(w - n) cos(theta_y) / t^2 dA = L if y lies on the shape and x in front of it, else 0,

for cos(theta_y) dA / t^2 = dw. No ray that scatters ever meets it. The outline of the shape is an edge of light.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.constants import TEXTURE_CONSTANT
from warp_psdr.kernels.emitter.point import DeltaLightFunctions
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.step import step_off_triangle
from warp_psdr.kernels.structs import Emitter, LightAdjoint, LightSample, Scene, Triangle
from warp_psdr.kernels.texture.texture import make_texture, make_texture_sink


@wp.func
def covers(tri: Triangle, x: wp.vec3) -> wp.bool:
    """Whether the projection of x along the normal lies on a triangle, its edges included."""
    e1 = tri.p1 - tri.p0
    e2 = tri.p2 - tri.p0
    r = x - tri.p0
    c = wp.cross(e1, e2)
    u = wp.dot(wp.cross(r, e2), c)
    v = wp.dot(wp.cross(e1, r), c)
    return u >= 0.0 and v >= 0.0 and u + v <= wp.dot(c, c)


@wp.func
def project_onto(scene: Scene, e: Emitter, x: wp.vec3) -> wp.float32:
    """Distance of x from the shape along its normal; 0: x is not in front of it. NaN stays."""
    tri = triangle_at(scene, e.first_face)
    t = wp.dot(x - tri.p0, tri.normal)
    if t <= 0.0:
        return 0.0
    met = wp.bool(False)
    for k in range(e.face_count):
        met = met or covers(triangle_at(scene, e.first_face + k), x)
    return wp.where(met or not t > 0.0, t, 0.0)


@functools.cache
def make_directional_area(role: str | None, wanted: tuple[str, ...]) -> DeltaLightFunctions:
    """Return the functions of the directional area light (see `DeltaLightFunctions`).

    Args:
        role: "reverse", "forward", or None for a light that is not differentiated.
        wanted: "radiance" scatters to the radiance. The shape is at rest: the plan refuses that it moves.
    """
    texture_at = make_texture((TEXTURE_CONSTANT,))

    @wp.func
    def sample(scene: Scene, e: Emitter, x: wp.vec3, u: wp.vec2) -> LightSample:
        result = LightSample()
        result.face = -1
        result.delta = 1
        t = project_onto(scene, e, x)
        if not t <= 0.0:  # NaN passes, and makes the sample invalid
            tri = triangle_at(scene, e.first_face)
            result.wi = -tri.normal
            # The shadow ray ends in front of the shape.
            result.distance = wp.max(t - 2.0 * step_off_triangle(scene, tri), 0.5 * t)
            result.radiance = texture_at(scene, e.texture, 0, 0.0, 0.0, wp.vec2(0.0, 0.0)) * (t / t)
            result.pdf = 1.0
        return result

    if role is None:
        return DeltaLightFunctions(sample, None)
    accumulate_texture = make_texture_sink(role, (TEXTURE_CONSTANT,), "radiance" in wanted, False, False)

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
        result = LightAdjoint()
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        if wp.static("radiance" in wanted):
            if not project_onto(scene, e, x) <= 0.0:
                result.dot += accumulate_texture(scene, target, e.texture, 0, 0.0, 0.0, wp.vec2(0.0, 0.0), w).dot
        return result

    return DeltaLightFunctions(sample, sample_vjp)
