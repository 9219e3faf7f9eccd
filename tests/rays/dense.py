"""Random rays against tubes about single B-splines and short chains of them, in float64, circle by circle.

The plane of the circle at v cuts a ray at one point; where that comes to lie inside of the circle, on the way along the
ray, the ray enters the tube. Between ``STEPS`` places along a segment every such change of sign is found, and halved
down to rounding; where the plane holds the ray's direction, the way turns. A ray that reports nothing up to there has
missed the tube. How deep it dips below the surface tells whether rounding explains that.

``python -m tests.rays.dense COUNT [RADIUS BEND]`` prints what it finds of COUNT rays.
"""

import sys

import numpy as np
import warp as wp

from tests.rays import test_curves
from tests.rays.crossings import ROUNDING, Body, Tally, dip, tubes, unit
from warp_psdr.scene.kinds.bsplinecurve import coefficients

#: Places along a segment between which signs are compared, and halvings of what lies between two.
STEPS, HALVINGS = 2000, 50
#: Rays a chain.
BLOCK = 20_000
#: How much later than the oracle a ray may be for its entry to be found, in radii: deeper dips are looked at.
LATE = 0.01


def chain(random: np.random.Generator, segments: int, radius: float, bend: float) -> np.ndarray:
    """Return control points (segments + 3, 4) of a tapered chain about the origin, of steps of 1 / segments."""
    count = segments + 3
    places = np.cumsum(unit(random.standard_normal(3)) + bend * random.standard_normal((count, 3)), axis=0) / segments
    places -= places.mean(axis=0)
    return np.column_stack([places, radius / segments * np.linspace(1.0, random.uniform(0.3, 1.5), count)]).astype(
        np.float32
    )


