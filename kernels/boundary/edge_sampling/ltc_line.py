"""Integrals of lobes over edges: linearly transformed cosines along a line [HH17], the weights of edges in [LADL18].

The measure is q(l) dl = D(omega) sin(phi) / t^2 dl, where D is a clamped cosine in directions transformed by M. M maps
lines to lines, so the integral over an edge has a closed form.

Derivation: ``docs/theory/edge_sampling.md#lobes-along-a-line``.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import INV_FOUR_PI, INV_PI
from warp_psdr.kernels.interaction import leave_frame, make_interaction
from warp_psdr.kernels.math import any_tangent, reflect_local
from warp_psdr.kernels.vertex import LightConfig, SurfaceConfig

#: Arcs (radians) below it are integrated with Gauss' rule of three nodes: a relative error below 1e-7.
SHORT_ARC = 0.3
#: Nodes and weights of that rule on [-1, 1].
GAUSS_NODE, GAUSS_OUTER, GAUSS_INNER = 0.7745966692414834, 5.0 / 9.0, 8.0 / 9.0
#: Newton steps of an inversion, guarded by bisection; [LADL18] take as many.
INVERSION_STEPS = 20
#: Relative step at which the inversion stops: float32's resolution.
INVERSION_TOLERANCE = 1.0e-6
#: Sine of the angle between an edge and a line of sight below which the edge is a point.
END_ON = 1.0e-7
#: Share of the cosine lobe at a rough conductor: covers what the transformed lobe clips or underrates.
COSINE_SHARE = 0.25
#: Narrowest lobe (slope); float32 resolves its peak.
MIN_SCALE = 1.0e-3
#: Least cosine of incidence that narrows a glossy lobe across the plane of incidence: for less noise alone, since what
#: a lobe draws is divided by its density.
MIN_NARROWING = 0.2


@wp.struct
class Lobe:
    """A density of directions that integrates to one. ``share``: its part of a mixture; 0: absent."""

    x: wp.vec3
    y: wp.vec3
    z: wp.vec3
    sx: wp.float32
    sy: wp.float32
    share: wp.float32


@wp.struct
class Lobes:
    """A mixture: the cosine about the shading normal, a glossy lobe, one around a light, and the whole sphere.

    Surfaces have no share of the sphere; points of a medium have, and no cosine.
    """

    cosine: Lobe
    glossy: Lobe
    light: Lobe
    sphere: wp.float32  # share of the uniform density


@wp.struct
class SphereSegment:
    """An edge as the uniform density sees it, and the integral of q over it [1 / length]."""

    integral: wp.float32
    distance: wp.float32  # of its line
    start: wp.float32  # from the line's foot to the edge's ends
    length: wp.float32
    above: wp.vec2  # 1 - sin(psi) at the two ends
    below: wp.vec2  # 1 + sin(psi)


@wp.struct
class LobeSegment:
    """The part of an edge in front of a lobe, and the integral of q over it [1 / length]."""

    integral: wp.float32
    low: wp.float32  # fractions of the edge between which it lies
    high: wp.float32
    psi: wp.float32  # angle of its start
    arc: wp.float32
    u_z: wp.float32
    w_z: wp.float32
    reach: wp.float32  # d' over the transformed edge's length


@wp.func
def make_lobe(z: wp.vec3, x: wp.vec3, sx: wp.float32, sy: wp.float32, share: wp.float32) -> Lobe:
    """Return a lobe about the unit vector z whose first axis is the unit x, perpendicular to it."""
    r = Lobe()
    r.x = x
    r.y = wp.cross(z, x)
    r.z = z
    r.sx = sx
    r.sy = sy
    r.share = share
    return r


@wp.func
def lobe_density(lobe: Lobe, w: wp.vec3) -> wp.float32:
    """Density of the unit direction w, solid angle."""
    c = wp.dot(w, lobe.z)
    if c <= 0.0:
        return 0.0
    a = wp.dot(w, lobe.x) / lobe.sx
    b = wp.dot(w, lobe.y) / lobe.sy
    r2 = a * a + b * b + c * c
    return INV_PI * c / (lobe.sx * lobe.sy * r2 * r2)


@wp.func
def arc_integral(psi: wp.float32, x: wp.float32, u_z: wp.float32, w_z: wp.float32) -> wp.float32:
    """Twice the integral of (u_z cos + w_z sin) cos over [psi, psi + x]."""
    if x < SHORT_ARC:
        half = 0.5 * x
        total = wp.float32(0.0)
        for i in range(3):
            at = psi + half * (1.0 + (wp.float32(i) - 1.0) * GAUSS_NODE)
            c = wp.cos(at)
            total += wp.where(i == 1, GAUSS_INNER, GAUSS_OUTER) * (u_z * c + w_z * wp.sin(at)) * c
        return x * total
    s = wp.sin(x)
    return u_z * (x + wp.cos(2.0 * psi + x) * s) + w_z * wp.sin(2.0 * psi + x) * s


@wp.func
def line_integral(lobe: Lobe, a: wp.vec3, along: wp.vec3) -> LobeSegment:
    """Integrate q over the edge from a to a + along, both relative to the point that sees it."""
    r = LobeSegment()
    a_t = wp.vec3(wp.dot(a, lobe.x) / lobe.sx, wp.dot(a, lobe.y) / lobe.sy, wp.dot(a, lobe.z))
    e_t = wp.vec3(wp.dot(along, lobe.x) / lobe.sx, wp.dot(along, lobe.y) / lobe.sy, wp.dot(along, lobe.z))
    z0 = a_t[2]
    z1 = a_t[2] + e_t[2]
    if z0 <= 0.0 and z1 <= 0.0:
        return r
    r.high = 1.0
    if z0 < 0.0:
        r.low = z0 / (z0 - z1)
    if z1 < 0.0:
        r.high = z0 / (z0 - z1)
    length = wp.length(e_t)
    double_area = wp.length(wp.cross(a_t, e_t))
    if double_area <= END_ON * length * wp.length(a_t):
        return r
    d = double_area / length
    w = e_t / length
    start = wp.dot(a_t, w)
    foot = a_t - start * w
    l1 = start + r.low * length
    l2 = start + r.high * length
    r.psi = wp.atan2(l1, d)
    r.arc = wp.atan2(d * (l2 - l1), d * d + l1 * l2)
    r.u_z = foot[2] / d
    r.w_z = w[2]
    r.reach = d / length
    scale = wp.length(wp.cross(a, along)) / (lobe.sx * lobe.sy * double_area)
    r.integral = wp.max(INV_PI * scale * arc_integral(r.psi, r.arc, r.u_z, r.w_z) / (2.0 * d), 0.0)
    return r


@wp.func
def sample_line(line: LobeSegment, u: wp.float32) -> wp.float32:
    """Return the fraction of the edge up to which a part u of the integral lies."""
    target = u * arc_integral(line.psi, line.arc, line.u_z, line.w_z)
    low = wp.float32(0.0)
    high = wp.float32(line.arc)
    x = u * line.arc
    for _ in range(INVERSION_STEPS):
        error = arc_integral(line.psi, x, line.u_z, line.w_z) - target
        if error > 0.0:
            high = x
        else:
            low = x
        c = wp.cos(line.psi + x)
        slope = 2.0 * (line.u_z * c + line.w_z * wp.sin(line.psi + x)) * c
        following = 0.5 * (low + high)
        # Without a slope it is infinite or not a number, and a slope that rounding turns around leads out.
        newton = x - error / slope
        if newton > low and newton < high:
            following = newton
        step = wp.abs(following - x)
        x = following
        if step <= INVERSION_TOLERANCE * line.arc:
            break
    # tan(psi + x) - tan(psi), without the difference.
    along = line.reach * wp.sin(x) / (wp.cos(line.psi) * wp.cos(line.psi + x))
    return wp.clamp(line.low + along, line.low, line.high)


@wp.func
def one_minus_sine(far: wp.float32, t: wp.float32, d: wp.float32) -> wp.float32:
    """1 - far / t with t^2 = far^2 + d^2, to float32's relative precision."""
    if far > 0.0:
        return d * d / (t * (t + far))
    return 1.0 - far / t


