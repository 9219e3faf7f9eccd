"""Draws one derivative by every method, with its error and the seconds that it took.

How rough a ball of gold is, and how its normals tilt, by all methods of the interior term; where it stands, by all of
the boundary term. All methods of a picture get about the same processor time. The error is that of the image, root mean
square over its pixels, relative to a reference by the first method with other random numbers. Of the roughness there is
one more picture, the derivative along a line through the highlight, with the spread of single images as error bars.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

import warp_psdr as psdr

ROOT = Path(__file__).resolve().parents[1]
T = psdr.Transform
#: picture -> term, what moves, and how.
TARGETS = {
    "interior": ("interior", "ball.bsdf.alpha.value", "roughness of the ball"),
    "normals": ("interior", "ball.vertex_normals", "the ball's normals tilt aside"),
    "boundary": ("boundary", "ball.to_world", "the ball moves aside"),
}
#: Further choices of methods, for what the first of them refuses here.
CHOICES = {"interior": ('interior.Attached(weights="attached")',), "normals": (), "boundary": ()}
#: The parameters move along a direction t: values are per unit of t.
UNIT = "d radiance / dt [W/m²/sr]"
#: Images of a method of the interior term, whose spread the error bars are, and their share of a picture's time.
RUNS, SHARE = 16, 1.0 / 16.0
#: Samples of the first, timed pass, and how much longer the reference takes than a method.
PILOT, REFERENCE = 4, 24


def scene_of(resolution: int) -> dict:
    """Return a ball of gold on a floor, under a wide lamp and a small one."""
    lamps = {
        name: {
            "type": "rectangle",
            "to_world": T.look_at(origin, [0.0, 0.0, 0.3], [0.0, 1.0, 0.0]).scale(size),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}},
        }
        for name, origin, size, radiance in (
            ("wide", [-2.0, -1.0, 2.5], 0.9, [2.0, 2.2, 2.5]),
            ("small", [2.2, -1.5, 2.0], 0.15, [40.0, 32.0, 22.0]),
        )
    }
    gold = {"type": "roughconductor", "material": "Au", "distribution": "ggx", "alpha": 0.2}
    film = {"type": "hdrfilm", "width": resolution, "height": resolution, "rfilter": {"type": "box"}}
    return {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": 32.0,
            "to_world": T.look_at([0.0, -5.0, 2.2], [0.0, 0.0, 0.5], [0.0, 0.0, 1.0]),
            "film": film,
        },
        "floor": {"type": "rectangle", "to_world": T.scale(4.0), "bsdf": {"type": "diffuse", "reflectance": 0.5}},
        "ball": {"type": "sphere", "to_world": T.translate([0.0, 0.0, 0.8]).scale(0.7), "bsdf": gold},
        **lamps,
    }


def methods(name: str, depth: int) -> dict[str, psdr.PathIntegrator]:
    """Return the methods of a picture's term by what asks for them, the default first."""
    term = TARGETS[name][0]
    options = [method.option for method in psdr.methods() if method.term == term]
    alone = {"boundary": None} if term == "interior" else {}
    return {
        option: psdr.PathIntegrator(max_depth=depth, **alone, **{term: eval(option, vars(psdr))})
        for option in (*options, *CHOICES[name])
    }


class Derivative:
    """A derivative image by one method."""

    def __init__(self, scene, name: str, integrator: psdr.PathIntegrator):
        self._scene, self._params = scene, psdr.traverse(scene)
        parameter = TARGETS[name][1]
        tangent = np.zeros(self._params[parameter].numpy().shape)
        if name == "boundary":
            tangent[0, 3] = 1.0
        else:
            tangent[..., 0] = 1.0
        self._tangents, self._integrator = {parameter: tangent}, integrator

    def image(self, spp: int, seed: int) -> np.ndarray:
        """Return the image, (H, W, 3)."""
        return psdr.render_forward(
            self._scene, self._params, self._tangents, integrator=self._integrator, spp=spp, seed=seed
        ).numpy()

    def samples_in(self, seconds: float) -> int:
        """Return how many samples a pixel take about that long; what has to be compiled is."""
        self.image(1, 0)
        start = time.process_time()
        self.image(PILOT, 0)
        return max(1, round(PILOT * seconds / (time.process_time() - start)))


