"""Distances of a plane from a real lidar's histograms, through a transient film, against a robot's.

    python examples/benchmarks/lidar_plane.py distance_data.json [--output docs/data/lidar.jsonl] [--picture lidar.png]

The data are 159 shots of a TMF8820 (9 zones of 128 bins) that a robot held .005 to .4 m before a plane. The file is
``part_2_active_SPADs/data/distance_data.json`` of github.com/cpsiff/SPAD-ICCP-Summer-School (MIT licence).

Ten shots calibrate the lidar: widths of bins, offsets and gains of zones, the pulse, how it saturates, the field of
view and how the plane is turned. The plane of each other shot starts where the peaks of its histograms are, and
``psdr.solve`` finds distance, albedo and background from all bins. Peaks alone are compared with: the median of the
zones, each on the line that fits the same ten shots. The pulse that the lidar's reference detector saw is where the
pulse starts. As it is it fits no zone: ten bins behind the peak it has .05 of it, the zones .01.
"""

from __future__ import annotations

import functools
import json
import time
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import warp as wp
from common import ROOT, Report, arguments, psdr
from lidar_histograms import Histograms, calibrated, free_pulse, guessed, reference_pulse

from warp_psdr.observe.solution import Solution

T = psdr.Transform
POSE, ALBEDO = "plane.to_world", "plane.bsdf.reflectance.value"
#: Albedo of the calibration, which gains are relative to.
GREY = 0.5
#: Bounds of the geometry; where it starts: the field of view is the maker's; width of the lidar's bins at first, m.
BOUNDS = np.array([[-0.02, -10.0, -10.0, 15.0], [0.02, 10.0, 10.0, 45.0]])
START, WIDTH = np.array([0.0, 0.0, 0.0, 33.0]), 0.0275
#: Which clock times a zone (the maker's pairs of channels, the first of which is the reference).
CLOCKS = np.array([0, 1, 1, 2, 2, 3, 3, 4, 4])
#: Fine bins of the film: optical path length, m, and number.
FINE, BINS = 0.0034, 300
#: Samples of a pixel in the calibration, and in ``solve``.
CALIBRATION_SPP, SPP = 1024, 512
#: Least distance that a step may go to, m.
NEAREST = 0.002
#: Distances that the ten shots span, m; that a solution may start from; of which histograms are drawn.
CALIBRATED, STARTS, SHOWN = (0.06, 0.4), (0.005, 0.45), (0.03, 0.06, 0.12, 0.22, 0.39)
#: Speed of light, m / s.
LIGHT = 299792458.0
#: Nothing hides anything, and light comes straight from the plane.
DIRECT = psdr.PathIntegrator(max_depth=2, boundary=None)
#: Ranges of distances that are reported, m.
RANGES = ((0.0, 0.03), (0.03, 0.1), (0.1, 0.2), (0.2, 0.41), (0.03, 0.41), (0.0, 0.41))


def placed(distance: float, geometry: np.ndarray) -> dict[str, np.ndarray]:
    """Return parameters of the scene.

    ``geometry``: how much farther the plane is than the robot says (m), its turns about x and y (degrees), and the
    field of view of all zones together (degrees).
    """
    farther, x, y, fov = geometry
    pose = T.translate((0.0, 0.0, distance + farther)) @ T.rotate((0, 1, 0), 180.0 + y) @ T.rotate((1, 0, 0), x)
    return {POSE: pose.matrix, "sensor.x_fov": np.array([fov])}