@wp.func
def sphere_integral(a: wp.vec3, along: wp.vec3) -> SphereSegment:
    """Integrate q of the uniform density over an edge (arguments as ``line_integral``'s)."""
    r = SphereSegment()
    r.length = wp.length(along)
    double_area = wp.length(wp.cross(a, along))
    if double_area <= END_ON * r.length * wp.length(a):
        return r
    d = double_area / r.length
    r.distance = d
    r.start = wp.dot(a, along) / r.length
    end = r.start + r.length
    t1 = wp.sqrt(d * d + r.start * r.start)
    t2 = wp.sqrt(d * d + end * end)
    r.above = wp.vec2(one_minus_sine(r.start, t1, d), one_minus_sine(end, t2, d))
    r.below = wp.vec2(one_minus_sine(-r.start, t1, d), one_minus_sine(-end, t2, d))
    half = 0.5 * wp.atan2(d * r.length, d * d + r.start * end)
    # sin(psi_2) - sin(psi_1) = 2 sin(x / 2) cos(psi_1 + x / 2), without the difference.
    middle = (d * wp.cos(half) - r.start * wp.sin(half)) / t1
    r.integral = INV_FOUR_PI * wp.max(2.0 * wp.sin(half) * middle, 0.0) / d
    return r


@wp.func
def sample_sphere_line(line: SphereSegment, u: wp.float32) -> wp.float32:
    """Return the fraction of the edge up to which a part u of the integral lies."""
    above = (1.0 - u) * line.above[0] + u * line.above[1]
    below = (1.0 - u) * line.below[0] + u * line.below[1]
    from_foot = 0.5 * line.distance * (below - above) / wp.sqrt(above * below)
    return wp.clamp((from_foot - line.start) / line.length, 0.0, 1.0)


