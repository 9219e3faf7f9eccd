"""Rays through points of surfaces in float64: who reports no hit up to there has passed the surface.

A point of the surface and a direction give a ray, whose float32 numbers are taken as they are: a change of phi's sign
around the point, in float64, says that the surface is there. A ray that finds nothing up to it has missed it. How deep
such a ray dips below the surface tells whether rounding explains that.

``python -m tests.rays.crossings COUNT [FAR]`` prints what it finds of COUNT rays a body.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import warp as wp

import warp_psdr as psdr
from tests.networks import blob, fitted
from tests.rays import test_curves, test_neuralsdf, test_sdfgrid, test_sdfgrid_cubic
from warp_psdr.scene.kinds.bsplinecurve import coefficients

#: Roundings of float32 by which a ray is uncertain where it is near the surface, over the size of its coordinates.
ROUNDING = 2.0**-22
#: Rays a point of the surface, and rays a launch.
RAYS, BLOCK = 10, 100_000
#: Least sine at which rays meet the surface.
GRAZE = 1.0e-4
#: Points along a ray beside a crossing that was missed, and how far they reach.
DENSE, REACH = 20_000, 1.5


@dataclass
class Body:
    """A shape, and what it is in float64.

    Attributes:
        plugin: of the scene.
        trace: kernel (scene, o, d, out) -> rows of distances (-1: none) and what else it says.
        points: (random, count) -> points of the surface (N, 3), unit normals to the outside, and keys (N, K) of the
            parts that they are on.
        value: (points (N, 3), keys) -> phi of that part (N,), in units of length; NaN where the part has ended.
        columns: of the rows.
        leaves: rays that come from inside are met, too.
    """

    plugin: dict
    trace: wp.Kernel
    points: Callable
    value: Callable
    columns: int
    leaves: bool


@dataclass
class Tally:
    """What rays did."""

    rays: int = 0
    confirmed: int = 0
    missed: int = 0
    deepest: float = 0.0  #: of those that missed, over ``ROUNDING`` times the size of the coordinates
    worst: list = field(default_factory=list)

    def __str__(self) -> str:
        return (
            f"{self.rays} rays, {self.confirmed} cross the surface for sure, {self.missed} of these miss it, the "
            f"deepest by {self.deepest:.2f} roundings {self.worst}"
        )


def unit(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def zero_set(field_of: Callable) -> Callable:
    """Points where a field in [0, 1]^3 is zero, between pairs of points of either sign."""

    def points(random: np.random.Generator, count: int):
        p = random.random((8 * count, 3))
        phi = field_of(p)
        inside, outside = p[phi < 0.0], p[phi >= 0.0]
        a = inside[random.integers(0, len(inside), count)]
        b = outside[random.integers(0, len(outside), count)]
        for _halving in range(45):
            middle = 0.5 * (a + b)
            low = (field_of(middle) < 0.0)[:, None]
            a, b = np.where(low, middle, a), np.where(low, b, middle)
        h = 1e-6
        steps = h * np.eye(3)
        slopes = np.stack([field_of(a + s) - field_of(a - s) for s in steps], axis=1) / (2.0 * h)
        steep = np.linalg.norm(slopes, axis=1)
        kept = steep > 0.05
        return a[kept], slopes[kept] / steep[kept, None], 1.0 / steep[kept, None]

    return points


def boxed(field_of: Callable) -> Callable:
    """Its values over its slope at the crossing; NaN outside of the box."""

    def value(p: np.ndarray, keys: np.ndarray) -> np.ndarray:
        held = ((p >= 0.0) & (p <= 1.0)).all(axis=1)
        return np.where(held, field_of(np.clip(p, 0.0, 1.0)) * keys[:, 0], np.nan)

    return value


def tubes(points: np.ndarray, firsts: np.ndarray):
    """Points and values of tubes about B-splines; key: segment and place."""
    a = coefficients(points.astype(np.float64), firsts)
    joined = set(firsts.tolist())
    opens = np.array([[f - 1 not in joined, f + 1 not in joined] for f in firsts])

    def frame(keys: np.ndarray, v: np.ndarray):
        s, w = a[:, keys[:, 0].astype(int)], v[:, None]
        c = s[0] + w * (s[1] + w * (s[2] + w * s[3]))
        return c, s[1] + w * (2.0 * s[2] + 3.0 * w * s[3]), 2.0 * s[2] + 6.0 * w * s[3]

    def points_of(random: np.random.Generator, count: int):
        keys = np.column_stack([random.integers(0, len(firsts), count), random.random(count)])
        c, slope, bend = frame(keys, keys[:, 1])
        e = unit(np.cross(slope[:, :3], random.standard_normal((count, 3))))
        q = c[:, 3:] * e
        stretch = (slope[:, :3] ** 2).sum(axis=1) - (q * bend[:, :3]).sum(axis=1)
        n = unit(stretch[:, None] * q - (slope[:, 3] * c[:, 3])[:, None] * slope[:, :3])
        kept = (stretch > 0.1 * (slope[:, :3] ** 2).sum(axis=1)) & (c[:, 3] > 1e-4)
        return (c[:, :3] + q)[kept], n[kept], keys[kept]

    def value(p: np.ndarray, keys: np.ndarray) -> np.ndarray:
        v = keys[:, 1].copy()
        for _newton in range(12):
            c, slope, bend = frame(keys, v)
            q = p - c[:, :3]
            stretch = (slope[:, :3] ** 2).sum(axis=1) - (q * bend[:, :3]).sum(axis=1)
            v = np.clip(v + (q * slope[:, :3]).sum(axis=1) / np.where(stretch > 0.0, stretch, np.inf), -0.5, 1.5)
        c, slope, bend = frame(keys, v)
        q = p - c[:, :3]
        stretch = (slope[:, :3] ** 2).sum(axis=1) - (q * bend[:, :3]).sum(axis=1)
        ends = opens[keys[:, 0].astype(int)]
        ended = ((v < 0.0) & ends[:, 0]) | ((v > 1.0) & ends[:, 1]) | (stretch <= 0.0)
        # The neighbour goes on where a segment ends, but not as the same polynomial: a thousandth of it at most.
        ended |= (v < -1e-3) | (v > 1.001)
        return np.where(ended, np.nan, np.linalg.norm(q, axis=1) - c[:, 3])

    return points_of, value


def cones(points: np.ndarray, firsts: np.ndarray):
    """Points and values of straight segments: hulls of two spheres; key: segment."""
    exact = points.astype(np.float64)

    def points_of(random: np.random.Generator, count: int):
        keys = random.integers(0, len(firsts), count)
        x, n = test_curves.on_cones(np.random.default_rng(random.integers(1 << 30)), points, firsts, count)
        # The segment of a point is the one whose surface it is on.
        nearest = np.full(count, np.inf)
        for s in range(len(firsts)):
            phi = np.abs(value(x, np.full((count, 1), s)))
            keys = np.where(phi < nearest, s, keys)
            nearest = np.minimum(nearest, phi)
        kept = (nearest < 1e-9) & np.isfinite(n).all(axis=1)
        return x[kept], n[kept], keys[kept, None]

    def value(p: np.ndarray, keys: np.ndarray) -> np.ndarray:
        i = firsts[keys[:, 0].astype(int)]
        p0, p1 = exact[i], exact[i + 1]
        b, fall = (p1 - p0)[:, :3], (p0 - p1)[:, 3]
        squared = (b * b).sum(axis=1)
        inner = np.maximum(squared - fall**2, 1e-300)
        q = p - p0[:, :3]
        beside = np.linalg.norm(np.cross(q, b), axis=1) / np.sqrt(squared)
        v = np.clip((q * b).sum(axis=1) / squared - beside * fall / np.sqrt(inner * squared), 0.0, 1.0)
        c = p0 + v[:, None] * (p1 - p0)
        return np.linalg.norm(p - c[:, :3], axis=1) - c[:, 3]

    return points_of, value


def grid_body(cubic: bool, random: np.random.Generator) -> Body:
    grid = test_sdfgrid.rough_grid(random)
    if cubic:
        grid = grid + 0.06 * random.standard_normal(grid.shape).astype(np.float32)
    exact, of = grid.astype(np.float64), test_sdfgrid_cubic.spline if cubic else test_sdfgrid.interpolated

    def field_of(p: np.ndarray) -> np.ndarray:
        return of(exact, p)

    more = {"interpolation": "cubic"} if cubic else {}
    plugin = {"type": "sdfgrid", "grid": grid, **more}
    return Body(plugin, test_sdfgrid.trace, zero_set(field_of), boxed(field_of), 7, True)


def network_body() -> Body:
    net = fitted(blob, (32, 32))
    held = [(w.astype(np.float32).astype(np.float64), b.astype(np.float32).astype(np.float64)) for w, b in net.layers]
    net = type(net)(held, net.frequencies, net.sine, net.scale)
    return Body(net.plugin(), test_neuralsdf.trace, zero_set(net.phi), boxed(net.phi), 7, True)


def curve_body(plugin: str, random: np.random.Generator) -> Body:
    points, starts = test_curves.hair(random, plugin, 0.05, 0.03)
    body = {"type": plugin, "control_points": points, "curve_starts": starts}
    held = test_curves.load(plugin, points, starts).description.shapes[0].geometry
    made = (tubes if plugin == "bsplinecurve" else cones)(points, held.firsts)
    return Body(body, test_curves.make_trace(test_curves.KINDS[plugin]), *made, 9, False)


#: Name -> random -> a body.
BODIES: dict[str, Callable[[np.random.Generator], Body]] = {
    "linear grid": lambda random: grid_body(False, random),
    "cubic grid": lambda random: grid_body(True, random),
    "network": lambda _random: network_body(),
    "tubes": lambda random: curve_body("bsplinecurve", random),
    "cones": lambda random: curve_body("linearcurve", random),
}


def directions(random: np.random.Generator, n: np.ndarray, leaves: bool) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions of rays, and the sines at which they meet the surface: any, grazing ones, and those of axes."""
    count = len(n)
    w = unit(random.standard_normal((count, 3)))
    grazing, axis = random.random(count) < 0.5, random.random(count) < 0.1
    tangent = unit(np.cross(n, w))
    sine = np.exp(random.uniform(np.log(GRAZE), np.log(0.3), count))[:, None]
    w = np.where(grazing[:, None], np.sqrt(1.0 - sine**2) * tangent - sine * n, w)
    w = np.where((axis & ~grazing)[:, None], np.eye(3)[random.integers(0, 3, count)], w)
    along = (w * n).sum(axis=1)
    flip = random.random(count) < 0.5 if leaves else along > 0.0
    return np.where(flip[:, None], -w, w), np.abs(along)


