"""Images at equal error against Mitsuba 3, by each of Mitsuba's samplers.

    python examples/benchmarks/samplers_against_mitsuba.py [--quick] [--cases NAME ...] [--output results.jsonl]

Both renderers load the same file and take turns. Noise is the variance of a pixel between images of independent seeds,
summed over the image. Processor time times noise, at equal samples a pixel, is what an error costs: the columns are
Mitsuba's over ours, by its ``independent`` sampler, its default, and by the others, the best of which decides. Under an
environment map that holds for its default and, beside it, with its option ``mis_compensation``.
"""

import functools
import itertools
import re
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from common import Report, arguments, import_mitsuba, in_turns, median, psdr
from material_scenes import MATERIALS, write_maps

from scenes import write_data

SAMPLERS = ("independent", "stratified", "multijitter", "orthogonal", "ldsampler")
#: Scenes beside those of materials: file and depth.
FILES = {"Cornell box": (psdr.scenes.cornell_box, 4)}
#: Pixels of a side, samples a pixel, and seeds, of a quick run and of a full one.
PIXELS, SPP, SEEDS = (64, 160), (16, 64), (4, 8)


#: What an environment map is told to be drawn with MIS compensation.
MAP, COMPENSATED = '<emitter type="envmap" id="sky">', '<boolean name="mis_compensation" value="true"/>'


def with_sampler(file: Path, sampler: str, compensated: bool, spp: int, folder: Path) -> str:
    """Write a scene file with another sampler in its sensor, and return its name."""
    text = re.sub(r"<sampler.*?</sampler>", "", file.read_text(), flags=re.DOTALL)
    if compensated:
        text = text.replace(MAP, MAP + COMPENSATED)
    element = f'<sampler type="{sampler}"><integer name="sample_count" value="{spp}"/></sampler>'
    name = f"{file.stem}_{sampler}_{int(compensated)}.xml"
    changed = (file.parent if folder in file.parents else folder) / name
    changed.write_text(re.sub(r"</sensor>", element + "</sensor>", text, count=1))
    return str(changed)


def ours(file, depth: int, pixels: int, spp: int) -> Callable[[int], np.ndarray]:
    """Return what renders a file for a seed, by Owen-scrambled Sobol points, whatever the file says."""
    scene, integrator = psdr.load_file(file, resolution=pixels), psdr.PathIntegrator(max_depth=depth, sampler="sobol")
    return lambda seed: psdr.render(scene, integrator=integrator, spp=spp, seed=seed).numpy()


def theirs(mi, dr, file: str, depth: int, pixels: int, spp: int) -> Callable[[int], np.ndarray]:
    """Return what renders a file with Mitsuba for a seed."""
    scene = mi.load_file(file, resolution=pixels)
    path = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 5})

    def render(seed: int) -> np.ndarray:
        image = mi.render(scene, integrator=path, spp=spp, seed=seed)
        dr.eval(image)
        dr.sync_thread()
        return np.array(image)

    return render


def keep(images: list, render: Callable[[int], np.ndarray], seed: int) -> None:
    """Render, and keep the image."""
    images.append(render(seed))


def main() -> None:
    """Run the cases and print the table."""
    parser = arguments(__doc__)
    parser.add_argument("--cases", nargs="+", default=[*FILES, *MATERIALS], choices=[*FILES, *MATERIALS])
    options = parser.parse_args()
    pixels, spp, seeds = (pair[0 if options.quick else 1] for pair in (PIXELS, SPP, SEEDS))
    mi, dr = import_mitsuba(options.threads)
    psdr.set_workers(options.threads)
    report = Report("samplers against Mitsuba", options.output)
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_data(folder)
        write_maps(folder)
        for case in options.cases:
            if case in FILES:
                file, depth = FILES[case]
            else:
                file, depth = MATERIALS[case].write(folder, case), MATERIALS[case].max_depth
            calls = {"ours": ours(file, depth, pixels, spp)}
            ways = (False, True) if MAP in Path(file).read_text() else (False,)
            for sampler, compensated in itertools.product(SAMPLERS, ways):
                changed = with_sampler(Path(file), sampler, compensated, spp, folder)
                calls[sampler, compensated] = theirs(mi, dr, changed, depth, pixels, spp)
            images: dict[str, list] = {key: [] for key in calls}
            runs = {key: functools.partial(keep, images[key], call) for key, call in calls.items()}
            times = in_turns(runs, seeds)
            cost = {}
            for key, found in images.items():
                noise = np.var(np.stack(found[1:]).astype(np.float64), axis=0, ddof=1).sum()  # the first one compiled
                cost[key] = median(times, key, "cpu") * noise
            ratios = {key: cost[key] / cost["ours"] for key in calls if key != "ours"}
            row = {"scene": case, "image, CPU s": median(times, "ours", "cpu")}
            row |= {sampler: ratios[sampler, False] for sampler in SAMPLERS}
            for title, way in (("best", False), ("best with compensation", True)):
                found = {sampler: ratios[sampler, way] for sampler in SAMPLERS if (sampler, way) in ratios}
                best = min(found, key=lambda sampler, found=found: found[sampler]) if found else None
                row |= {title: found.get(best), f"by ({title})": best}
            rows.append(row)
            report.table(f"{case}: Mitsuba's cost of an error over ours", rows[-1:])
    title = f"Mitsuba's processor time x noise over ours, {pixels} x {pixels} pixels, {spp} samples, {seeds} seeds"
    report.table(f"{title}, {options.threads} threads", rows)


if __name__ == "__main__":
    main()
