"""Lens distortion: from the pinhole's image to the film, and back by Newton's method.

A pinhole sees a direction (p, q, 1) of camera space at (p, q). The lens moves that point, radially by the factor D(r^2)
and tangentially, and the film stretches and shears it: F(p, q) is where it lies, in units in which the film is 2 k
wide. D is OpenCV's rational function, or its fisheye polynomial of the angle. Rays need F^-1, whose derivatives are
those of the implicit function theorem.

Derivation: ``docs/theory/cameras.md#lens-distortion``.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.autodiff import differentiable
from warp_psdr.kernels.structs import Camera, Scene

#: Numbers of a camera with distortion, at ``Camera.distortion``: fy / fx, the skew, and the coefficients as OpenCV
#: orders them, k1, k2, p1, p2, k3, k4, k5, k6; of a fisheye k1 to k4, and the rest is 0.
NUMBERS = 10
COEFFICIENTS = wp.types.vector(length=NUMBERS, dtype=wp.float32)
#: Most steps of Newton's method; a few are enough, and ``scene/distortion.py`` refuses films that need more.
STEPS = 20
#: Where it ends: the length of a step, relative to 1 + |(p, q)|; steps behind it are below the rounding of float32.
SMALL_STEP = 1.0e-5
#: Squared radius below which the fisheye's factor is its series, whose next term is below the rounding of float32.
NEAR_AXIS = 1.0e-3
#: A point that is seen lies on the ray of its image up to this, relative to 1 + |(p, q)|: more than Newton's rounding,
#: less than what lies between a direction and one that a lens folds onto the same film point.
SAME_RAY = 1.0e-2


class Distortion(NamedTuple):
    """Functions of a model; a point of the pinhole's image is (p, q), and c are the ``COEFFICIENTS``.

    Attributes:
        distort: ``(c, x: vec2) -> vec2``: F.
        jacobian: ``(c, x) -> mat22``: F's.
        undistort: ``(c, y: vec2) -> vec2``: F^-1.
        followed: ``(c, y, start, inverse) -> vec2``: F^-1(y) with right derivatives, if ``start`` is F^-1(y) and
            ``inverse`` that of the Jacobian there; neither is differentiated.
        log_area: ``(c, x) -> float``: ln |det F'|.
    """

    distort: wp.Function
    jacobian: wp.Function
    undistort: wp.Function
    followed: wp.Function
    log_area: wp.Function


@wp.func
def load_coefficients(scene: Scene, camera: Camera) -> COEFFICIENTS:
    c = COEFFICIENTS()
    for i in range(wp.static(NUMBERS)):
        c[i] = scene.values[camera.distortion + i]
    return c


@wp.func
def film_plane(
    k: wp.float32, cx: wp.float32, cy: wp.float32, s: wp.float32, t: wp.float32, aspect: wp.float32
) -> wp.vec2:
    """F at a film position; ``k`` is the ``half_width``, ``aspect`` width / height."""
    return wp.vec2((1.0 - 2.0 * (s + cx)) * k, (1.0 - 2.0 * (t + cy)) * k / aspect)


@wp.func
def rational_factor(c: COEFFICIENTS, r2: wp.float32) -> wp.vec2:
    """D and its derivative by r^2, of OpenCV's rational model."""
    above = 1.0 + r2 * (c[2] + r2 * (c[3] + r2 * c[6]))
    below = 1.0 + r2 * (c[7] + r2 * (c[8] + r2 * c[9]))
    above_r = c[2] + r2 * (2.0 * c[3] + r2 * 3.0 * c[6])
    below_r = c[7] + r2 * (2.0 * c[8] + r2 * 3.0 * c[9])
    factor = above / below
    return wp.vec2(factor, (above_r - factor * below_r) / below)


@wp.func
def angle_image(c: COEFFICIENTS, theta: wp.float32) -> wp.vec2:
    """Radius at which a fisheye shows the angle theta, and its derivative."""
    u = theta * theta
    radius = theta * (1.0 + u * (c[2] + u * (c[3] + u * (c[4] + u * c[5]))))
    slope = 1.0 + u * (3.0 * c[2] + u * (5.0 * c[3] + u * (7.0 * c[4] + u * 9.0 * c[5])))
    return wp.vec2(radius, slope)


@wp.func
def fisheye_factor(c: COEFFICIENTS, r2: wp.float32) -> wp.vec2:
    """D and its derivative by r^2, of OpenCV's fisheye."""
    # theta = r - r^3 / 3 + r^5 / 5
    first = c[2] - 1.0 / 3.0
    second = c[3] - c[2] + 0.2
    if r2 < NEAR_AXIS:
        return wp.vec2(1.0 + r2 * (first + r2 * second), first + 2.0 * r2 * second)
    r = wp.sqrt(r2)
    image = angle_image(c, wp.atan(r))
    factor = image[0] / r
    return wp.vec2(factor, 0.5 * (image[1] / (1.0 + r2) - factor) / r2)