@wp.func
def mixture_integral(lobes: Lobes, a: wp.vec3, along: wp.vec3) -> wp.float32:
    """Integrate q of a mixture over an edge (arguments as ``line_integral``'s)."""
    total = wp.float32(0.0)
    if lobes.cosine.share > 0.0:
        line = line_integral(lobes.cosine, a, along)
        total += lobes.cosine.share * line.integral
    if lobes.glossy.share > 0.0:
        line = line_integral(lobes.glossy, a, along)
        total += lobes.glossy.share * line.integral
    if lobes.light.share > 0.0:
        line = line_integral(lobes.light, a, along)
        total += lobes.light.share * line.integral
    if lobes.sphere > 0.0:
        whole = sphere_integral(a, along)
        total += lobes.sphere * whole.integral
    return total


@wp.func
def mixture_density(lobes: Lobes, w: wp.vec3) -> wp.float32:
    """Density of the unit direction w, solid angle."""
    total = wp.float32(0.0)
    if lobes.cosine.share > 0.0:
        total += lobes.cosine.share * lobe_density(lobes.cosine, w)
    if lobes.glossy.share > 0.0:
        total += lobes.glossy.share * lobe_density(lobes.glossy, w)
    if lobes.light.share > 0.0:
        total += lobes.light.share * lobe_density(lobes.light, w)
    return total + INV_FOUR_PI * lobes.sphere


@wp.func
def sample_mixture(lobes: Lobes, a: wp.vec3, along: wp.vec3, u: wp.vec2) -> wp.float32:
    """Draw a fraction of the edge with the density q of the mixture over its integral."""
    cosine = LobeSegment()
    glossy = LobeSegment()
    light = LobeSegment()
    whole = SphereSegment()
    if lobes.cosine.share > 0.0:
        cosine = line_integral(lobes.cosine, a, along)
    if lobes.glossy.share > 0.0:
        glossy = line_integral(lobes.glossy, a, along)
    if lobes.light.share > 0.0:
        light = line_integral(lobes.light, a, along)
    if lobes.sphere > 0.0:
        whole = sphere_integral(a, along)
    first = lobes.cosine.share * cosine.integral
    second = lobes.glossy.share * glossy.integral
    third = lobes.light.share * light.integral
    at = u[0] * (first + second + third + lobes.sphere * whole.integral)
    if at < first:
        return sample_line(cosine, u[1])
    if at < first + second:
        return sample_line(glossy, u[1])
    if at < first + second + third or lobes.sphere == 0.0:
        return sample_line(light, u[1])
    return sample_sphere_line(whole, u[1])


@functools.cache
def make_scattering_lobes(surfaces: SurfaceConfig, lights: LightConfig):
    """Return ``scattering_lobes(at) -> Lobes`` for an interaction.

    The cosine lobe is positive wherever a model is that scatters on its own side only. A rough conductor's lobe lies
    about the mirror direction: a microfacet's slope alpha turns the reflection by 2 alpha in the plane of incidence,
    and by 2 alpha cos(theta_i) across it.
    """
    interaction = make_interaction(surfaces, lights)
    record, slopes = interaction.record, interaction.bsdf.slopes

    @wp.func
    def scattering_lobes(at: record) -> Lobes:
        r = Lobes()
        frame = at.frame
        r.cosine = make_lobe(frame.n, frame.s, 1.0, 1.0, 1.0)
        if wp.static(slopes is not None):
            slope = slopes(at.model, at.material)
            if wp.max(slope[0], slope[1]) > 0.0:
                z = leave_frame(frame, reflect_local(at.wi))
                x = frame.n - wp.dot(frame.n, z) * z
                squared = wp.dot(x, x)
                if squared > 1.0e-8:
                    x = x / wp.sqrt(squared)
                else:
                    x = any_tangent(z)
                width = 2.0 * wp.sqrt(slope[0] * slope[1])
                sx = wp.clamp(width, MIN_SCALE, 1.0)
                sy = wp.clamp(width * wp.max(at.wi[2], MIN_NARROWING), MIN_SCALE, 1.0)
                r.cosine.share = COSINE_SHARE
                r.glossy = make_lobe(z, x, sx, sy, 1.0 - COSINE_SHARE)
        return r

    return scattering_lobes
