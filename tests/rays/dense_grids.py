"""Rays at random against a dense search in float64 (``dense_fields.py``): grids, networks, and cones between spheres.

A ray carries the sign that phi has where it starts, or enters the box. The largest |phi| of the other sign, up to where
the renderer says that the ray ends, is how deep it has passed through the surface; |phi| at the hit is how far that is
off it. Both are counted in roundings of float32: ``ROUNDING`` of the coordinates' size, at the largest slope of phi,
and of the numbers that add up to phi.

``python -m tests.rays.dense_grids COUNT [KINDS]`` prints what it finds of COUNT rays a kind.
"""

import functools
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import warp as wp

import warp_psdr as psdr
from tests.networks import blob, fitted, neck
from tests.rays import test_curves, test_neuralsdf, test_sdfgrid
from tests.rays.crossings import unit, zero_set
from tests.rays.dense_fields import cubic_field, launch, linear_field, make_search, network_field, search_cones

#: A rounding of float32, over the size of numbers.
ROUNDING = 2.0**-22
#: Rays of one body.
BLOCK = 100_000


@dataclass
class Body:
    """A shape, and what it is in float64.

    Attributes:
        plugin: of the scene.
        trace: kernel (scene, o, d, out) of the renderer; the first number of a row is the distance, -1: none.
        columns: numbers of a row.
        search: (o (N, 3), d (N, 3), margin (N,), found (N,)) -> rows (N, 5) of ``make_search``.
        surface: (random, count) -> points of the surface and their unit normals, (N, 3).
        nodes: points (K, 3) at which rays aim, and through two of which they pass.
        low, high: the box.
        slope: largest of |grad phi|.
        scale: size of the numbers that add up to phi.
    """

    plugin: dict
    trace: wp.Kernel
    columns: int
    search: Callable
    surface: Callable
    nodes: np.ndarray
    slope: float
    scale: float
    low: np.ndarray = field(default_factory=lambda: np.zeros(3))
    high: np.ndarray = field(default_factory=lambda: np.ones(3))


def boxed(
    phi: wp.Function, values: np.ndarray, n: tuple[int, int, int], slopes: np.ndarray, steepest: float
) -> tuple[Callable, Callable]:
    """Return ``search`` and ``surface`` of a ``Body`` in the box; ``n``: nodes along x, y, z."""
    held = wp.array(values, dtype=wp.float64, device="cpu")

    def search(*rays: np.ndarray) -> np.ndarray:
        return launch(make_search(phi), [held, wp.vec3i(*n), wp.vec3d(*slopes), steepest], *rays)

    def at(p: np.ndarray) -> np.ndarray:
        # A ray that ends where it starts.
        return search(p, np.ones_like(p), *np.zeros((2, len(p))))[:, 3]

    return search, lambda random, count: zero_set(at)(random, count)[:2]


def grid_body(cubic: bool, random: np.random.Generator) -> Body:
    """Rough, smooth, and of a few random numbers; of many sizes along the axes."""
    choice = random.integers(0, 5)
    if choice < 2:
        shape = tuple(random.integers(2, 5, 3)) if choice else (2, 2, 2)
        grid = random.standard_normal(shape)
    else:
        shape = (33, 33, 33) if choice == 2 else tuple(random.integers(5, 40, 3))
        at = np.stack(np.meshgrid(*(np.linspace(0.0, 1.0, n) for n in shape), indexing="ij")[::-1], axis=-1)
        noise = (0.0, 0.02, 0.1)[choice - 2] if cubic else (0.0, 0.003, 0.03)[choice - 2]
        grid = (blob if random.random() < 0.5 else neck)(at) + noise * random.standard_normal(shape)
    # Both signs, near and far from the border.
    grid = (grid - 0.5 * (grid.min() + grid.max()) * (choice < 2)).astype(np.float32)
    n = grid.shape[::-1]
    steepest = [np.abs(np.diff(grid.astype(np.float64), axis=2 - k)).max() * (n[k] - 1) for k in range(3)]
    slope, field_of = float(np.linalg.norm(steepest)), cubic_field if cubic else linear_field
    search, surface = boxed(field_of, grid.reshape(-1), n, np.array(steepest), slope)
    plugin = {"type": "sdfgrid", "grid": grid, **({"interpolation": "cubic"} if cubic else {})}
    if random.random() < 0.5:
        turn = psdr.Transform.rotate([1, 2, 3], 360.0 * random.random()).scale(random.uniform(0.5, 2.0, 3).tolist())
        plugin["to_world"] = turn
    nodes = np.argwhere(np.ones(n)) / (np.array(n) - 1)
    return Body(plugin, test_sdfgrid.trace, 7, search, surface, nodes, slope, float(np.abs(grid).max()))


