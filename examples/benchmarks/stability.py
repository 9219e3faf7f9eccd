"""What the stability suite measures: its table, and pictures of the cases in which a naive renderer fails.

    python examples/benchmarks/stability.py [--quick] [--family geometry ...] [--pictures examples/pictures]

Runs every case of ``tests/stability`` (``--quick``: without the slow ones) and prints a row for each, in Markdown: the
worst error of its sweep, the bound that the test holds it to, and what a naive implementation does there. Each case
states its error in a unit of its own, in general relative. The picture shows, for scenes that are hard in different
ways, image, derivative, and the errors of the derivative here and without the code that the case is about.
"""

import argparse
import contextlib
import importlib
import warnings
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numpy as np
from common import ROOT, psdr

from warp_psdr import plots
from warp_psdr.kernels.boundary.path_space import primary
from warp_psdr.scene.files import dictionary
from warp_psdr.topology import edges

#: Pixels of a picture's side, batches and samples of each derivative in it, and of the reference.
FILM, BATCHES, SPP, REFERENCE_SPP = 64, 4, 64, 512
#: Where seeds of the references start.
REFERENCE_SEED = 1000
FAR = 1.0e5 * np.array([1.0, 0.7, -0.4])


def families(names: list[str] | None) -> list:
    """Return the cases of the suite, all or those of some families."""
    cases = []
    for file in sorted((ROOT / "tests" / "stability").glob("test_*.py")):
        cases += getattr(importlib.import_module(f"tests.stability.{file.stem}"), "CASES", ())
    known = sorted({case.family for case in cases})
    unknown = sorted(set(names or ()) - set(known))
    if unknown:
        raise SystemExit(f"no family {', '.join(unknown)}; there are {', '.join(known)}")
    return [case for case in cases if not names or case.family in names]


def table(cases: list) -> None:
    """Measure the cases and print a row for each."""
    from tests.stability.record import loose, measured, summary

    rows = []
    print("| family | case | error | bound | what is hard | naive |\n|---|---|---|---|---|---|")
    for case in cases:
        row = measured(case)
        rows.append(row)
        print(
            f"| {row.family} | {row.cell} | {row.error:.2g} | {row.bound:.2g} | {case.hard} | {case.naive} |",
            flush=True,
        )
    print("\n" + "\n".join(summary(rows)))
    for name in loose(rows):
        print(f"holds with half of its bound too: {name}")


@contextlib.contextmanager
def narrow_faces_unnoticed() -> Iterator[None]:
    """Let the primary boundary look past all edges at one distance, whatever it finds there."""
    primary.make_primary_kernel.cache_clear()
    with mock.patch.object(primary, "MARGIN", 1.0e-30):
        yield
    primary.make_primary_kernel.cache_clear()


def hard_scenes() -> list[tuple[str, dict, dict, contextlib.AbstractContextManager]]:
    """Return (title, scene, the same scene in an easy form, what takes away the code that makes it work)."""
    from tests.stability import test_geometry as geometry
    from tests.stability.sweeps import box, rectangle, room

    def lid(mesh) -> dict:
        return geometry.with_mesh("box", *mesh)

    slab = box((0.0, 0.0, 0.0), 1.0, 0.0)
    slab = (slab[0] * [1.0, 1.0, 2e-6] + [0.2, 0.1, 0.5], slab[1])
    sheet = rectangle((0.2, 0.1, 0.5 + 2e-6), 1.0, np.eye(4))
    whole = mock.patch.object(edges, "cut_sides", lambda points, group, shape, sides, face, tolerances: (sides, face))
    return [
        (
            "$10^5$ sizes from the origin",
            room(1.0, FAR),
            room(),
            mock.patch.object(dictionary, "find_origin", lambda shapes: np.zeros(3)),
        ),
        ("T-junctions on every edge", lid(geometry.cut_alone(geometry.BOX, 0.3)), room(), whole),
        (
            "needles of $10^{-5}$",
            lid(geometry.cut_everywhere(geometry.BOX, 1e-5)),
            room(),
            mock.patch.object(edges, "TILT", 0.0),
        ),
        ("a slab of $4 \\cdot 10^{-6}$", lid(slab), lid(sheet), narrow_faces_unnoticed()),
    ]


def draw(file: Path) -> None:
    """Draw image, derivative and errors of the hard scenes."""
    from matplotlib.figure import Figure

    from tests.stability.sweeps import derivatives

    def sharper(scene: dict) -> dict:
        film = scene["camera"]["film"] | {"width": FILM, "height": FILM}
        return scene | {"camera": scene["camera"] | {"film": film}}

    def mean(scene: dict, spp: int, seed: int = 0) -> np.ndarray:
        return derivatives(sharper(scene), BATCHES, seed, spp).mean(axis=(0, 3))

    scenes = hard_scenes()
    figure = Figure(figsize=(11.5, 2.7 * len(scenes)), dpi=100, layout="constrained")
    for i, (title, hard, easy, without) in enumerate(scenes):
        integrator = psdr.PathIntegrator(max_depth=3)
        image = psdr.render(psdr.load_dict(sharper(hard)), integrator=integrator, spp=256).numpy()
        expected = mean(easy, REFERENCE_SPP, REFERENCE_SEED)
        ours = mean(hard, SPP)
        with without, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of digits that are lost: they are
            naive = mean(hard, SPP)
        limit = float(np.quantile(np.abs(expected[expected != 0.0]), 0.98))
        panels = (("derivative", ours), ("its error", ours - expected), ("error of a naive one", naive - expected))
        axes = figure.add_subplot(len(scenes), 4, 4 * i + 1)
        axes.imshow(plots.tonemap(image, exposure=1.5), interpolation="nearest")
        axes.set_title(title, fontsize=9)
        axes.set(xticks=[], yticks=[])
        for k, (name, values) in enumerate(panels):
            axes = figure.add_subplot(len(scenes), 4, 4 * i + 2 + k)
            drawn = axes.imshow(
                values, cmap=plots.diverging_colormap(), vmin=-limit, vmax=limit, interpolation="nearest"
            )
            share = "" if k == 0 else f": {np.abs(values).mean() / np.abs(expected).mean():.2g} of it"
            axes.set_title(name + share, fontsize=9)
            axes.set(xticks=[], yticks=[])
        bar = figure.colorbar(drawn, ax=figure.axes[-3:], extend="both", pad=0.01)
        bar.set_label("radiance [W/m²/sr] per unit\nof the parameter, mean of RGB", fontsize=8)
    figure.supxlabel(f"image: sRGB, {FILM} × {FILM}, white is {2.0**-1.5:.2g} W/m²/sr", fontsize=8)
    figure.savefig(file)
    print(f"{file}: errors are mean absolute values over the derivative's, with its noise at {BATCHES * SPP} samples")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="leave the slow cases out")
    parser.add_argument("--family", action="append", help="only this family; may be given several times")
    parser.add_argument("--pictures", type=Path, help="also draw stability.png into this folder")
    options = parser.parse_args()
    if options.pictures and not options.pictures.is_dir():
        raise SystemExit(f"{options.pictures} is no folder; create it first")
    table([case for case in families(options.family) if not (options.quick and case.slow)])
    if options.pictures:
        draw(options.pictures / "stability.png")


if __name__ == "__main__":
    main()