def draw(folder: Path, scene, name: str, depth: int, seconds: float) -> list[dict]:
    """Draw all methods of a picture, and return the table's rows."""
    rows, pictures, reference = [], {}, None
    images: dict[str, list[np.ndarray]] = {}
    for label, integrator in methods(name, depth).items():
        derivative = Derivative(scene, name, integrator)
        try:
            spp = derivative.samples_in(seconds)
        except ValueError as refusal:
            rows.append({"method": label, "refused": str(refusal)})
            continue
        if reference is None:
            reference = derivative.image(REFERENCE * spp, seed=1)
        start = time.process_time()
        found = derivative.image(spp, seed=2)
        took = time.process_time() - start
        error = float(np.sqrt(((found - reference) ** 2).sum() / (reference**2).sum()))
        rows.append({"method": label, "samples": spp, "seconds": took, "error": error})
        if name == "interior":
            few = max(1, round(SHARE * spp))
            images[label] = [derivative.image(few, seed=3 + run) for run in range(RUNS)]
        pictures[f"{label}\n{spp} samples, {took:.2g} s, error {100 * error:.0f} %"] = found
    picture = folder / f"zoo_{name}.png"
    image = psdr.render(scene, integrator=psdr.PathIntegrator(max_depth=depth), spp=64)
    psdr.plots.side_by_side(
        picture,
        [image],
        ["the image"],
        differences={f"reference, {REFERENCE} times as long": reference, **pictures},
        percentile=99.0,
        columns=4,
        title=f"{TARGETS[name][2]}: every method of the {TARGETS[name][0]} term, about {seconds:g} s of processor each",
        quantity=UNIT,
    )
    print(f"wrote {picture}")
    if images:
        draw_highlight(folder / "zoo_highlight.png", reference, images, SHARE * seconds)
    return rows


def draw_highlight(picture: Path, reference: np.ndarray, images: dict[str, list[np.ndarray]], seconds: float) -> None:
    """Draw the derivative along the row of pixels where it is largest: means, and the spread of single images."""
    from matplotlib.figure import Figure

    row = int(np.abs(reference.mean(axis=-1)).sum(axis=1).argmax())
    line = reference[row].mean(axis=-1)
    (seen,) = np.nonzero(np.abs(line) > 0.02 * np.abs(line).max())
    shown = slice(max(int(seen[0]) - 3, 0), int(seen[-1]) + 4)
    x = np.arange(len(line))[shown]
    columns = 3
    rows = -(-len(images) // columns)
    figure = Figure(figsize=(4.2 * columns, 2.6 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for panel, (label, found) in zip(panels.flat, images.items(), strict=False):
        lines = np.array(found)[:, row, shown].mean(axis=-1)
        spread = lines.std(axis=0, ddof=1)
        panel.plot(x, line[shown], color="0.5", lw=1.0, label="reference")
        panel.errorbar(x, lines.mean(axis=0), spread, fmt=".", ms=3.0, lw=0.8, color="tab:blue", label="± one image")
        panel.set_title(
            f"{label}\nmean spread {np.sqrt((spread**2).mean()) / np.abs(line).max():.3f} of the largest", fontsize=8
        )
        panel.axhline(0.0, color="0.8", lw=0.5, zorder=0)
    for panel in panels.flat[len(images) :]:
        panel.set_visible(False)
    room = 0.4 * np.ptp(line)
    panels[0, 0].set_ylim(line.min() - room, line.max() + room)
    panels[0, 0].legend(fontsize=7)
    figure.supxlabel(f"pixel of row {row}, through the highlight")
    figure.supylabel(UNIT)
    figure.suptitle(f"The derivative of a highlight by its roughness, about {seconds:.2g} processor seconds an image")
    figure.savefig(picture, dpi=110)
    print(f"wrote {picture}")


def main(
    folder: Path = ROOT / "out" / "examples", resolution: int = 128, depth: int = 4, seconds: float = 2.0
) -> dict[str, list[dict]]:
    folder.mkdir(parents=True, exist_ok=True)
    scene = psdr.load_dict(scene_of(resolution))
    tables = {name: draw(folder, scene, name, depth, seconds) for name in TARGETS}
    for name, rows in tables.items():
        print(f"\n{name}")
        for row in rows:
            text = row.get("refused") or f"{row['seconds']:6.2f} s  error {row['error']:.3f}"
            print(f"  {row['method']:54} {text}")
    return tables


if __name__ == "__main__":
    main()