def network_body(random: np.random.Generator) -> Body:
    net = (
        fitted(blob, (32, 32)),
        fitted(blob, (16, 16), 0, False, 50.0),
        fitted(neck, (16, 16), 0, True, 3.0, 1.5),
        fitted(neck, (12, 16), 2, False, 20.0),
    )[random.integers(0, 4)]
    widths = [len(bias) for _weight, bias in net.layers]
    values = [len(widths), net.frequencies, net.sine, net.scale, *widths]
    for weight, bias in net.layers:
        values += [*weight.astype(np.float32).reshape(-1), *bias.astype(np.float32)]
    p, h = random.random((20_000, 3)), 1e-5
    slopes = np.abs([net.phi(p + e) - net.phi(p - e) for e in h * np.eye(3)]) / (2.0 * h)
    slope = float(np.linalg.norm(slopes, axis=0).max())
    # Samples alone know the slope: a quarter of it more.
    most, held = 1.25 * slopes.max(axis=1), np.array(values, dtype=np.float64)
    search, surface = boxed(network_field, held, (33, 33, 33), most, 1.25 * slope)
    weight, bias = net.layers[-1]
    scale = float((np.abs(net.hidden(p)) @ np.abs(weight[0]) + np.abs(bias[0])).max())
    nodes = np.argwhere(np.ones((33, 33, 33))) / 32.0
    return Body(net.plugin(), test_neuralsdf.trace, 7, search, surface, nodes, slope, scale)


@functools.cache
def cone_trace() -> wp.Kernel:
    return test_curves.make_trace(test_curves.KINDS["linearcurve"])


def cone_body(random: np.random.Generator) -> Body:
    return cones_of(*test_curves.hair(random, "linearcurve", float(np.exp(random.uniform(-5.0, -2.0))), 0.05))


def cones_of(points: np.ndarray, starts: list[int]) -> Body:
    body = {"type": "linearcurve", "control_points": points, "curve_starts": starts}
    firsts = test_curves.load("linearcurve", points, starts).description.shapes[0].geometry.firsts
    head = [wp.array(points, dtype=wp.vec4d, device="cpu"), wp.array(firsts, dtype=wp.int32, device="cpu")]

    def search(*rays: np.ndarray) -> np.ndarray:
        return launch(search_cones, head, *rays)

    def surface(random: np.random.Generator, count: int):
        x, n = test_curves.on_cones(random, points, firsts, count)
        kept = np.isfinite(n).all(axis=1)
        return x[kept], n[kept]

    nodes = points[:, :3].astype(np.float64)
    low, high = nodes.min(axis=0) - 0.1, nodes.max(axis=0) + 0.1
    return Body(body, cone_trace(), 9, search, surface, nodes, 1.0, 0.0, low, high)


#: Kind -> random -> a body.
KINDS: dict[str, Callable[[np.random.Generator], Body]] = {
    "linear": functools.partial(grid_body, False),
    "cubic": functools.partial(grid_body, True),
    "network": network_body,
    "cones": cone_body,
}