@functools.cache
def make_distortion(fisheye: bool) -> Distortion:
    """Return the functions of OpenCV's fisheye, or of its rational model with the tangential terms."""
    radial_factor = fisheye_factor if fisheye else rational_factor

    @wp.func
    def distort(c: COEFFICIENTS, x: wp.vec2) -> wp.vec2:
        r2 = x[0] * x[0] + x[1] * x[1]
        factor = radial_factor(c, r2)
        # OpenCV's axes point to the right and down, ours to the left and up: the tangential terms change their sign.
        across = x[0] * factor[0]
        up = x[1] * factor[0]
        if wp.static(not fisheye):
            across -= 2.0 * c[4] * x[0] * x[1] + c[5] * (r2 + 2.0 * x[0] * x[0])
            up -= 2.0 * c[5] * x[0] * x[1] + c[4] * (r2 + 2.0 * x[1] * x[1])
        return wp.vec2(across + c[1] * up, c[0] * up)

    @wp.func
    def jacobian(c: COEFFICIENTS, x: wp.vec2) -> wp.mat22:
        r2 = x[0] * x[0] + x[1] * x[1]
        factor = radial_factor(c, r2)
        xx = factor[0] + 2.0 * x[0] * x[0] * factor[1]
        xy = 2.0 * x[0] * x[1] * factor[1]
        yy = factor[0] + 2.0 * x[1] * x[1] * factor[1]
        if wp.static(not fisheye):
            xx -= 2.0 * c[4] * x[1] + 6.0 * c[5] * x[0]
            xy -= 2.0 * c[4] * x[0] + 2.0 * c[5] * x[1]
            yy -= 6.0 * c[4] * x[1] + 2.0 * c[5] * x[0]
        return wp.mat22(xx + c[1] * xy, xy + c[1] * yy, c[0] * xy, c[0] * yy)

    @wp.func
    def undistort(c: COEFFICIENTS, y: wp.vec2) -> wp.vec2:
        up = y[1] / c[0]
        x = wp.vec2(y[0] - c[1] * up, up)
        if wp.static(fisheye):
            # In the angle, of which the image is nearly linear.
            radius = wp.length(x)
            theta = radius
            for _ in range(wp.static(STEPS)):
                image = angle_image(c, theta)
                step = (radius - image[0]) / image[1]
                theta += step
                if wp.abs(step) < SMALL_STEP:
                    break
            if radius > 0.0:
                x *= wp.tan(theta) / radius
        else:
            for _ in range(wp.static(STEPS)):
                step = wp.inverse(jacobian(c, x)) * (y - distort(c, x))
                x += step
                if wp.length(step) < SMALL_STEP * (1.0 + wp.length(x)):
                    break
        return x

    @wp.func
    def followed(c: COEFFICIENTS, y: wp.vec2, start: wp.vec2, inverse: wp.mat22) -> wp.vec2:
        # A step of Newton's method with a fixed Jacobian: its derivatives are J^-1 (dy - dF/dc dc).
        return start + inverse * (y - distort(c, start))

    @wp.func
    def log_area(c: COEFFICIENTS, x: wp.vec2) -> wp.float32:
        return wp.log(wp.abs(wp.determinant(jacobian(c, x))))

    return Distortion(distort, jacobian, undistort, differentiable(followed), differentiable(log_area))


@functools.cache
def make_distorted_dot(fisheye: bool) -> wp.Function:
    """Return the local factor of a camera with distortion, which ``camera.make_camera_sink`` differentiates."""
    followed = make_distortion(fisheye).followed

    @differentiable
    @wp.func
    def distorted_dot(
        m: wp.mat44, fov: wp.float32, cx: wp.float32, cy: wp.float32, c: COEFFICIENTS,
        radius: wp.float32, focus: wp.float32, film: wp.vec2, lens: wp.vec2, aspect: wp.float32,
        start: wp.vec2, inverse: wp.mat22, a_o: wp.vec3, a_d: wp.vec3,
    ) -> wp.float32:  # fmt: skip
        """As ``camera.lens_dot``; ``start`` and ``inverse`` of ``Distortion.followed``. A pinhole has no radius."""
        k = wp.tan(fov * wp.static(3.14159265358979 / 360.0))
        x = followed(c, film_plane(k, cx, cy, film[0], film[1], aspect), start, inverse)
        at = wp.vec2(radius * lens[0], radius * lens[1])
        block = wp.mat33(m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2], m[2, 0], m[2, 1], m[2, 2])
        d = wp.normalize(block * wp.vec3(x[0] - at[0] / focus, x[1] - at[1] / focus, 1.0))
        o = block * wp.vec3(at[0], at[1], 0.0) + wp.vec3(m[0, 3], m[1, 3], m[2, 3])
        return wp.dot(a_o, o) + wp.dot(a_d, d)

    return distorted_dot
