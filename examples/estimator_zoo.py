"""Draws one derivative by every method, with its error and the seconds that it took.

How rough a ball of gold is, and how its normals tilt, by all methods of the interior term; where it stands, by all of
the boundary term. All methods of a picture get about the same processor time, but for those that take more of it for 64
samples. The error is that of the image, root mean square over its pixels, relative to a reference by the first method
with other random numbers, without what the reference itself strays. One more picture shows errors against time, of
means of more and more images, and one the derivative by the roughness along a line through the highlight, with the
spread of single images as error bars.
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
#: Images by a method, of each of which the samples are a multiple of ``TOGETHER``, for mirrored film points.
RUNS, TOGETHER = 16, 4
#: Samples of the first, timed pass; how much longer the reference takes than a method, and its parts.
PILOT, REFERENCE, PARTS = 4, 24, 8


def scene_of(resolution: int, flat: bool = False) -> dict:
    """Return a ball of gold on a floor, under a wide lamp and a small one; ``flat``: without interpolated normals.

    Reparameterisations take what moves with flat normals alone.
    """
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
        "ball": {
            "type": "sphere",
            "to_world": T.translate([0.0, 0.0, 0.8]).scale(0.7),
            "face_normals": flat,
            "bsdf": gold,
        },
        **lamps,
    }


def methods(name: str, depth: int) -> dict[str, psdr.PathIntegrator]:
    """Return the methods of a picture's term by what asks for them, the default first."""
    term = TARGETS[name][0]
    options = [method.option for method in psdr.methods() if method.term == term]
    alone = {"boundary": None} if term == "interior" else {}
    return {
        option: psdr.PathIntegrator(max_depth=depth, **alone, **{term: eval(option, {term: getattr(psdr, term)})})
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
    rows, pictures, reference, strays = [], {}, None, 0.0
    images: dict[str, np.ndarray] = {}
    for label, integrator in methods(name, depth).items():
        derivative = Derivative(scene, name, integrator)
        try:
            spp = derivative.samples_in(seconds)
        except ValueError as refusal:
            rows.append({"method": label, "refused": str(refusal)})
            continue
        if reference is None:
            parts = np.array([derivative.image(REFERENCE * spp // PARTS, seed=1000 + part) for part in range(PARTS)])
            reference = parts.mean(axis=0)
            strays = parts.var(axis=0, ddof=1).sum() / PARTS
        few = TOGETHER * max(1, round(spp / (TOGETHER * RUNS)))
        start = time.process_time()
        found = np.array([derivative.image(few, seed=2 + run) for run in range(RUNS)])
        took = time.process_time() - start
        errors = errors_of(found, reference, strays)
        error = errors[-1]
        rows.append({"method": label, "samples": RUNS * few, "seconds": took, "error": error, "errors": errors})
        images[label] = found
        about = f"{RUNS * few} samples, {took:.{0 if took > 10.0 else 1}f} s, error {100 * error:.0f} %"
        pictures[f"{label}\n{about}"] = found.mean(axis=0)
    picture = folder / f"zoo_{name}.png"
    image = psdr.render(scene, integrator=psdr.PathIntegrator(max_depth=depth), spp=64)
    psdr.plots.side_by_side(
        picture,
        [image],
        ["the image"],
        differences={f"reference, {REFERENCE} times as long": reference, **pictures},
        difference_quantity=UNIT,
        percentile=99.0,
        columns=4,
        title=f"{TARGETS[name][2]}: every method of the {TARGETS[name][0]} term, "
        f"{seconds:g} s of processor each, or {RUNS * TOGETHER} samples where these take longer",
    )
    print(f"wrote {picture}")
    if name == "interior":
        draw_highlight(folder / "zoo_highlight.png", reference, images, seconds / RUNS)
    return rows


def errors_of(images: np.ndarray, reference: np.ndarray, strays: float) -> list[float]:
    """Return the relative errors of means of 1, 2, 4, ... of the images, each of all groups of that many.

    ``strays``: variance of the reference, summed over its pixels.
    """
    errors = []
    while True:
        square = ((images - reference) ** 2).reshape(len(images), -1).sum(axis=1).mean() - strays
        errors.append(float(np.sqrt(max(square, 0.0) / (reference**2).sum())))
        if len(images) == 1:
            return errors
        images = 0.5 * (images[0::2] + images[1::2])


def draw_times(picture: Path, tables: dict[str, list[dict]]) -> None:
    """Draw errors against processor time, a panel for each derivative."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    figure = Figure(figsize=(5.0 * len(tables), 7.2), layout="constrained")
    for panel, (name, rows) in zip(figure.subplots(1, len(tables), squeeze=False)[0], tables.items(), strict=True):
        drawn = [row for row in rows if "errors" in row]
        for number, row in enumerate(drawn):
            seconds = row["seconds"] / RUNS * 2.0 ** np.arange(len(row["errors"]))
            # Colours and marks come in cycles of different lengths: no two methods have both.
            panel.loglog(seconds, row["errors"], f"{'osv'[number % 3]}-C{number % 10}", ms=4, lw=1, label=row["method"])
        panel.set_title(f"{TARGETS[name][2]}: the {TARGETS[name][0]} term", fontsize=10)
        panel.set_xlabel("processor time [s]")
        panel.xaxis.set_minor_formatter(NullFormatter())
        panel.grid(which="both", color="0.9", lw=0.5)
        panel.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2)
    figure.supylabel("relative error of the derivative image")
    figure.savefig(picture, dpi=110)
    print(f"wrote {picture}")


def draw_highlight(picture: Path, reference: np.ndarray, images: dict[str, np.ndarray], seconds: float) -> None:
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
        lines = found[:, row, shown].mean(axis=-1)
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
    scenes = {name: psdr.load_dict(scene_of(resolution, flat=name == "boundary")) for name in TARGETS}
    tables = {name: draw(folder, scenes[name], name, depth, seconds) for name in TARGETS}
    draw_times(folder / "zoo_time.png", tables)
    for name, rows in tables.items():
        print(f"\n{name}")
        for row in rows:
            text = row.get("refused") or f"{row['seconds']:6.2f} s  error {row['error']:.3f}"
            print(f"  {row['method']:54} {text}")
    return tables


if __name__ == "__main__":
    main()
