"""One scene on two devices: equal images and gradients, and what each device takes for them.

    python examples/benchmarks/devices.py [--device cuda:0] [--cases NAME ...] [--quick] [--output results.jsonl]

Both devices draw the same random numbers, so that images differ by rounding alone: where a rounded number sends a path
elsewhere, that path is another sample of the same pixel. "difference" is |a - b| / |a| of blocks of pixels (of
gradients: of all requested values), "noise" the same between two seeds on the CPU. A gradient is that of the image's
mean by colours, materials, densities, and the geometry of one object, boundary terms included.
"""

import tempfile
from pathlib import Path

import implicit_scenes
import media
import numpy as np
import warp as wp
from common import Report, arguments, blocks, in_turns, median, psdr, ratio
from material_scenes import MATERIALS, write_maps

from scenes import CASES, write_data

SPP = 16
#: Blocks a side of the image.
BLOCKS = 16
#: What is requested: colours and other numbers of materials and media by the ends of their names, and geometry.
VALUES = (
    ".reflectance.value",
    ".diffuse_reflectance.value",
    ".base_color.value",
    ".alpha.value",
    ".sigma_t.data",
    ".sigma_t.value.value",
)
SHAPES = ("object", "body", "small-box", "ball0")
GEOMETRY = (".vertex_positions", ".grid", ".to_world", ".control_points", ".weight")
IMPLICIT = ("grid 64", "grid 64, cubic", "network", "hair 10000", "sphere, exact")


def files(folder: Path) -> dict[str, tuple[Path, int]]:
    """Write all scenes; name -> (file, depth)."""
    write_data(folder)
    write_maps(folder)
    found = {name: (case.write(folder, name), case.max_depth) for name, case in (CASES | MATERIALS).items()}
    implicit = implicit_scenes.write(folder)
    found |= {name: (implicit[name], implicit_scenes.DEPTH) for name in IMPLICIT}
    return found | media.write(folder)


def requested(case: str, names: list[str]) -> list[str]:
    """Return the parameters that a gradient is taken by; in fog no geometry, since boxes of the room touch there."""
    shapes = [n for n in names if n.partition(".")[0] in SHAPES and n.endswith(GEOMETRY) and "fog" not in case]
    return [n for n in names if n.endswith(VALUES)] + shapes


class On:
    """A scene on one device."""

    def __init__(self, case: str, file: Path, depth: int, resolution: int, device: str):
        self.scene = psdr.load_file(file, resolution=resolution, device=device)
        self.params = psdr.traverse(self.scene)
        self.params.requires_grad(*requested(case, list(self.params)))
        self._options = {"integrator": psdr.PathIntegrator(max_depth=depth), "spp": SPP}
        mean = 1.0 / (3.0 * resolution * resolution)
        self._adjoint = wp.full((resolution, resolution), wp.vec3(mean, mean, mean), dtype=wp.vec3, device=device)

    def image(self, seed: int) -> np.ndarray:
        """Return block means of the image."""
        image = psdr.render(self.scene, seed=seed, **self._options).numpy()
        return blocks(image[None].astype(np.float64), BLOCKS)[0]

    def gradient(self, seed: int) -> dict[str, np.ndarray]:
        """Return the gradient, parameter by parameter."""
        self.params.zero_grad()
        psdr.render_backward(self.scene, self.params, self._adjoint, seed=seed, **self._options)
        return {n: self.params[n].grad.numpy().astype(np.float64) for n in self.params.requested}


def distance(a, b) -> float:
    """Return |a - b| / |a|; of several arrays the largest."""
    if isinstance(a, dict):
        return max(distance(a[n], b[n]) for n in a)
    return float(np.linalg.norm(a - b) / max(np.linalg.norm(a), 1e-30))


def main() -> None:
    """Measure and print the table."""
    parser = arguments(__doc__)
    parser.add_argument("--device", default="cuda:0", help="the device that is compared with the CPU")
    parser.add_argument("--cases", nargs="+", help="default: all")
    options = parser.parse_args()
    repeat = options.repeat or (3 if options.quick else 7)
    resolution = 64 if options.quick else 256
    psdr.set_workers(options.threads)
    report = Report("devices", options.output)
    name = wp.get_device(options.device).name
    with tempfile.TemporaryDirectory() as folder:
        for case, (file, depth) in files(Path(folder)).items():
            if options.cases and case not in options.cases:
                continue
            a = On(case, file, depth, resolution, "cpu")
            b = On(case, file, depth, resolution, options.device)
            for what in ("image", "gradient"):
                mine, theirs = getattr(a, what), getattr(b, what)
                difference, noise = distance(mine(1), theirs(1)), distance(mine(1), mine(2))
                times = in_turns({"cpu": mine, "device": theirs}, repeat)  # what returns arrays has waited for them
                row = {"scene": case, "pass": what, "device": name}
                row |= {"CPU, ms": 1e3 * median(times, "cpu"), "device, ms": 1e3 * median(times, "device")}
                row |= {"ratio": ratio(times, "cpu", "device"), "difference": difference, "noise": noise}
                report.table(f"{resolution}^2 pixels, {SPP} samples, medians of {repeat}", [row])


if __name__ == "__main__":
    main()
