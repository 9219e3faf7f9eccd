"""Values and error bars from photographs: of a calibration board, and of rendered problems whose truth is known.

    python examples/benchmarks/photographs.py coverage [--problems 200] [--output docs/data/photographs.jsonl]
    python examples/benchmarks/photographs.py board --photos /usr/share/doc/opencv-doc/examples/data [--output ...]

**coverage**: a checkerboard under even light is photographed with what photographs have and the solver is not told:
noise, JPEG, a response of 2.0 that is read as 2.2, light that is up to a third brighter on one side. The row says how
often 95 % bars of the board's pose hold the truth.

**board**: 13 photographs of OpenCV's board, 640 x 480, reduced to 160 x 120, as Debian's ``opencv-doc`` installs them.
Poses start 6 degrees and 8 mm off. OpenCV's lens is given, and its poses are compared with. Codes are taken for linear,
which leaves the least residual. Where OpenCV's own residual is above a pixel, its pose is the one that is off.
"""

import io
import re
import time
import warnings
from pathlib import Path

import numpy as np
from common import Report, arguments, psdr
from PIL import Image
from scipy.spatial.transform import Rotation

from warp_psdr.scene.distortion import undistort

T = psdr.Transform
POSE = "board.to_world"
#: Coverage: film, samples of a derivative, of a photograph.
SIZE, SPP, PHOTO_SPP = (64, 48), 8, 256
#: Board: edge of a square, m; reduction; how far off the start is, degrees and m.
SQUARE, REDUCE, OFF = 0.025, 4, (6.0, 0.008)
#: Texels of a square; half of what of the board is compared, squares.
TEXELS, INSIDE = 16, (4.3, 2.9)
#: The masks leave out what moves when the board's border does.
INSIDE_ALONE = psdr.PathIntegrator(max_depth=2, boundary=None)


def squares(rows: int, columns: int, texels: int) -> np.ndarray:
    """Return a checkerboard, dark first, (H, W, 3)."""
    pattern = np.add.outer(np.arange(rows), np.arange(columns)) % 2
    return (np.kron(pattern, np.ones((texels, texels)))[..., None] * np.ones(3)).astype(np.float32)


def scene_of(corners: np.ndarray, texture: np.ndarray, sensors: dict) -> psdr.Scene:
    """Return a board under an even sky."""
    paint = {"type": "bitmap", "data": texture, "raw": True, "wrap_mode": "clamp"}
    board = {
        "type": "mesh",
        "vertices": np.float32(corners),
        "faces": np.int32([[0, 1, 2], [0, 2, 3]]),
        "texcoords": np.float32([[0, 0], [1, 0], [1, 1], [0, 1]]),
        "face_normals": True,
        "to_world": T.translate([0.0, 0.0, 0.0]),
        "bsdf": {"type": "twosided", "inner": {"type": "diffuse", "reflectance": paint}},
    }
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}}
    path = {"type": "path", "max_depth": 2}
    return psdr.load_dict({"type": "scene", "integrator": path, "board": board, "sky": sky, **sensors})


def levels_of(params: psdr.Parameters, pattern: np.ndarray, start: list[float]) -> psdr.unknowns.Function:
    """Return the two grey levels of a board as unknowns, and write their start."""
    name = next(n for n in params if n.endswith("reflectance.data"))
    levels = psdr.unknowns.Function(lambda x: {name: x[0] + (x[1] - x[0]) * pattern}, start, ["dark", "light"])
    levels.restore(params, levels.x)
    return levels


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