def rays(random: np.random.Generator, points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return origins and unit directions of rays past the chain: from around it, a half of them nearly along it."""
    exact = points.astype(np.float64)
    at = random.integers(1, len(points) - 2, count)
    share = random.random((count, 1))
    middle = (1.0 - share) * exact[at] + share * exact[at + 1]
    aim = middle[:, :3] + 1.5 * middle[:, 3:] * random.uniform(-1.0, 1.0, (count, 3))
    along = unit(exact[at + 1, :3] - exact[at, :3])
    lean = np.exp(random.uniform(np.log(1e-3), 0.0, (count, 1)))
    near = unit(
        along * np.where(random.random((count, 1)) < 0.5, 1.0, -1.0) + lean * random.standard_normal((count, 3))
    )
    way = np.where(random.random((count, 1)) < 0.5, near, unit(random.standard_normal((count, 3))))
    o = (aim - way * random.uniform(0.2, 3.0, (count, 1))).astype(np.float32)
    d = unit(aim - o).astype(np.float32)
    return o, d


@wp.func
def cut(a: wp.array(dtype=wp.vec4d, ndim=2), s: wp.int32, o: wp.vec3d, d: wp.vec3d, v: wp.float64) -> wp.vec3d:
    """Where the plane of a circle cuts a ray: t; the distance from the axis there, less the radius; and d . c'."""
    c = a[s, 0] + v * (a[s, 1] + v * (a[s, 2] + v * a[s, 3]))
    slope = a[s, 1] + v * (wp.float64(2.0) * a[s, 2] + (wp.float64(3.0) * v) * a[s, 3])
    axis = wp.vec3d(slope[0], slope[1], slope[2])
    q = wp.vec3d(c[0], c[1], c[2]) - o
    ahead = wp.dot(axis, d)
    t = wp.dot(q, axis) / ahead
    return wp.vec3d(t, wp.length(t * d - q) - c[3], ahead)


@wp.kernel(module="unique", enable_backward=False)
def first_entries(
    a: wp.array(dtype=wp.vec4d, ndim=2),
    origins: wp.array(dtype=wp.vec3d),
    ways: wp.array(dtype=wp.vec3d),
    out: wp.array(dtype=wp.vec3d),
):
    """Where rays first enter any segment: t, -1 if they do not, the segment, and v."""
    i = wp.tid()
    o = origins[i]
    d = ways[i]
    zero = wp.float64(0.0)
    first = wp.vec3d(wp.float64(-1.0), zero, zero)
    for s in range(a.shape[0]):
        before = cut(a, s, o, d, zero)
        for k in range(1, wp.static(STEPS + 1)):
            high = wp.float64(k) / wp.float64(wp.static(STEPS))
            low = wp.float64(k - 1) / wp.float64(wp.static(STEPS))
            at = cut(a, s, o, d, high)
            forth = before[2] > zero and at[2] > zero and before[1] > zero and at[1] <= zero
            back = before[2] < zero and at[2] < zero and before[1] <= zero and at[1] > zero
            if forth or back:
                outside = wp.where(forth, low, high)
                inside = wp.where(forth, high, low)
                for _halving in range(wp.static(HALVINGS)):
                    middle = wp.float64(0.5) * (outside + inside)
                    if cut(a, s, o, d, middle)[1] < zero:
                        inside = middle
                    else:
                        outside = middle
                t = cut(a, s, o, d, inside)[0]
                if t > zero and (first[0] < zero or t < first[0]):
                    first = wp.vec3d(t, wp.float64(s), inside)
            before = at
    out[i] = first


def check(random: np.random.Generator, count: int, radius: float = 0.15, bend: float = 0.2) -> Tally:
    """Trace random rays past a chain of one to three segments, one chain for every ``BLOCK`` of them."""
    tally = Tally()
    for start in range(0, count, BLOCK):
        size = min(BLOCK, count - start)
        points = chain(random, int(random.integers(1, 4)), radius, bend)
        scene = test_curves.load("bsplinecurve", points, [0])
        curves = scene.description.shapes[0].geometry
        o, d = rays(random, points, size)
        shifted = (o - scene.origin).astype(np.float32)
        given = [wp.array(x, dtype=wp.vec3, device=scene.device) for x in (shifted, d)]
        out = wp.zeros((size, 9), dtype=wp.float32, device=scene.device)
        trace = test_curves.make_trace(test_curves.KINDS["bsplinecurve"])
        wp.launch(trace, size, inputs=[scene.data(), *given], outputs=[out], device=scene.device)
        a = coefficients(points.astype(np.float64), curves.firsts)
        held = wp.array(a.transpose(1, 0, 2), dtype=wp.vec4d, device=scene.device)
        exact_o, exact_d = shifted.astype(np.float64) + scene.origin, d.astype(np.float64)
        doubled = [wp.array(x, dtype=wp.vec3d, device=scene.device) for x in (exact_o, exact_d)]
        exact = wp.zeros(size, dtype=wp.vec3d, device=scene.device)
        wp.launch(first_entries, size, inputs=[held, *doubled], outputs=[exact], device=scene.device)
        found, (t, segment, v) = out.numpy()[:, 0].astype(np.float64), exact.numpy().T
        tally.rays += size
        tally.confirmed += int((t > 0.0).sum())
        rounding = ROUNDING * (1.0 + np.abs(exact_o).max(axis=1))
        body = Body({}, trace, *tubes(points, curves.firsts), 9, False)
        late = np.flatnonzero((t > 0.0) & ((found < 0.0) | (found > t + LATE * points[:, 3].max())))
        for i in late:
            deep = dip(body, exact_o[i], exact_d[i], np.array([segment[i], v[i]]), t[i], 1.0) / rounding[i]
            tally.missed += int(deep > 1.0)
            if deep > tally.deepest:
                tally.deepest = deep
                tally.worst = [found[i], t[i], v[i], segment[i], o[i].tolist(), d[i].tolist(), points.tolist()]
    return tally


if __name__ == "__main__":
    number = int(sys.argv[1])
    shape = tuple(map(float, sys.argv[2:4]))
    print(check(np.random.default_rng(number), number, *shape), flush=True)
