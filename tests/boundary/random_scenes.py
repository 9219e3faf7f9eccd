"""Scenes drawn at random, full of what discontinuities are made of, each with a motion to be differentiated.

``python -m tests.boundary.random_scenes FIRST LAST`` compares the derivatives of that range with finite differences and
prints a line a scene. What looks wrong is measured again with more samples, for a few batches tell their own error
badly where large samples are rare.

Kernels are compiled for what a scene holds. So that few serve all, every scene comes from one of a few worlds, which
fix the camera, its filter and the lights, and holds a speck of every material out of sight.
"""

import dataclasses
import sys
from collections.abc import Callable

import numpy as np

from .measure import REMAINDER, STANDARD_ERRORS, Case, derivatives, differences, slope
from .mirrors import GLASS, MIRROR, shining
from .scenes import SCENES, SIZE, T, ball, box, diffuse, envmap, floor, load, mesh, register, rough

#: Of the difference: under box filters, edges that leave a pixel within it are a remainder of first order.
STEP = 0.004
#: A slope whose error is larger says nothing.
LARGEST_ERROR = 0.03
#: How often a scene may be measured again, each time with four times the samples.
ROUNDS = 2
#: Camera, filter, kinds of lights, whether the camera sees lights.
WORLDS = (
    ("perspective", "tent", ("ball", "sheet"), False),
    ("perspective", "gaussian", ("constant", "sheet"), False),
    ("perspective", "box", ("sheet", "point"), False),
    ("perspective", "tent", ("spot", "directional"), False),
    ("orthographic", "tent", ("envmap", "ball"), False),
    ("thinlens", "tent", ("sheet", "ball"), False),
    ("perspective", "tent", ("sheet", "ball"), True),
)
WITHOUT_EXTENT = ("point", "spot", "directional")


def color(rgb):
    return {"type": "rgb", "value": [float(c) for c in rgb]}


def direction(random):
    d = random.normal(size=3)
    return d / np.linalg.norm(d)


def sensor(random, kind, rfilter):
    """A camera in front of the shapes that looks at a point near their middle."""
    angle = random.uniform(-0.9, 0.9)
    origin = [3.6 * np.sin(angle), -3.6 * np.cos(angle), random.uniform(0.6, 3.0)]
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": rfilter}}
    pose = T.look_at(origin, list(random.uniform(-0.2, 0.2, 3) + np.array([0.0, 0.0, 0.7])), [0, 0, 1])
    if kind == "orthographic":
        return {"type": kind, "to_world": pose @ T.scale([1.5, 1.5, 1.0]), "film": film}
    lens = {"aperture_radius": 0.1, "focus_distance": 3.6} if kind == "thinlens" else {}
    return {"type": kind, "fov": float(random.uniform(30.0, 45.0)), "to_world": pose, "film": film, **lens}


def light(random, kind):
    """A light above the shapes."""
    at = np.array([*random.uniform(-1.2, 1.2, 2), random.uniform(1.8, 3.0)])
    aim = random.uniform(-0.4, 0.4, 3) + np.array([0.0, 0.0, 0.3])
    rgb = random.uniform(0.6, 1.0, 3)
    if kind == "ball":
        return shining(ball(at, random.uniform(0.2, 0.5), diffuse(0.0)), *(5.0 * rgb))
    if kind == "sheet":
        return shining(sheet(random, at, random.uniform(0.3, 0.6), aim), *(6.0 * rgb))
    if kind == "constant":
        return {"type": kind, "radiance": color(0.8 * rgb)}
    if kind == "envmap":
        return envmap()
    if kind == "point":
        return {"type": kind, "position": at.tolist(), "intensity": color(12.0 * rgb)}
    pose = T.look_at(at.tolist(), aim.tolist(), [0, 1, 0])
    if kind == "spot":
        cone = {"cutoff_angle": float(random.uniform(25.0, 50.0)), "beam_width": 18.0}
        return {"type": kind, "to_world": pose, "intensity": color(18.0 * rgb), **cone}
    return {"type": kind, "to_world": pose, "irradiance": color(2.5 * rgb)}