class Board:
    """OpenCV's photographs of its board, the lens and the poses that it found."""

    def __init__(self, folder: Path):
        told = (folder / "left_intrinsics.yml").read_text(encoding="utf-8")

        def numbers(key: str, shape: tuple[int, ...]) -> np.ndarray:
            held = re.search(key + r".*?data: \[(.*?)\]", told, re.DOTALL)
            return np.array([float(x) for x in held.group(1).split(",")]).reshape(shape)

        self.names = [f"left{i:02}.jpg" for i in (*range(1, 10), *range(11, 15))]
        self.files = [folder / name for name in self.names]
        self.lens, self.bends = numbers("camera_matrix", (3, 3)), numbers("distortion_coefficients", (5,))
        self.poses, self.errors = (
            numbers("extrinsic_parameters", (13, 6)),
            numbers("per_view_reprojection_errors", (13,)),
        )
        self.pattern = squares(7, 10, TEXELS)
        corners = np.array([[-1, -1, 0], [9, -1, 0], [9, 6, 0], [-1, 6, 0]]) * SQUARE
        self.middle = corners.mean(axis=0)
        self.corners = corners - self.middle
        inner = np.stack(np.meshgrid(np.arange(9), np.arange(6), [0]), axis=-1).reshape(-1, 3) * SQUARE
        self.inner = inner - self.middle

    def camera(self, number: int | None) -> dict:
        """Return the sensor that took a photograph, at its OpenCV pose with the board at rest; None: at the origin."""
        lens = self.lens.copy()
        lens[:2] /= REDUCE
        lens[:2, 2] = (self.lens[:2, 2] + 0.5) / REDUCE - 0.5
        turn, move = np.zeros(3), np.zeros(3)
        if number is not None:
            turn = self.poses[number, :3]
            move = self.poses[number, 3:] + Rotation.from_rotvec(turn).apply(self.middle)
        sensor = psdr.cameras.from_opencv(lens, turn, move, (640 // REDUCE, 480 // REDUCE), self.bends)
        sensor["film"] |= {"rfilter": {"type": "box"}}
        return sensor

    def pixels(self, to_camera: np.ndarray) -> np.ndarray:
        """Return where inner corners are in a photograph, pixels, without the lens's bends."""
        seen = self.inner @ to_camera[:3, :3].T + to_camera[:3, 3]
        return seen[:, :2] / seen[:, 2:] * self.lens[0, 0]

    def inside(self, to_camera: np.ndarray, sensor: np.ndarray) -> np.ndarray:
        """Return the mask of the board's squares that a camera sees, a photograph's size.

        Args:
            to_camera: (4, 4) of the board's points, OpenCV's axes.
            sensor: (480, 640, 3) directions of the photograph's pixels, OpenCV's axes.
        """
        normal, at = to_camera[:3, 2], to_camera[:3, 3]
        met = sensor * ((normal @ at) / (sensor @ normal))[..., None] - at
        x, y = met @ to_camera[:3, 0], met @ to_camera[:3, 1]
        return ((np.abs(x) < INSIDE[0] * SQUARE) & (np.abs(y) < INSIDE[1] * SQUARE)).astype(float)

    def directions(self) -> np.ndarray:
        """Return directions of pixels, OpenCV's axes."""
        y, x = np.mgrid[0:480, 0:640]
        bent = np.stack([(x - self.lens[0, 2]) / self.lens[0, 0], (y - self.lens[1, 2]) / self.lens[1, 1]], axis=-1)
        # The renderer's axes point to the left and up.
        numbers = np.concatenate([[1.0, 0.0], self.bends, np.zeros(3)])
        plain = -undistort("opencv", numbers, -bent.reshape(-1, 2)).reshape(bent.shape)
        return np.concatenate([plain, np.ones((480, 640, 1))], axis=-1)


def board(folder: Path, count: int) -> tuple[str, list[dict]]:
    """Return a table of single photographs: how far corners are from where OpenCV's poses have them."""
    study = Board(folder)
    rays, rows = study.directions(), []
    scene = scene_of(study.corners, study.pattern, {"sensor": study.camera(None)})
    params = psdr.traverse(scene)
    for number in range(count):
        rng = np.random.default_rng(number)
        truth = np.eye(4)
        truth[:3, :3] = Rotation.from_rotvec(study.poses[number, :3]).as_matrix()
        truth[:3, 3] = study.poses[number, 3:] + truth[:3, :3] @ study.middle
        turn, move = rng.normal(size=3), rng.normal(size=3)
        start = truth.copy()
        start[:3, :3] = (
            Rotation.from_rotvec(np.radians(OFF[0]) * turn / np.linalg.norm(turn)).as_matrix() @ truth[:3, :3]
        )
        start[:3, 3] += OFF[1] * move / np.linalg.norm(move)
        params[POSE] = start.astype(np.float32)
        params.update()

        def found() -> np.ndarray:
            return params[POSE].numpy().astype(float)

        def apart(pose: np.ndarray, truth: np.ndarray = truth) -> float:
            return float(np.sqrt(((study.pixels(pose) - study.pixels(truth)) ** 2).sum(axis=1).mean()))

        before, began = apart(start), time.process_time()
        photograph = psdr.Photograph(
            study.files[number], response=1.0, mask=lambda: study.inside(found(), rays), reduce=REDUCE, saturated=2.0
        )
        bright = photograph.linear[photograph.weights > 0.0]
        levels = levels_of(params, study.pattern, np.quantile(bright, [0.2, 0.8]).tolist())
        params.update()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            unknowns = [psdr.unknowns.Rigid(POSE), levels]
            solution = psdr.solve(scene, params, photograph, unknowns=unknowns, integrator=INSIDE_ALONE, spp=SPP)
        bars = solution.interval()[1] - solution.values
        rows.append(
            {
                "photograph": study.names[number],
                "start [px]": before,
                "found [px]": apart(found()),
                "OpenCV's own residual [px]": float(study.errors[number]),
                "95 % bar of turns [deg]": float(np.degrees(np.linalg.norm(bars[:3]))),
                "of the distance [mm]": float(1e3 * bars[5]),
                "distance off [mm]": float(1e3 * (found()[2, 3] - truth[2, 3])),
                "steps": len(solution.steps),
                "processor time [s]": time.process_time() - began,
            }
        )
        print(rows[-1], flush=True)
    return "corners of the board against OpenCV's poses, 160 x 120 pixels, from 6 degrees and 8 mm off", rows


def main() -> None:
    """Run a study and report it."""
    parser = arguments(__doc__)
    parser.add_argument("study", choices=["coverage", "board"])
    parser.add_argument("--problems", type=int, default=200, help="of coverage")
    parser.add_argument("--photos", type=Path, default=Path("/usr/share/doc/opencv-doc/examples/data"))
    options = parser.parse_args()
    if options.study == "board" and not (options.photos / "left_intrinsics.yml").is_file():
        raise SystemExit(f"{options.photos} has no left_intrinsics.yml; apt-get install opencv-doc, or give --photos")
    if options.study == "coverage":
        table, rows = coverage(10 if options.quick else options.problems)
    else:
        table, rows = board(options.photos, 2 if options.quick else 13)
    Report("photographs", options.output).table(table, rows)


if __name__ == "__main__":
    main()
