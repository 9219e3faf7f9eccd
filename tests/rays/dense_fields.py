"""What rays meet, by a dense search in float64: grids, networks, and cones between spheres; see ``dense_grids.py``.

Nothing here is the renderer's: phi is made from its definition, in the box [0, 1]^3, and followed along a ray up to
where the renderer says that it ends, in steps of 1/``STEPS`` of a voxel at most, and of |phi| over a bound of its slope
where that is more: there phi cannot change its sign. Samples that are less, or more, than both of their neighbours are
refined to the extremum between these.

The hull of two spheres is convex, and so is |x - c(v)| - r(v), least over v, as a function of x: along a ray it has one
minimum, which golden sections find.
"""

import functools

import numpy as np
import warp as wp

#: Samples in a voxel along a ray, at least, and how many more there are where a ray starts and ends.
STEPS, ENDS = wp.constant(wp.float64(32.0)), wp.constant(wp.float64(16.0))
#: Golden sections; their share.
SECTIONS, GOLDEN = 60, 0.6180339887498949
#: Numbers of a layer of a network.
WIDE = wp.types.vector(length=64, dtype=wp.float64)


@wp.func
def voxel_at(n: wp.vec3i, q: wp.vec3d) -> tuple[wp.vec3i, wp.vec3d]:
    """The voxel of a point of the box, by x, y and z, and the place in it."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    x = wp.clamp(q[0], zero, one) * wp.float64(n[0] - 1)
    y = wp.clamp(q[1], zero, one) * wp.float64(n[1] - 1)
    z = wp.clamp(q[2], zero, one) * wp.float64(n[2] - 1)
    at = wp.vec3i(wp.min(wp.int32(x), n[0] - 2), wp.min(wp.int32(y), n[1] - 2), wp.min(wp.int32(z), n[2] - 2))
    return at, wp.vec3d(x - wp.float64(at[0]), y - wp.float64(at[1]), z - wp.float64(at[2]))


@wp.func
def linear_field(values: wp.array(dtype=wp.float64), n: wp.vec3i, q: wp.vec3d) -> wp.float64:
    """phi of nodes (x fastest) at a point of the box."""
    one = wp.float64(1.0)
    total = wp.float64(0.0)
    voxel, x = voxel_at(n, q)
    for c in range(2):
        for b in range(2):
            at = ((voxel[2] + c) * n[1] + voxel[1] + b) * n[0] + voxel[0]
            row = values[at] + x[0] * (values[at + 1] - values[at])
            total += row * wp.where(b == 1, x[1], one - x[1]) * wp.where(c == 1, x[2], one - x[2])
    return total


@wp.func
def basis(x: wp.float64, m: wp.int32) -> wp.float64:
    """The uniform cubic B-spline of the m-th of four values around a voxel."""
    y = wp.float64(1.0) - x
    s = wp.where(m < 2, y, x)
    if m == 0 or m == 3:
        return s * s * s / wp.float64(6.0)
    # 1 minus the other three, in the distance from the far side.
    return (wp.float64(1.0) + wp.float64(3.0) * s * (wp.float64(1.0) + s * (wp.float64(1.0) - s))) / wp.float64(6.0)


@wp.func
def cubic_field(values: wp.array(dtype=wp.float64), n: wp.vec3i, q: wp.vec3d) -> wp.float64:
    total = wp.float64(0.0)
    voxel, x = voxel_at(n, q)
    x0 = basis(x[0], 0)
    x1 = basis(x[0], 1)
    x2 = basis(x[0], 2)
    x3 = basis(x[0], 3)
    i = voxel[0]
    left = wp.max(i - 1, 0)
    right = wp.min(i + 2, n[0] - 1)
    for c in range(4):
        plane = wp.clamp(voxel[2] + c - 1, 0, n[2] - 1) * n[1]
        rows = wp.float64(0.0)
        for b in range(4):
            at = (plane + wp.clamp(voxel[1] + b - 1, 0, n[1] - 1)) * n[0]
            row = x0 * values[at + left] + x1 * values[at + i] + x2 * values[at + i + 1] + x3 * values[at + right]
            rows += basis(x[1], b) * row
        total += basis(x[2], c) * rows
    return total


@wp.func
def network_field(values: wp.array(dtype=wp.float64), n: wp.vec3i, q: wp.vec3d) -> wp.float64:
    """phi of a network: layers, frequencies, activation, its number, the widths, then weights and biases by layers."""
    layers = wp.int32(values[0])
    scale = values[3]
    a = WIDE()
    b = WIDE()
    width = wp.int32(3)
    for k in range(3):
        a[k] = wp.clamp(q[k], wp.float64(0.0), wp.float64(1.0))
    turn = wp.float64(3.141592653589793)
    for _f in range(wp.int32(values[1])):
        for k in range(3):
            a[width + k] = wp.sin(turn * a[k])
            a[width + 3 + k] = wp.cos(turn * a[k])
        width += 6
        turn *= wp.float64(2.0)
    at = 4 + layers
    for layer in range(layers):
        rows = wp.int32(values[4 + layer])
        biases = at + rows * width
        for r in range(rows):
            s = values[biases + r]
            for c in range(width):
                s += values[at + c] * a[c]
            at += width
            if layer < layers - 1:
                s *= scale
                if values[2] == wp.float64(1.0):
                    s = wp.sin(s)
                else:
                    s = (wp.max(s, wp.float64(0.0)) + wp.log(wp.float64(1.0) + wp.exp(-wp.abs(s)))) / scale
            b[r] = s
        a = b
        width = rows
        at = biases + rows
    return a[0]


@functools.cache
def make_search(phi: wp.Function) -> wp.Kernel:
    """Return the search along rays o + t d in the box; it writes (N, 5): see ``search``."""

    @wp.kernel(module="unique", enable_backward=False)
    def search(
        values: wp.array(dtype=wp.float64),
        n: wp.vec3i,
        slopes: wp.vec3d,  # largest |dphi/dq| along each axis
        steepest: wp.float64,  # and along any direction
        o: wp.array(dtype=wp.vec3d),
        d: wp.array(dtype=wp.vec3d),
        margin: wp.array(dtype=wp.float64),  # how far within the box rays are for sure
        found: wp.array(dtype=wp.float64),  # distance at which the renderer ends; negative: it meets nothing
        out: wp.array(dtype=wp.float64, ndim=2),  # phi: first, least, most, at the end; 1: the ray meets the box
    ):
        i = wp.tid()
        a = o[i]
        w = d[i]
        near = wp.float64(0.0)
        far = wp.float64(1.0e30)
        rate = wp.float64(0.0)
        fastest = wp.float64(0.0)
        for k in range(3):
            if w[k] != wp.float64(0.0):
                t0 = (margin[i] - a[k]) / w[k]
                t1 = (wp.float64(1.0) - margin[i] - a[k]) / w[k]
                near = wp.max(near, wp.min(t0, t1))
                far = wp.min(far, wp.max(t0, t1))
            elif a[k] < margin[i] or a[k] > wp.float64(1.0) - margin[i]:
                far = wp.float64(-1.0)
            rate += wp.abs(w[k]) * slopes[k]
            fastest = wp.max(fastest, wp.abs(w[k]) * wp.float64(n[k] - 1))
        if found[i] >= wp.float64(0.0):
            out[i, 3] = phi(values, n, a + found[i] * w)
            far = wp.min(far, found[i])
        rate = wp.min(rate, steepest * wp.length(w))
        out[i, 4] = wp.where(near < far, wp.float64(1.0), wp.float64(0.0))
        step = wp.float64(1.0) / (STEPS * fastest)
        t = near
        f = phi(values, n, a + t * w)
        t_before = t
        before = f
        out[i, 0] = f
        least = f
        most = f
        while t < far:
            h = step
            if t - near < step or far - t <= wp.float64(1.0001) * step:
                h = step / ENDS
            t_next = wp.min(t + wp.max(h, wp.abs(f) / rate), far)
            g = phi(values, n, a + t_next * w)
            # An extremum that may be on the other side of zero.
            low = f < before and f <= g
            high = f > before and f >= g
            if (low or high) and wp.abs(f) <= wp.max(wp.abs(before - f), wp.abs(g - f)):
                sign = wp.where(low, wp.float64(1.0), wp.float64(-1.0))
                r0 = t_before
                r1 = t_next
                for _k in range(wp.static(SECTIONS)):
                    s0 = r1 - wp.float64(wp.static(GOLDEN)) * (r1 - r0)
                    s1 = r0 + wp.float64(wp.static(GOLDEN)) * (r1 - r0)
                    if sign * phi(values, n, a + s0 * w) < sign * phi(values, n, a + s1 * w):
                        r1 = s1
                    else:
                        r0 = s0
                best = phi(values, n, a + wp.float64(0.5) * (r0 + r1) * w)
                least = wp.min(least, best)
                most = wp.max(most, best)
            least = wp.min(least, g)
            most = wp.max(most, g)
            t_before = t
            before = f
            t = t_next
            f = g
        out[i, 1] = least
        out[i, 2] = most

    return search


@wp.func
def hull(p: wp.vec3d, p0: wp.vec4d, p1: wp.vec4d) -> wp.float64:
    """|p - c(v)| - r(v), least over v in [0, 1]; c, r linear."""
    b = wp.vec3d(p1[0] - p0[0], p1[1] - p0[1], p1[2] - p0[2])
    q = wp.vec3d(p[0] - p0[0], p[1] - p0[1], p[2] - p0[2])
    length = wp.length(b)
    share = (p1[3] - p0[3]) / length
    high = wp.dot(q, b) / length
    beside = wp.length(wp.cross(q, b)) / length
    rest = wp.float64(1.0) - share * share
    v = wp.where(share > wp.float64(0.0), wp.float64(1.0), wp.float64(0.0))
    if rest > wp.float64(0.0):
        v = wp.clamp((high + beside * share / wp.sqrt(rest)) / length, wp.float64(0.0), wp.float64(1.0))
    return wp.length(q - v * b) - (p0[3] + v * (p1[3] - p0[3]))


@wp.kernel(module="unique", enable_backward=False)
def search_cones(
    points: wp.array(dtype=wp.vec4d),
    firsts: wp.array(dtype=wp.int32),
    o: wp.array(dtype=wp.vec3d),
    d: wp.array(dtype=wp.vec3d),
    margin: wp.array(dtype=wp.float64),
    found: wp.array(dtype=wp.float64),
    out: wp.array(dtype=wp.float64, ndim=2),
):
    """As ``search``, but that each hull counts for itself, from outside."""
    i = wp.tid()
    w = d[i]
    squared = wp.dot(w, w)
    least = wp.float64(0.0)
    off = wp.float64(1.0e30)
    for s in range(firsts.shape[0]):
        p0 = points[firsts[s]]
        p1 = points[firsts[s] + 1]
        middle = wp.float64(0.5) * (p0 + p1)
        q = wp.vec3d(middle[0], middle[1], middle[2]) - o[i]
        edge = p1 - p0
        edge[3] = wp.float64(0.0)
        reach = wp.float64(0.5) * wp.length(edge) + wp.max(p0[3], p1[3])
        along = wp.dot(q, w) / squared
        height = hull(o[i], p0, p1)
        if found[i] >= wp.float64(0.0) and height > -margin[i]:
            beyond = hull(o[i] + found[i] * w, p0, p1)
            if wp.abs(beyond) < wp.abs(off):
                off = beyond
        if wp.length(q - along * w) < reach:
            half = reach / wp.sqrt(squared)
            r0 = wp.max(along - half, wp.float64(0.0))
            r1 = along + half
            if found[i] >= wp.float64(0.0):
                r1 = wp.min(r1, found[i])
            if r0 < r1 and height > margin[i]:
                for _k in range(wp.static(SECTIONS)):
                    s0 = r1 - wp.float64(wp.static(GOLDEN)) * (r1 - r0)
                    s1 = r0 + wp.float64(wp.static(GOLDEN)) * (r1 - r0)
                    if hull(o[i] + s0 * w, p0, p1) < hull(o[i] + s1 * w, p0, p1):
                        r1 = s1
                    else:
                        r0 = s0
                least = wp.min(least, hull(o[i] + wp.float64(0.5) * (r0 + r1) * w, p0, p1))
    out[i, 0] = wp.float64(1.0e30)
    out[i, 1] = least
    out[i, 3] = off
    out[i, 4] = wp.float64(1.0)


def launch(kernel: wp.Kernel, head: list, o: np.ndarray, d: np.ndarray, *numbers: np.ndarray) -> np.ndarray:
    out = wp.zeros((len(o), 5), dtype=wp.float64, device="cpu")
    rays = [wp.array(a, dtype=wp.vec3d, device="cpu") for a in (o, d)]
    rays += [wp.array(x, dtype=wp.float64, device="cpu") for x in numbers]
    wp.launch(kernel, len(o), inputs=[*head, *rays], outputs=[out], device="cpu")
    return out.numpy()
