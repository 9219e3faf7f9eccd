"""Values and error bars from photographs: of a calibration board, and of rendered problems whose truth is known.

    python examples/benchmarks/photographs.py coverage [--problems 200] [--output docs/data/photographs.jsonl]
    python examples/benchmarks/photographs.py board --photos /usr/share/doc/opencv-doc/examples/data [--output ...]

**coverage**: a checkerboard under even light is photographed with what photographs have and the solver is not told:
noise, JPEG, a response of 2.0 that is read as 2.2, light that is up to a third brighter on one side. The row says how
often 95 % bars of the board's pose hold the truth.

**board**: 26 photographs of OpenCV's board by two cameras, 640 x 480, as Debian's ``opencv-doc`` installs them, reduced
to 160 x 120 or by ``--reduce``. Poses start 6 degrees and 8 mm off. OpenCV (``cv2``) finds lenses and poses from the
corners of each camera's photographs: the lenses are given, the poses compared with. Codes are taken for linear, which
leaves the least residual.
"""

import io
import time
import warnings
from pathlib import Path

import numpy as np
from common import Report, arguments, psdr
from opencv_board import HEIGHT, INSIDE_ALONE, POSE, REDUCE, WIDTH, Board, T, levels_of, moved, scene_of, squares
from PIL import Image
from scipy.spatial.transform import Rotation

#: Coverage: film, samples of a derivative, of a photograph.
SIZE, SPP, PHOTO_SPP = (64, 48), 8, 256
#: Board: how far off the start is, degrees and m.
OFF = (6.0, 0.008)


