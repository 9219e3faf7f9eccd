"""Two cameras from OpenCV's 26 photographs of its board: lenses, found with all poses at once, and their baseline.

    python examples/benchmarks/board_cameras.py --photos /usr/share/doc/opencv-doc/examples/data [--output ...]

**Lenses**: the 13 photographs of a camera together, first poses and light, then all; focal length, centre, k1, k2, p1,
p2, k3, and 13 poses. The left lens starts 2 % off in focal length, with the film's centre, and k1 -.2 alone; its poses
1 degree and 4 mm off those by which that lens sees the board where it is. The right camera starts from the left lens
and poses found, 80 mm aside, and is moved as one rig first. Compared with are OpenCV's file of the left lens, and,
where ``cv2`` is installed, what OpenCV finds from corners that are refined in smaller windows than those of the file.

**Pairs**: in each of 13 pairs the board and the right camera's pose are unknown, the lenses are those found; it starts
80 mm aside. One rig has one baseline: the row says how far a pair's length is from the mean of the others', over its
95 % bar.
"""

import time
import warnings
from pathlib import Path

import numpy as np
from common import Report, arguments, psdr
from opencv_board import (
    INSIDE_ALONE,
    POSE,
    REDUCE,
    TO_OPENCV,
    Board,
    Lens,
    levels_of,
    moved,
    scene_of,
)
from scipy import stats
from scipy.spatial.transform import Rotation

#: Samples of a derivative; how far off poses start, degrees and m; the rig's length as a ruler tells it, m.
SPP, OFF, RULER = 4, (1.0, 0.004), 0.08
#: What the lens's numbers are, and where they start.
LABELS = ("f", "x", "y", "k1", "k2", "p1", "p2", "k3")
START = Lens(np.array([546.0, 319.5, 239.5, -0.2, 0.0, 0.0, 0.0, 0.0]))