def dip(body: Body, o: np.ndarray, d: np.ndarray, key: np.ndarray, t: float, way: float) -> float:
    """Return the largest |phi| along a ray from t on, one way, up to where its sign changes or the part ends."""
    along = t + way * np.linspace(0.0, 1.0, DENSE) ** 3 * REACH
    phi = body.value(o + along[:, None] * d, np.repeat(key[None], DENSE, axis=0))
    gone = np.flatnonzero(np.sign(phi) != np.sign(phi[0]))
    return float(np.abs(phi[: gone[0] if len(gone) else DENSE]).max())


def check(
    body: Body, random: np.random.Generator, count: int, far: float = 1.0, place: tuple = (0.0, 0.0, 0.0)
) -> Tally:
    """Trace rays from .3 to 30 ``far`` away of the body, which may be moved away from the origin of the world."""
    plugin = dict(body.plugin)
    if any(place):
        plugin["to_world"] = psdr.Transform.translate(list(place))
    held = psdr.load_dict(
        {"type": "scene", "sensor": {"type": "perspective"}, "sky": {"type": "constant"}, "body": plugin}
    )
    tally = Tally()
    x, n, keys = body.points(random, max(count // RAYS, 1000))
    for start in range(0, count, BLOCK):
        size = min(BLOCK, count - start)
        k = random.integers(0, len(x), size)
        w, sine = directions(random, n[k], body.leaves)
        away = far * np.exp(random.uniform(np.log(0.3), np.log(30.0), (size, 1)))
        shift = np.array(place) - held.origin
        o = (x[k] - away * w + shift).astype(np.float32)
        exact_o = o.astype(np.float64) - shift
        d = x[k] - exact_o
        t = np.linalg.norm(d, axis=1)
        d = (d / t[:, None]).astype(np.float32)
        exact_d = d.astype(np.float64)
        given = [wp.array(a, dtype=wp.vec3, device=held.device) for a in (o, d)]
        out = wp.zeros((size, body.columns), dtype=wp.float32, device=held.device)
        wp.launch(body.trace, size, inputs=[held.data(), *given], outputs=[out], device=held.device)
        found = out.numpy()[:, 0].astype(np.float64)
        rounding = ROUNDING * (1.0 + t + np.abs(shift).max())
        half = np.minimum(2.0 * rounding / np.maximum(sine, 1e-9), 0.1) + 1e-7
        before = body.value(exact_o + (t - half)[:, None] * exact_d, keys[k])
        behind = body.value(exact_o + (t + half)[:, None] * exact_d, keys[k])
        sure = (before > 0.0) & (behind < 0.0)
        if body.leaves:
            sure |= (before < 0.0) & (behind > 0.0)
        sure &= sine >= 0.99 * GRAZE
        missed = sure & ((found < 0.0) | (found > t + half + rounding))
        tally.rays += size
        tally.confirmed += int(sure.sum())
        tally.missed += int(missed.sum())
        for i in np.flatnonzero(missed):
            # Of a dip that is passed as a whole, the point may be where it begins or where it ends.
            deep = dip(body, exact_o[i], exact_d[i], keys[k[i]], t[i] + half[i], 1.0)
            if body.leaves:
                deep = min(deep, dip(body, exact_o[i], exact_d[i], keys[k[i]], t[i] - half[i], -1.0))
            if deep / rounding[i] > tally.deepest:
                tally.deepest = float(deep / rounding[i])
                tally.worst = [*np.round([found[i], t[i], half[i], sine[i]], 7).tolist(), o[i].tolist(), d[i].tolist()]
    return tally


if __name__ == "__main__":
    number, farther = int(sys.argv[1]), float(sys.argv[2]) if len(sys.argv) > 2 else 1.0
    moved = tuple(map(float, sys.argv[3].split(","))) if len(sys.argv) > 3 else (0.0, 0.0, 0.0)
    for name in sys.argv[4].split(",") if len(sys.argv) > 4 else BODIES:
        rng = np.random.default_rng(number)
        print(name, farther, moved, check(BODIES[name](rng), rng, number, farther, moved), flush=True)