def sheet(random, center, half, aim=None, bsdf=None):
    """A square, turned at random or towards a point."""
    n = direction(random) if aim is None else (np.asarray(aim) - center) / np.linalg.norm(np.asarray(aim) - center)
    s = np.cross(n, direction(random))
    s /= np.linalg.norm(s)
    t = np.cross(n, s)
    corners = [np.asarray(center) + half * (a * s + b * t) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return mesh(corners, [[0, 1, 2], [0, 2, 3]], bsdf or diffuse(0.0))


def material(random, kinds):
    kind = random.choice(kinds)
    if kind == "mirror":
        return MIRROR
    if kind == "glass":
        return GLASS
    if kind == "rough":
        return rough(float(random.uniform(0.1, 0.4)))
    return diffuse(*random.uniform(0.2, 0.8, 3).tolist())


def wedge(random, center, bsdf, closed):
    """Two rectangles that meet at an acute angle like the pages of a book; ``closed``: the prism between them."""
    angle, length, half = random.uniform(0.15, 0.7), random.uniform(0.5, 1.0), random.uniform(0.3, 0.6)
    x, y, z = np.linalg.qr(random.normal(size=(3, 3)))[0]
    back = center + 0.5 * length * z
    pages = [back + length * (np.sin(a) * x - np.cos(a) * z) for a in (-angle, angle)]
    corners = [corner + side * half * y for side in (-1, 1) for corner in (back, *pages)]
    faces = [[0, 3, 4], [0, 4, 1], [0, 5, 3], [0, 2, 5]]
    if closed:
        faces += [[1, 4, 5], [1, 5, 2], [0, 1, 2], [3, 5, 4]]
        if np.dot(np.cross(x, y), z) < 0.0:
            faces = [face[::-1] for face in faces]
    return mesh(corners, faces, bsdf, face_normals=True)


def shape(random, kinds, flat):
    """A shape somewhere in a cube; it may run through others."""
    center = random.uniform(-0.8, 0.8, 3) + np.array([0.0, 0.0, 0.8])
    form = random.choice(["ball", "ball", "box", "box", "sheet", "book", "prism"])
    if form in ("sheet", "book"):
        bsdf = material(random, [k for k in kinds if k != "glass"])
        bsdf = bsdf if bsdf is MIRROR else {"type": "twosided", "bsdf": bsdf}
        if form == "book":
            return wedge(random, center, bsdf, False)
        return sheet(random, center, random.uniform(0.4, 0.8), bsdf=bsdf)
    bsdf = material(random, kinds)
    if form == "prism":
        return wedge(random, center, bsdf, True)
    if form == "ball":
        smooth = not flat and bool(random.random() < 0.5)
        return ball(center, random.uniform(0.25, 0.5), bsdf, subdivisions=1 + int(smooth), smooth=smooth)
    return box(center, random.uniform(0.15, 0.45, 3), bsdf, random.uniform(0.0, 3.0), bool(random.random() < 0.3))


def specks():
    """A small shape of every kind and material, far below."""
    kinds = [diffuse(0.5), MIRROR, GLASS, rough(0.2), {"type": "twosided", "bsdf": diffuse(0.5)}]
    return {f"speck{i}": ball((0.1 * i, 0.0, -6.0), 0.01, bsdf, smooth=i == 0) for i, bsdf in enumerate(kinds)}


def content(random, camera, rfilter, lights):
    """A dictionary of the scene; smooth shapes are left out under lights without extent (see docs/limits.md)."""
    flat = any(kind in WITHOUT_EXTENT for kind in lights)
    kinds = ["diffuse", "diffuse", "mirror", "mirror", "glass", "rough"]
    shapes = {f"shape{i}": shape(random, kinds, flat) for i in range(int(random.choice([2, 3, 4])))}
    if random.random() < 0.8:
        ground = material(random, ["diffuse", "diffuse", "mirror", "rough"])
        shapes["floor"] = floor(float(random.uniform(-0.3, 0.1)), 2.5, ground)
    return {
        "sensor": sensor(random, camera, rfilter),
        **shapes,
        **{f"light{i}": light(random, kind) for i, kind in enumerate(lights)},
        **specks(),
    }


def motion(random, names):
    """(parameters, tangent): one or two things that move, turn and grow together."""
    parts, axis, shift = random.dirichlet([1, 1, 1]), direction(random), direction(random)
    spin = np.cross(np.eye(3), axis)

    def tangent(values):
        if values.shape[-2:] == (4, 4):
            turned = np.zeros((4, 4))
            turned[:3] = 0.4 * parts[1] * spin @ values[:3]
            turned[:3, 3] += shift
            return turned
        if values.size == 1:
            return np.ones_like(values)
        if values.size == 3:
            return np.broadcast_to(shift, values.shape)
        local = values - values.mean(axis=0)
        return parts[0] * shift + parts[1] * local @ spin.T + parts[2] * local

    movable = [n for n in names if n.endswith((".vertex_positions", ".to_world", ".position", ".eta"))]
    # The floor's pose and its vertices are not independent.
    movable = [n for n in movable if not n.startswith("speck") and n != "floor.vertex_positions"]
    chosen = random.choice(movable, size=1 if random.random() < 0.75 else 2, replace=False)
    return tuple(str(n) for n in chosen), tangent


def draw(seed: int) -> Case:
    """Return the row of a seed; its scene is registered under the name ``random SEED``."""
    random = np.random.default_rng(seed)
    name = f"random {seed}"
    camera, rfilter, lights, hidden = WORLDS[seed % len(WORLDS)]
    described = content(random, camera, rfilter, lights)
    if name not in SCENES:
        register({name: lambda: described})
    glass = any(s.get("bsdf") is GLASS for n, s in described.items() if not n.startswith("speck"))
    depth = int(random.integers(4, 6)) if glass else int(random.integers(2, 5))
    names, tangent = motion(random, load(name)[1])
    return Case(name, names, tangent, STEP, " and ".join(names), depth, 512, 2048, hidden=hidden)


def measure(case: Case, mode: str = "forward") -> tuple[float, float, Case]:
    """Return slope, its error and the row with the samples that it took."""
    for left in reversed(range(ROUNDS + 1)):
        value, error = slope(derivatives(case, mode), differences(case)[2])
        doubtful = abs(value - 1.0) > STANDARD_ERRORS * error + REMAINDER
        hopeless = error > LARGEST_ERROR * 2.0**left
        if left == 0 or hopeless or not (doubtful or error > LARGEST_ERROR):
            break
        case = dataclasses.replace(case, spp=4 * case.spp, difference_spp=4 * case.difference_spp)
    return value, error, case


def measured(drawn: Callable[[int], Case], first: int, last: int) -> None:
    """Print a line for each seed of a range."""
    for seed in range(first, last):
        case = drawn(seed)
        try:
            value, error, case = measure(case)
        except (ValueError, AssertionError) as problem:
            print(f"{seed:5} {case.what}, depth {case.depth}: {str(problem)[:150]}", flush=True)
            continue
        wrong = abs(value - 1.0) > STANDARD_ERRORS * error + REMAINDER
        mark = "***" if wrong else "noisy" if error > LARGEST_ERROR else ""
        print(f"{seed:5} {value:.4f} +- {error:.4f} {mark:5} {case.spp:5} {case.what}, depth {case.depth}", flush=True)


if __name__ == "__main__":
    measured(draw, int(sys.argv[1]), int(sys.argv[2]))