class Coverage:
    """Rendered problems of which the truth is known."""

    def __init__(self):
        film = {"type": "hdrfilm", "width": SIZE[0], "height": SIZE[1], "rfilter": {"type": "box"}}
        self.pattern = squares(6, 8, 8)
        corners = np.array([[-0.4, -0.3, 0.0], [0.4, -0.3, 0.0], [0.4, 0.3, 0.0], [-0.4, 0.3, 0.0]])
        sensor = {"type": "perspective", "fov": 40.0, "film": film}
        self.scene = scene_of(corners, self.pattern, {"sensor": sensor})
        self.params = psdr.traverse(self.scene)

    def photograph(self, pose: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return what the camera writes."""
        self.params[POSE] = pose.astype(np.float32)
        levels_of(self.params, self.pattern, [0.15 + 0.1 * rng.random(), 0.5 + 0.3 * rng.random()])
        self.params.update()
        image = psdr.render(self.scene, spp=PHOTO_SPP, seed=int(rng.integers(1 << 30))).numpy()
        x, y = np.linspace(-0.5, 0.5, SIZE[0])[None, :, None], np.linspace(-0.5, 0.5, SIZE[1])[:, None, None]
        slope = 0.15 * rng.normal(size=2)
        codes = np.clip(0.9 * image * (1.0 + slope[0] * x + slope[1] * y), 0.0, 1.0) ** (1.0 / 2.0)
        codes += 0.01 * rng.normal(size=codes.shape)
        file = io.BytesIO()
        Image.fromarray(np.uint8(np.clip(255.0 * codes + 0.5, 0.0, 255.0))).save(file, "JPEG", quality=85)
        return np.asarray(Image.open(file))

    def errors(self, number: int) -> tuple[np.ndarray, int]:
        """Return the six errors of a problem's pose over their bars' halves, and the number of steps."""
        rng = np.random.default_rng(number)
        turns = [
            T.rotate(axis, size * rng.normal()) for axis, size in zip(np.eye(3).tolist(), (20, 20, 10), strict=True)
        ]
        at = T.translate([*(0.03 * rng.normal(size=2)), 1.6 + 0.1 * rng.normal()])
        truth = (at @ turns[0] @ turns[1] @ turns[2]).matrix
        photograph = self.photograph(truth, rng)
        aside = T.rotate([1, 0, 0], 1.5 * rng.normal()) @ T.rotate([0, 1, 0], 1.5 * rng.normal())
        start = T.translate((0.008 * rng.normal(size=3)).tolist()).matrix @ truth @ aside.matrix
        self.params[POSE] = start.astype(np.float32)
        unknowns = [psdr.unknowns.Rigid(POSE), levels_of(self.params, self.pattern, [0.2, 0.6])]
        self.params.update()
        observed = psdr.Photograph(photograph, response=2.2, saturated=2.0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of residuals, which these problems have on purpose
            found = psdr.solve(self.scene, self.params, observed, unknowns=unknowns, spp=SPP, seed=number)
        pose = self.params[POSE].numpy().astype(float)
        turned = Rotation.from_matrix(pose[:3, :3] @ truth[:3, :3].T).as_rotvec()
        low, high = found.interval()
        return np.append(turned, pose[:3, 3] - truth[:3, 3]) / (0.5 * (high - low)[:6]), len(found.steps)


def coverage(problems: int) -> tuple[str, list[dict]]:
    """Return a table of how often bars hold the truth."""
    study, rows, began = Coverage(), [], time.process_time()
    for number in range(problems):
        rows.append(study.errors(number))
        print(number, np.round(rows[-1][0], 2), flush=True)
    held = np.abs([row[0] for row in rows]) < 1.0
    table = (
        "rendered photographs with noise, JPEG, a wrong response and uneven light: how often 95 % bars hold the truth"
    )
    return table, [
        {
            "problems": problems,
            "turns": float(held[:, :3].mean()),
            "shifts across": float(held[:, 3:5].mean()),
            "distance": float(held[:, 5].mean()),
            "all": float(held.mean()),
            "steps": float(np.median([row[1] for row in rows])),
            "processor time [s]": (time.process_time() - began) / problems,
        }
    ]


def board(folder: Path, count: int, reduce: int) -> tuple[str, list[dict]]:
    """Return a table of single photographs: how far corners are from where OpenCV's poses have them.

    Args:
        folder: of the photographs.
        count: of each camera.
        reduce: edge of the squares of pixels that are averaged.

    Raises:
        SystemExit: OpenCV is not installed.
    """
    study, rows = Board(folder), []
    for side in ("left", "right"):
        files = study.files(folder, side)
        theirs = study.by_corners(files)
        if theirs is None:
            raise SystemExit("this benchmark compares with OpenCV: pip install opencv-python-headless")
        scene = scene_of(study.corners, study.pattern, {"sensor": theirs.lens.sensor(np.eye(4), reduce)})
        params, rays, focal = psdr.traverse(scene), theirs.lens.directions(), theirs.lens.numbers[0]
        for file, truth, error in list(zip(files, theirs.to_camera, theirs.errors, strict=True))[:count]:
            start = moved(truth, *OFF, np.random.default_rng(len(rows)))
            params[POSE] = start.astype(np.float32)
            params.update()
            began = time.process_time()
            solution = solve_photograph(study, scene, params, file, rays, reduce)
            seconds = time.process_time() - began
            found, bars = params[POSE].numpy().astype(float), solution.interval()[1] - solution.values
            rows.append(
                {
                    "photograph": file.name,
                    "start [px]": study.apart(start, truth, focal),
                    "found [px]": study.apart(found, truth, focal),
                    "OpenCV's own residual [px]": float(error),
                    "95 % bar of turns [deg]": float(np.degrees(np.linalg.norm(bars[:3]))),
                    "of the distance [mm]": float(1e3 * bars[5]),
                    "distance off [mm]": float(1e3 * (found[2, 3] - truth[2, 3])),
                    "steps": len(solution.steps),
                    "processor time [s]": seconds,
                }
            )
            print(rows[-1], flush=True)
    size = f"{WIDTH // reduce} x {HEIGHT // reduce}"
    return f"corners of the board against OpenCV's poses, {size} pixels, from 6 degrees and 8 mm off", rows


def solve_photograph(study: Board, scene, params, file: Path, rays: np.ndarray, reduce: int):
    """Find the board's pose and grey levels from a photograph; ``rays``: directions of its pixels."""

    def mask() -> np.ndarray:
        return study.inside(params[POSE].numpy().astype(float), rays)

    photograph = psdr.Photograph(file, response=1.0, mask=mask, reduce=reduce, saturated=2.0)
    bright = photograph.linear[photograph.weights > 0.0]
    levels = levels_of(params, study.pattern, np.quantile(bright, [0.2, 0.8]).tolist())
    params.update()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        unknowns = [psdr.unknowns.Rigid(POSE), levels]
        return psdr.solve(scene, params, photograph, unknowns=unknowns, integrator=INSIDE_ALONE, spp=SPP)


def main() -> None:
    """Run a study and report it."""
    parser = arguments(__doc__)
    parser.add_argument("study", choices=["coverage", "board"])
    parser.add_argument("--problems", type=int, default=200, help="of coverage")
    parser.add_argument("--photos", type=Path, default=Path("/usr/share/doc/opencv-doc/examples/data"))
    parser.add_argument("--reduce", type=int, default=REDUCE, help="photographs of board by this factor")
    options = parser.parse_args()
    if options.study == "board" and not (options.photos / "left_intrinsics.yml").is_file():
        raise SystemExit(f"{options.photos} has no left_intrinsics.yml; apt-get install opencv-doc, or give --photos")
    if options.study == "coverage":
        table, rows = coverage(10 if options.quick else options.problems)
    else:
        table, rows = board(options.photos, 2 if options.quick else 13, options.reduce)
    Report("photographs", options.output).table(table, rows)


if __name__ == "__main__":
    main()