class Camera:
    """The 13 photographs of one camera, a sensor each, before a board at rest."""

    def __init__(self, study: Board, files: list[Path], start: Lens, poses: np.ndarray):
        self.study, self.start, self.poses = study, start, poses
        self.names = [file.stem for file in files]
        sensors = {name: start.sensor(pose) for name, pose in zip(self.names, poses, strict=True)}
        self.scene = scene_of(study.corners, study.pattern, sensors)
        self.params = psdr.traverse(self.scene)
        self._directions = start.directions()
        self.photographs = {
            name: psdr.Photograph(
                file,
                response=1.0,
                mask=lambda n=name: study.inside(self.pose(n), self._directions),
                reduce=REDUCE,
                saturated=2.0,
                unknowns=["exposure"],
            )
            for name, file in zip(self.names, files, strict=True)
        }

    def pose(self, name: str) -> np.ndarray:
        """Return (4, 4) of the board's points to a camera, OpenCV's axes."""
        return TO_OPENCV @ np.linalg.inv(self.params[f"{name}.to_world"].numpy().astype(float))

    def parameters(self, numbers: np.ndarray) -> dict[str, np.ndarray]:
        """Return all cameras' parameters of a lens."""
        sensor = Lens(numbers).sensor(np.eye(4))
        held = {"x_fov": sensor["fov"]}
        for key in (*("principal_point_offset_x", "principal_point_offset_y"), *LABELS[3:]):
            held[key] = sensor.get(key, 0.0)
        return {f"{name}.{key}": np.array([value]) for name in self.names for key, value in held.items()}

    def rig(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """Return all cameras' poses if each is moved alike from where it started; x: a rotation vector and a shift."""
        moved = np.eye(4)
        moved[:3, :3], moved[:3, 3] = Rotation.from_rotvec(x[:3]).as_matrix(), x[3:]
        found = zip(self.names, self.poses, strict=True)
        return {f"{name}.to_world": np.linalg.inv(moved @ pose) @ TO_OPENCV for name, pose in found}

    def solve(self, *, moves_alike: bool = False):
        """Find the poses and the light, and then the lens with them; first one motion of all poses if they have it."""
        bright = np.concatenate([p.linear[p.weights > 0.0] for p in self.photographs.values()])
        low, high = np.quantile(bright, [0.2, 0.8])
        name = next(n for n in self.params if n.endswith("reflectance.data"))
        pattern = self.study.pattern
        # The exposures tell how bright the light squares are.
        dark = psdr.unknowns.Function(lambda x: {name: high * (x[0] + (1.0 - x[0]) * pattern)}, [low / high], ["dark"])
        dark.restore(self.params, dark.x)
        self.params.update()
        self.unknown = psdr.unknowns.Function(self.parameters, self.start.numbers, LABELS)
        poses = [psdr.unknowns.Rigid(f"{n}.to_world") for n in self.names]

        def after(step) -> None:
            # Masks follow the lens.
            print(step, np.round(self.unknown.x, 4), flush=True)
            self._directions = Lens(self.unknown.x).directions()

        def found(unknowns: list):
            return psdr.solve(
                self.scene,
                self.params,
                self.photographs,
                unknowns=unknowns,
                integrator=INSIDE_ALONE,
                spp=SPP,
                progress=after,
            )

        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # a lens that is off leaves residuals
            if moves_alike:
                found([dark, psdr.unknowns.Function(self.rig, [0.0] * 6)])
            found([dark, *poses])
        return found([self.unknown, dark, *poses])


def aside() -> np.ndarray:
    """Return (4, 4) from the left camera's points to the right's as a ruler tells it, OpenCV's axes."""
    found = np.eye(4)
    found[0, 3] = -RULER
    return found


def lenses(study: Board, files: dict[str, list[Path]], cameras: dict[str, Camera], found: dict) -> list[dict]:
    """Return rows: each number of both lenses with its bar, beside OpenCV's."""
    rows = []
    for side, camera in cameras.items():
        low, high = found[side].interval()
        corners = study.by_corners(files[side])
        for i, label in enumerate(LABELS):
            row = {"camera": side, "number": label, "start": camera.start.numbers[i], "found": camera.unknown.x[i]}
            row |= {"95 % bar": 0.5 * (high[i] - low[i])}
            row |= {"OpenCV's corners": "none" if corners is None else corners.lens.numbers[i]}
            rows.append(row | {"OpenCV's file": study.lens.numbers[i] if side == "left" else "none"})
    return rows


def pairs(study: Board, folder: Path, left: Camera, right: Camera) -> list[dict]:
    """Return rows: the baseline of each pair of photographs, each found by itself."""
    rig = np.linalg.inv(aside()) @ TO_OPENCV
    sides = {"left": Lens(left.unknown.x), "right": Lens(right.unknown.x)}
    sensors = {side: lens.sensor(np.eye(4)) for side, lens in sides.items()}
    scene = scene_of(study.corners, study.pattern, sensors)
    params = psdr.traverse(scene)
    directions = {side: lens.directions() for side, lens in sides.items()}
    files = {side: study.files(folder, side) for side in sides}

    def pose(side: str) -> np.ndarray:
        sensor = params[f"{side}.to_world"].numpy().astype(float)
        return TO_OPENCV @ np.linalg.inv(sensor) @ params[POSE].numpy().astype(float)

    rows = []
    for i, name in enumerate(left.names):
        params[POSE] = left.pose(name).astype(np.float32)  # the world's axes are those of the left camera
        params["right.to_world"] = rig.astype(np.float32)
        params.update()
        observed = {
            side: psdr.Photograph(
                files[side][i],
                response=1.0,
                mask=lambda s=side: study.inside(pose(s), directions[s]),
                reduce=REDUCE,
                saturated=2.0,
                unknowns=["exposure"] if side == "right" else [],
            )
            for side in sides
        }
        bright = observed["left"].linear[observed["left"].weights > 0.0]
        levels = levels_of(params, study.pattern, np.quantile(bright, [0.2, 0.8]).tolist())
        params.update()
        unknowns = [psdr.unknowns.Rigid("right.to_world"), psdr.unknowns.Rigid(POSE), levels]
        began = time.process_time()
        found = psdr.solve(scene, params, observed, unknowns=unknowns, integrator=INSIDE_ALONE, spp=SPP)
        base = params["right.to_world"].numpy().astype(float)[:3, 3]
        along = base / np.linalg.norm(base)
        deviation = float(np.sqrt(along @ found.covariance[3:6, 3:6] @ along))
        rows.append(
            {
                "pair": f"{name}, {right.names[i]}",
                "baseline [mm]": 1e3 * float(np.linalg.norm(base)),
                "95 % bar [mm]": 1e3 * deviation * float(stats.t.ppf(0.975, found.errors.freedom[3:6].min())),
                "steps": len(found.steps),
                "processor time [s]": time.process_time() - began,
            }
        )
        print(rows[-1], flush=True)
    lengths = np.array([row["baseline [mm]"] for row in rows])
    for row, length, others in zip(rows, lengths, (lengths.sum() - lengths) / (len(lengths) - 1), strict=True):
        row["off the others [bars]"] = float((length - others) / row["95 % bar [mm]"])
    return rows


def main() -> None:
    """Find both lenses, then the baseline of each pair, and report them."""
    parser = arguments(__doc__)
    parser.add_argument("--photos", type=Path, default=Path("/usr/share/doc/opencv-doc/examples/data"))
    options = parser.parse_args()
    if not (options.photos / "left_intrinsics.yml").is_file():
        raise SystemExit(f"{options.photos} has no left_intrinsics.yml; apt-get install opencv-doc, or give --photos")
    study, rng, found = Board(options.photos), np.random.default_rng(0), {}
    count = 3 if options.quick else len(study.numbers)
    report = Report("photographs", options.output)
    x, y = (study.lens.numbers - START.numbers)[1:3] / START.numbers[0]
    aim = np.eye(4)
    aim[:3, :3] = Rotation.from_rotvec([-y, x, 0.0]).as_matrix()
    starts = np.array([moved(aim @ pose, *OFF, rng) for pose in study.to_camera[:count]])
    left = Camera(study, study.files(options.photos, "left")[:count], START, starts)
    found["left"] = left.solve()
    starts = np.array([aside() @ left.pose(name) for name in left.names])
    right = Camera(study, study.files(options.photos, "right")[:count], Lens(left.unknown.x), starts)
    found["right"] = right.solve(moves_alike=True)
    cameras = {"left": left, "right": right}
    files = {side: study.files(options.photos, side) for side in cameras}
    title = f"lenses of both cameras, {count} photographs of each at once"
    report.table(title, lenses(study, files, cameras, found))
    report.table("the rig's baseline, each pair by itself", pairs(study, options.photos, left, right))


if __name__ == "__main__":
    main()
