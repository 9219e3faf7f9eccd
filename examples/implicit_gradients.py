"""Draws the derivative of one image by the radius of a ball that is held in five ways, term by term.

    python examples/implicit_gradients.py

The ball hangs over a floor under a square lamp, as a mesh with flat faces, a linear and a cubic grid of signed
distances, an exact sphere, and a network of signed distances. All five grow at the same speed, so the derivative of
the image is the same up to facets, and every column agrees with finite differences of its own images. What differs is
which term it is made of: the shading of round surfaces changes at points that are seen (*interior*), that of flat
facets jumps where creases pass; outlines and shadows are those of *smooth silhouettes* or of *edges and creases*, and
of a linear grid most are creases (``docs/theory/implicit.md``).

Leaves ``implicit_gradients.png`` in ``out/examples/`` and prints slopes against finite differences.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

import warp_psdr as psdr
from warp_psdr import plots

ROOT = Path(__file__).resolve().parents[1]
T = psdr.Transform
INTEGRATOR = psdr.PathIntegrator(max_depth=2)
#: Of the ball, world units; side of the box around grids and networks; radius in that box.
RADIUS, CENTER, SIDE = 0.4, np.array([0.05, 0.0, 0.7]), 1.2
INNER = RADIUS / SIDE
#: Nodes along a side of the grids, subdivisions of the mesh.
LINEAR, CUBIC, SUBDIVISIONS = 17, 33, 3
#: Frequency of the network's three sines: a sum of 1 - cos is a sum of squares, up to a part of OMEGA^2 r^2 / 12.
OMEGA = 0.6
#: Step of the differences, world units, and seeds whose images are averaged.
STEP, BATCHES = 0.004, 4
ROWS = ("finite differences", "all terms", "interior", "smooth silhouettes", "edges and creases")
UNIT = "d radiance / d radius [W/m²/sr per unit of length]"


def distances(count: int) -> np.ndarray:
    """Return distances to the centre at the nodes of a grid, (Z, Y, X), of the box [0, 1]^3."""
    at = np.linspace(-0.5, 0.5, count)
    return np.sqrt(sum(a * a for a in np.meshgrid(at, at, at, indexing="ij")))


def columns() -> dict[str, tuple[dict, str, Callable[[np.ndarray], np.ndarray]]]:
    """Return name -> (the shape, its parameter, values -> direction in which the radius grows by 1)."""
    mesh = trimesh.creation.icosphere(subdivisions=SUBDIVISIONS)
    box = {"to_world": T.translate(list(CENTER - 0.5 * SIDE)) @ T.scale(SIDE)}
    # A B-spline of distances is smaller by h^2 / (3 r).
    shrunk = 1.0 / (3.0 * INNER * (CUBIC - 1) ** 2)
    network = {
        "type": "neuralsdf",
        "activation": "sine",
        "omega": OMEGA,
        "layer0.weight": np.eye(3),
        "layer0.bias": np.full(3, 0.5 * np.pi / OMEGA - 0.5),
        "layer1.weight": np.full((1, 3), -2.0 / OMEGA**2),
        "layer1.bias": np.array([6.0 / OMEGA**2 - INNER**2]),
    }

    def outwards(vertices: np.ndarray) -> np.ndarray:
        return (vertices - CENTER) / np.linalg.norm(vertices - CENTER, axis=1)[:, None]

    def wider(pose: np.ndarray) -> np.ndarray:
        return np.diag([1.0, 1.0, 1.0, 0.0]).astype(pose.dtype)

    def lower(values: np.ndarray) -> np.ndarray:
        return np.full_like(values, -1.0 / SIDE)

    vertices = np.float32(RADIUS * mesh.vertices + CENTER)
    return {
        "mesh, flat faces": (
            {"type": "mesh", "vertices": vertices, "faces": mesh.faces, "face_normals": True},
            "vertex_positions",
            outwards,
        ),
        "linear grid": (
            {"type": "sdfgrid", "grid": np.float32(distances(LINEAR) - INNER), "normals": "analytic", **box},
            "grid",
            lower,
        ),
        "cubic grid": (
            {
                "type": "sdfgrid",
                "grid": np.float32(distances(CUBIC) - INNER - shrunk),
                "interpolation": "cubic",
                **box,
            },
            "grid",
            lower,
        ),
        "exact sphere": (
            {"type": "sphere", "exact": True, "to_world": T.translate(list(CENTER)) @ T.scale(RADIUS)},
            "to_world",
            wider,
        ),
        # The slope of phi is twice the radius.
        "network": (network | box, "layer1.bias", lambda bias: np.full_like(bias, -2.0 * INNER / SIDE)),
    }


def scene_of(shape: dict, resolution: int) -> psdr.Scene:
    """Return the ball over a floor under a lamp."""
    square = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": [8.0, 7.2, 6.4]}}
    film = {"type": "hdrfilm", "width": resolution, "height": resolution, "rfilter": {"type": "tent"}}

    def paint(*value: float) -> dict:
        return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(value)}}

    view = T.look_at([0.3, -3.0, 2.0], [0.0, 0.0, 0.4], [0, 0, 1])
    return psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 45.0, "to_world": view, "film": film},
            "floor": {"type": "rectangle", "to_world": T.scale(2.0), "bsdf": paint(0.7, 0.6, 0.5)},
            "ball": shape | {"bsdf": paint(0.7, 0.5, 0.3)},
            "light": {
                "type": "mesh",
                "vertices": np.float32(0.4 * square + np.array([0.8, -0.8, 2.5])),
                "faces": np.array([[0, 2, 1], [0, 3, 2]]),
                "bsdf": paint(0.0, 0.0, 0.0),
                "emitter": emitter,
            },
        }
    )


def derivatives(
    shape: dict, parameter: str, motion: Callable, resolution: int, spp: int, difference_spp: int
) -> tuple[list[np.ndarray], float, float]:
    """Return the images of ``ROWS``, and the slope of all terms against differences with its standard error."""
    scene, name = scene_of(shape, resolution), f"ball.{parameter}"
    params = psdr.traverse(scene)
    base = params[name].numpy().copy()
    tangent = motion(base)

    def image(step: float, seed: int) -> np.ndarray:
        params[name] = base + np.float32(step) * tangent
        params.update()
        return psdr.render(scene, integrator=INTEGRATOR, spp=difference_spp, seed=seed).numpy().astype(np.float64)

    differences = np.array([(image(STEP, s) - image(-STEP, s)) / (2.0 * STEP) for s in range(BATCHES)])
    params[name] = base
    params.update()
    found = [
        psdr.render_parts(scene, params, {name: tangent}, integrator=INTEGRATOR, spp=spp, seed=100 + s)
        for s in range(BATCHES)
    ]
    parts = {key: np.array([f[key].numpy() for f in found], np.float64) for key in found[0]}
    total = sum(parts.values())
    # Weights whose noise neither of the two has.
    weights = psdr.render_forward(scene, params, {name: tangent}, integrator=INTEGRATOR, spp=spp, seed=99).numpy()
    a, b = ((weights * images).sum(axis=(1, 2, 3)) for images in (total, differences))
    error = np.hypot(a.std(ddof=1), b.std(ddof=1)) / np.sqrt(BATCHES) / abs(b.mean())
    images = [differences, total, parts["interior"], parts["smooth"], parts["edges"]]
    return [i.mean(axis=0) for i in images], float(a.mean() / b.mean()), float(error)


def draw(path: Path, names: list[str], drawn: list[list[np.ndarray]], slopes: list[tuple[float, float]]) -> None:
    """Draw one row a term and one column a shape, in one range of colours."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    values = np.array([[image.mean(axis=-1) for image in column] for column in drawn])
    limit = plots.symmetric_limit(values[:, 1], 99.0)
    figure = Figure(figsize=(2.0 * len(names) + 1.6, 2.05 * len(ROWS) + 0.4), dpi=90, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(ROWS), len(names), squeeze=False)
    for c, (name, (slope, error)) in enumerate(zip(names, slopes, strict=True)):
        for r, row in enumerate(ROWS):
            panel = axes[r, c]
            shown = panel.imshow(
                values[c, r], cmap=plots.diverging_colormap(), vmin=-limit, vmax=limit, interpolation="nearest"
            )
            panel.set(xticks=[], yticks=[])
            if r == 0:
                panel.set_title(f"{name}\nslope {slope:.3f} ± {error:.3f}", fontsize=9)
            if c == 0:
                panel.set_ylabel(row, fontsize=9)
    bar = figure.colorbar(shown, ax=axes, extend="both", shrink=0.5, pad=0.01)
    bar.set_label(f"{UNIT},\nmean of RGB", fontsize=8)
    plots.write_picture(path, lambda file: figure.savefig(file, format="png"))


def main(
    folder: Path = ROOT / "out" / "examples",
    resolution: int = 48,
    spp: int = 128,
    difference_spp: int = 512,
    only: tuple[str, ...] = (),
) -> dict[str, tuple[float, float]]:
    """Draw the picture; return name -> slope against finite differences and its standard error."""
    folder.mkdir(parents=True, exist_ok=True)
    drawn, slopes = [], {}
    for name, (shape, parameter, motion) in columns().items():
        if only and name not in only:
            continue
        images, slope, error = derivatives(shape, parameter, motion, resolution, spp, difference_spp)
        drawn.append(images)
        slopes[name] = (slope, error)
        print(f"{name}: slope against finite differences {slope:.4f} ± {error:.4f}", flush=True)
    draw(folder / "implicit_gradients.png", list(slopes), drawn, list(slopes.values()))
    print(f"wrote {folder / 'implicit_gradients.png'}")
    return slopes


if __name__ == "__main__":
    main()