class Plane:
    """A lidar's source and zones in one place, and a plane."""

    def __init__(self):
        film = {"type": "transient_hdr_film", "width": 3, "height": 3, "rfilter": {"type": "box"}}
        film |= {"temporal_bins": BINS, "bin_width_opl": FINE, "start_opl": 0.0}
        paint = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [GREY] * 3}}
        self.scene = psdr.load_dict(
            {
                "type": "scene",
                "sensor": {"type": "perspective", "fov": START[3], "film": film},
                "source": {"type": "point", "position": [0, 0, 0], "intensity": {"type": "rgb", "value": 1.0}},
                "plane": {"type": "rectangle", "to_world": placed(0.1, START)[POSE], "bsdf": paint},
            }
        )
        self.params = psdr.traverse(self.scene)
        self.shape = (3, 3, BINS)
        self.lengths = FINE * (np.arange(BINS) + 0.5)

    def light(self, distances: np.ndarray, geometry: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return images (n, 9, BINS) of a plane at distances, and derivatives by the geometry, (4, n, 9, BINS)."""
        images, moved = [], []
        options = {"integrator": DIRECT, "spp": CALIBRATION_SPP}
        self.params[ALBEDO] = np.float32([GREY] * 3)
        for distance in distances:
            numbers = psdr.unknowns.Function(functools.partial(placed, distance), geometry)
            numbers.restore(self.params, numbers.x)
            self.params.update()
            tangents = numbers.tangents(self.params)
            images.append(psdr.render(self.scene, **options))
            moved.append([psdr.render_forward(self.scene, self.params, row, **options) for row in tangents])
        return self._zones(images), np.stack([self._zones(row) for row in zip(*moved, strict=True)])

    def _zones(self, images: Sequence[wp.array]) -> np.ndarray:
        return np.array([image.numpy()[..., 0].reshape(9, BINS).astype(float) for image in images])

    def solved(self, seen: Histograms, geometry: np.ndarray, start: float, seed: int) -> Solution:
        """Return distance (as a robot says it), albedo and background of a shot."""

        def posed(x: np.ndarray) -> dict[str, np.ndarray]:
            return placed(max(x[0], NEAREST), geometry)

        distance = psdr.unknowns.Function(posed, [start], ["distance"])
        distance.restore(self.params, distance.x)
        self.params[ALBEDO] = np.float32([GREY] * 3)
        self.params.update()
        unknowns = [distance, psdr.unknowns.Entries(ALBEDO, together=True)]
        return psdr.solve(self.scene, self.params, seen, unknowns=unknowns, integrator=DIRECT, spp=SPP, seed=seed)


def peaks(counts: np.ndarray) -> np.ndarray:
    """Return where the pulse is highest, (..., zones) bins: the top of a parabola through three logarithms."""
    top = np.clip(counts.argmax(axis=-1), 1, counts.shape[-1] - 2)
    near = np.stack([np.take_along_axis(counts, (top + i)[..., None], -1)[..., 0] for i in (-1, 0, 1)])
    a, b, c = np.log(near + 1.0)
    bend = a - 2.0 * b + c
    return top + np.where(bend < 0.0, 0.5 * (a - c) / np.minimum(bend, -1e-9), 0.0).clip(-1.0, 1.0)


def picture(path: Path, distances: np.ndarray, by_peaks: np.ndarray, found: list[dict], shown: list[tuple]) -> None:
    """Draw histograms beside those of rendered planes, and errors of distances."""
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.5), layout="constrained")
    for i, (distance, counts, rendered) in enumerate(shown):
        left.semilogy(counts, ".", color=f"C{i}", label=f"{distance:.3f} m")
        left.semilogy(rendered, "-", color=f"C{i}", linewidth=1.0)
    left.set(
        xlim=(8, 80), ylim=(10, None), xlabel="bin", ylabel="counts", title="middle zone: dots, and a rendered plane"
    )
    left.legend()
    at = [row["shot"] for row in found]
    right.plot(distances[at], 1e3 * (by_peaks - distances)[at], ".", color="0.6", label="peaks alone")
    errors, bars = ([1e3 * row[name] for row in found] for name in ("error", "bar"))
    right.errorbar(distances[at], errors, bars, fmt=".", label="whole histograms, 95 % bars")
    right.set(ylim=(-5, 5), xlabel="distance [m]", ylabel="error [mm]", title="against the robot")
    right.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
    print(f"wrote {path}")


def rows_of(distances: np.ndarray, by_peaks: np.ndarray, found: list[dict], scatter: float) -> list[dict]:
    """Return the table's rows, one for a range of distances.

    ``scatter``: rms error of the ten shots' own distances, what a calibration adds to bars.
    """
    rows = []
    for low, high in RANGES:
        own = [row for row in found if low <= distances[row["shot"]] < high]
        at = [row["shot"] for row in own]
        bars = np.array([row["bar"] for row in own])
        errors, albedo = np.array([row["error"] for row in own]), np.array([row["albedo"] for row in own])
        rows.append(
            {
                "distances [m]": f"{low:g} to {min(high, 0.4):g}",
                "shots": len(own),
                "rms error [mm]": 1e3 * float(np.sqrt((errors**2).mean())),
                "of peaks alone [mm]": 1e3 * float(np.sqrt(((by_peaks - distances)[at] ** 2).mean())),
                "95 % bar (median) [mm]": 1e3 * float(np.median(bars)) if np.isfinite(np.median(bars)) else None,
                "bars hold": float(np.mean(np.abs(errors) < bars)),
                "with the ten's scatter": float(np.mean(np.abs(errors) < np.hypot(bars, 1.96 * scatter))),
                "albedo over the ten's": float(albedo.mean()),
                "its deviation": float(albedo.std()),
                "residual [deviations]": float(np.median([row["rms"] for row in own])),
                "processor time [s]": float(np.mean([row["seconds"] for row in own])),
            }
        )
    return rows


def main() -> None:
    """Calibrate, find distances, report."""
    parser = arguments(__doc__)
    parser.add_argument("file", type=Path, help="distance_data.json")
    parser.add_argument("--picture", type=Path, default=ROOT / "out" / "examples" / "lidar_plane.png")
    options = parser.parse_args()
    if not options.file.is_file():
        raise SystemExit(f"{options.file} is no file; download it from github.com/cpsiff/SPAD-ICCP-Summer-School")
    shots = json.loads(options.file.read_text(encoding="utf-8"))
    distances = np.array([shot["dist_to_plane"] for shot in shots])
    counts = np.array([shot["hists"] for shot in shots], float)
    ten = np.unique([np.abs(distances - d).argmin() for d in np.linspace(*CALIBRATED, 10)])

    plane, began = Plane(), time.process_time()
    pulse = free_pulse(reference_pulse(np.sum([shots[i]["reference_hist"] for i in ten], axis=0)))
    light = functools.partial(plane.light, distances[ten])
    start = guessed(counts[ten], plane.lengths, light(START)[0], WIDTH, START, pulse)
    instrument, residual = calibrated(counts[ten], plane.lengths, light, start, CLOCKS, BOUNDS)
    farther, x, y, fov = instrument.geometry
    report = Report("lidar", options.output)
    widths = [1e12 * w / LIGHT for w in (instrument.widths.min(), instrument.widths.max())]
    told = {
        "bins [ps]": f"{widths[0]:.1f} to {widths[1]:.1f}",
        "field of view [deg]": float(fov),
        "turned [deg]": f"{x:.1f}, {y:.1f}",
        "farther [mm]": float(1e3 * farther),
        "laser shots [millions]": float(1e-6 * instrument.shots),
        "blind (kappa)": float(instrument.blind),
        "walk [bins a million counts]": float(instrument.walk),
        "residual [deviations]": float(np.sqrt((residual**2).mean())),
        "processor time [s]": time.process_time() - began,
    }
    report.table(f"a TMF8820, calibrated by ten shots at {CALIBRATED[0]:g} to {CALIBRATED[1]:g} m", [told])

    tops = peaks(counts)
    lines = [np.polyfit(tops[ten, z], distances[ten], 1) for z in range(9)]
    by_peaks = np.median([np.polyval(line, tops[:, z]) for z, line in enumerate(lines)], axis=0)
    found, shown = [], []
    others = np.setdiff1d(np.arange(len(shots)), ten)[:: 6 if options.quick else 1]
    for i in np.append(others, ten):
        began = time.process_time()
        seen = Histograms(counts[i], instrument, instrument.response(plane.lengths, counts[i]), plane.shape)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of residuals where detectors are blind, reported below
            solution = plane.solved(seen, instrument.geometry, float(by_peaks[i].clip(*STARTS)), int(i))
        low, high = solution.interval()
        row = {"shot": i, "error": solution.values[0] - distances[i], "bar": 0.5 * (high - low)[0]}
        row |= {"albedo": solution.values[1] / GREY, "rms": solution.rms, "seconds": time.process_time() - began}
        found.append(row)
        if i not in ten and len(shown) < len(SHOWN) and distances[i] >= SHOWN[len(shown)]:
            image = psdr.render(plane.scene, integrator=DIRECT, spp=CALIBRATION_SPP).numpy()
            shown.append((distances[i], counts[i, 4], seen.counts(image)[4]))
    scatter = float(np.sqrt(np.mean([row["error"] ** 2 for row in found[len(others) :]])))
    print(f"the ten shots' own distances: {1e3 * scatter:.2f} mm rms\n")
    found = found[: len(others)]
    title = "distances of a plane from a TMF8820's histograms, against a robot's"
    report.table(title, rows_of(distances, by_peaks, found, scatter))
    picture(options.picture, distances, by_peaks, found, shown)


if __name__ == "__main__":
    main()