def make_rays(body: Body, random: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return origins and directions in front of the pose, (N, 3): families of rays, one after the other."""
    size = body.high - body.low
    towards = body.low + size * random.random((count, 3))
    family = random.integers(0, 8, count)
    points, normals = body.surface(random, 1000 + count // 10)
    some = random.integers(0, len(points), count)
    pick, second = random.integers(0, len(body.nodes), (2, count))
    second = np.where(random.random(count) < 0.5, (pick + 1) % len(body.nodes), second)
    node, other = body.nodes[pick], body.nodes[second]
    w = unit(random.standard_normal((count, 3)))
    away = np.exp(random.uniform(np.log(0.3), np.log(30.0), (count, 1)))
    # Through the box from near (0), and from far away (1); at points of the surface (2), and at nodes (3).
    away[family == 1] *= random.choice([30.0, 300.0], (count, 1))[family == 1]
    aim = np.where((family == 2)[:, None], points[some], np.where((family == 3)[:, None], node, towards))
    # Along the surface (4), below or above it by next to nothing.
    tangent = unit(np.cross(normals[some], w))
    sine, height = 10.0 ** random.uniform(-7.0, -1.0, (2, count, 1))
    graze = (family == 4)[:, None]
    sign = random.choice([-1.0, 1.0], (2, count, 1))
    aim = np.where(graze, points[some] + 0.1 * sign[0] * height * normals[some], aim)
    w = np.where(graze, unit(tangent + sign[1] * sine * normals[some]), w)
    # Along an axis (5), half of them at nodes, or across one (6), where another coordinate is a node's.
    axis, still = np.eye(3)[random.integers(0, 3, (2, count))]
    aim = np.where(((family == 5) & (random.random(count) < 0.5))[:, None], node, aim)
    across = (family == 6)[:, None]
    aim = np.where(across & (still == 1.0), node, aim)
    w = np.where(across, unit(w * (1.0 - still)), w)
    w = np.where((family == 5)[:, None], axis * sign[0], w)
    # Through two nodes (7), or nearly so, half of them neighbours: along edges of voxels, and the axes of cones.
    through = (family == 7)[:, None] & (np.abs(node - other).max(axis=1) > 0.0)[:, None]
    aim = np.where(through, node, aim)
    tilt = sine * (random.random((count, 1)) < 0.5)
    w = np.where(through, unit(unit(other - node + 1e-9) + tilt * w), w)
    # A fifth start inside of the box.
    away = np.where((random.random(count) < 0.2)[:, None] & (family != 1)[:, None], 0.3 * away / 30.0, away)
    return aim - away * w, w


@dataclass
class Tally:
    """What rays did; depths in roundings."""

    rays: int = 0
    met: int = 0  #: they meet something
    unmet: int = 0  #: they meet nothing, and pass through the surface, however little
    missed: int = 0  #: they pass by more than one rounding
    deepest: float = 0.0  #: of those that pass
    passed: list = field(default_factory=list)  #: the distance, the origin and the direction of that one
    farthest: float = 0.0  #: of hits from the surface
    strayed: list = field(default_factory=list)


def traced(body: Body, random: np.random.Generator, count: int, rays: Callable = make_rays) -> tuple[np.ndarray, ...]:
    """Trace rays; return origins and directions in front of the pose, float64, distances (-1: none), and roundings."""
    held = psdr.load_dict(
        {"type": "scene", "sensor": {"type": "perspective"}, "sky": {"type": "constant"}, "body": body.plugin}
    )
    record = held.triangles.numpy()[0]
    a = np.stack([record["p0"], record["p1"], record["p2"]], axis=1).astype(np.float64)
    b = record["normal"].astype(np.float64)
    if body.plugin["type"] == "linearcurve":
        a, b = np.eye(3), -held.origin
    o, d = rays(body, random, count)
    o, d = (o @ a.T + b).astype(np.float32), unit(d @ a.T).astype(np.float32)
    given = [wp.array(x, dtype=wp.vec3, device=held.device) for x in (o, d)]
    out = wp.zeros((count, body.columns), dtype=wp.float32, device=held.device)
    wp.launch(body.trace, count, inputs=[held.data(), *given], outputs=[out], device=held.device)
    exact_o, exact_d = (np.linalg.solve(a, x.astype(np.float64).T).T for x in (o - b, d))
    moved = ROUNDING * (1.0 + np.abs(exact_o).max(axis=1)) * np.linalg.cond(a)
    return exact_o, exact_d, out.numpy()[:, 0].astype(np.float64), moved


def depths(body: Body, o: np.ndarray, d: np.ndarray, found: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, ...]:
    """How deep rays have passed through the surface, and how far their hits are from it, (N,), in roundings."""
    first, least, most, end, meets = body.search(o, d, moved, found).T
    rounding = moved * body.slope + ROUNDING * body.scale
    # The sign that a ray carries from where it starts; either one where that is rounding.
    from_outside = np.where(first > -rounding, -least, np.inf)
    from_inside = np.where(first < rounding, most, np.inf)
    deep = np.minimum(from_outside, from_inside) * meets
    return deep / rounding, np.where(found >= 0.0, np.abs(end), 0.0) / rounding


def check(body: Body, random: np.random.Generator, count: int, tally: Tally) -> None:
    """Trace ``count`` rays, and add what they did to a tally."""
    o, d, found, moved = traced(body, random, count)
    deep, off = depths(body, o, d, found, moved)
    tally.rays += count
    tally.met += int((found >= 0.0).sum())
    tally.unmet += int(((found < 0.0) & (deep > 0.0)).sum())
    tally.missed += int((deep > 1.0).sum())
    rays = [found, *o.T, *d.T]
    if deep.max() > tally.deepest:
        tally.deepest, tally.passed = float(deep.max()), [float(x[deep.argmax()]) for x in rays]
    if off.max() > tally.farthest:
        tally.farthest, tally.strayed = float(off.max()), [float(x[off.argmax()]) for x in rays]


if __name__ == "__main__":
    number = int(sys.argv[1])
    for kind in sys.argv[2].split(",") if len(sys.argv) > 2 else KINDS:
        rng, total, began = np.random.default_rng(number), Tally(), time.process_time()
        for start in range(0, number, BLOCK):
            check(KINDS[kind](rng), rng, min(BLOCK, number - start), total)
            if total.rays % (10 * BLOCK) == 0 or total.rays == number:
                print(kind, total, f"{time.process_time() - began:.0f} s", flush=True)
