"""A checkerboard as a scene, and OpenCV's photographs of its board (Debian's ``opencv-doc``) with its lens and poses.

For ``photographs.py`` and ``board_cameras.py``. The board rests at the origin, or is moved by ``board.to_world``.
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from common import psdr
from scipy.spatial.transform import Rotation

from warp_psdr.scene.distortion import undistort

T = psdr.Transform
POSE = "board.to_world"
#: Edge of a square, m; size of the photographs, pixels, and by how much they are reduced.
SQUARE, WIDTH, HEIGHT, REDUCE = 0.025, 640, 480, 4
#: Half the window in which OpenCV refines a corner, pixels: its program's 11 reaches neighbours of far corners.
WINDOW = 7
#: Texels of a square; half of what of the board is compared, squares.
TEXELS, INSIDE = 16, (4.3, 2.9)
#: The masks leave out what moves when the board's border does.
INSIDE_ALONE = psdr.PathIntegrator(max_depth=2, boundary=None)
#: From our camera's axes, which point to the left and up, to OpenCV's.
TO_OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])


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


class Lens:
    """A lens of square pixels.

    Args:
        numbers: (8,) focal length, x and y of the centre, pixels of the photograph, and OpenCV's k1, k2, p1, p2, k3.
    """

    def __init__(self, numbers: np.ndarray):
        self.numbers = np.asarray(numbers, float)

    def sensor(self, to_camera: np.ndarray, reduce: int = REDUCE) -> dict:
        """Return the sensor of a reduced photograph; ``to_camera``: (4, 4) of the world's points, OpenCV's axes."""
        f, x, y, *bends = self.numbers
        matrix = [[f, 0.0, x], [0.0, f, y], [0.0, 0.0, 1.0]]
        sensor = psdr.cameras.from_opencv(matrix, to_camera[:3, :3], to_camera[:3, 3], (WIDTH, HEIGHT), bends)
        sensor["film"] |= {"width": WIDTH // reduce, "height": HEIGHT // reduce}
        return sensor

    def directions(self) -> np.ndarray:
        """Return directions of the photograph's pixels (H, W, 3), OpenCV's axes."""
        f, center = self.numbers[0], self.numbers[1:3]
        y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
        bent = (np.stack([x, y], axis=-1) - center) / f
        # The renderer's axes point to the left and up.
        numbers = np.concatenate([[1.0, 0.0], self.numbers[3:], np.zeros(3)])
        plain = -undistort("opencv", numbers, -bent.reshape(-1, 2)).reshape(bent.shape)
        return np.concatenate([plain, np.ones((HEIGHT, WIDTH, 1))], axis=-1)


class Calibration(NamedTuple):
    """What OpenCV finds from corners.

    Attributes:
        lens: of the camera.
        to_camera: (N, 4, 4) of the board's points, OpenCV's axes.
        errors: (N,) what each photograph's corners leave, root mean square, pixels.
    """

    lens: Lens
    to_camera: np.ndarray
    errors: np.ndarray


class Board:
    """OpenCV's photographs of its board, the left lens and the poses that it found.

    Attributes:
        lens: of the left camera.
        to_camera: (13, 4, 4) of the board's points, its middle the origin, to the left camera, OpenCV's axes.
    """

    def __init__(self, folder: Path):
        told = (folder / "left_intrinsics.yml").read_text(encoding="utf-8")

        def numbers(key: str, shape: tuple[int, ...]) -> np.ndarray:
            held = re.search(key + r".*?data: \[(.*?)\]", told, re.DOTALL)
            return np.array([float(x) for x in held.group(1).split(",")]).reshape(shape)

        self.numbers = (*range(1, 10), *range(11, 15))
        matrix, bends = numbers("camera_matrix", (3, 3)), numbers("distortion_coefficients", (5,))
        self.lens = Lens(np.append([matrix[0, 0], matrix[0, 2], matrix[1, 2]], bends))
        self.pattern = squares(7, 10, TEXELS)
        corners = np.array([[-1, -1, 0], [9, -1, 0], [9, 6, 0], [-1, 6, 0]]) * SQUARE
        self._middle = corners.mean(axis=0)
        self.corners = corners - self._middle
        self._drawn = np.stack(np.meshgrid(np.arange(9), np.arange(6), [0]), axis=-1).reshape(-1, 3) * SQUARE
        self.inner = self._drawn - self._middle
        found = numbers("extrinsic_parameters", (13, 6))
        self.to_camera = self._poses(found[:, :3], found[:, 3:])

    def _poses(self, turns: np.ndarray, shifts: np.ndarray) -> np.ndarray:
        """Return (N, 4, 4) of the board's points from OpenCV's rotation vectors and shifts, (N, 3) each."""
        poses = np.tile(np.eye(4), (len(turns), 1, 1))
        poses[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
        poses[:, :3, 3] = shifts + poses[:, :3, :3] @ self._middle
        return poses

    def by_corners(self, files: list[Path]) -> Calibration | None:
        """Return what OpenCV finds from the corners of all photographs of a camera; None without ``cv2``."""
        try:
            import cv2
        except ImportError:
            return None
        seen = []
        for file in files:
            grey = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
            _found, corners = cv2.findChessboardCorners(grey, (9, 6))
            seen.append(cv2.cornerSubPix(grey, corners, (WINDOW, WINDOW), (-1, -1), (3, 30, 1e-3)))
        start = np.diag([self.lens.numbers[0], self.lens.numbers[0], 1.0])
        _error, matrix, bends, turns, shifts, _, _, errors = cv2.calibrateCameraExtended(
            [np.float32(self._drawn)] * len(seen), seen, (WIDTH, HEIGHT), start, None, flags=cv2.CALIB_FIX_ASPECT_RATIO
        )
        lens = Lens(np.append([matrix[0, 0], matrix[0, 2], matrix[1, 2]], bends.ravel()[:5]))
        poses = self._poses(np.stack(turns).reshape(-1, 3), np.stack(shifts).reshape(-1, 3))
        return Calibration(lens, poses, errors.ravel())

    def files(self, folder: Path, side: str) -> list[Path]:
        """Return the photographs of the left or the right camera."""
        return [folder / f"{side}{i:02}.jpg" for i in self.numbers]

    def apart(self, found: np.ndarray, truth: np.ndarray, focal: float) -> float:
        """Return how far two poses have inner corners apart, root mean square, pixels, without the lens's bends."""

        def pixels(to_camera: np.ndarray) -> np.ndarray:
            seen = self.inner @ to_camera[:3, :3].T + to_camera[:3, 3]
            return focal * seen[:, :2] / seen[:, 2:]

        return float(np.sqrt(((pixels(found) - pixels(truth)) ** 2).sum(axis=1).mean()))

    def inside(self, to_camera: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the mask of the board's squares that a camera sees, a photograph's size.

        Args:
            to_camera: (4, 4) of the board's points, OpenCV's axes.
            directions: (H, W, 3) of the photograph's pixels, OpenCV's axes.
        """
        normal, at = to_camera[:3, 2], to_camera[:3, 3]
        met = directions * ((normal @ at) / (directions @ normal))[..., None] - at
        x, y = met @ to_camera[:3, 0], met @ to_camera[:3, 1]
        return ((np.abs(x) < INSIDE[0] * SQUARE) & (np.abs(y) < INSIDE[1] * SQUARE)).astype(float)


def moved(pose: np.ndarray, degrees: float, length: float, rng: np.random.Generator) -> np.ndarray:
    """Return a pose turned by an angle about a random axis, and shifted by a length along another."""
    turn, move = rng.normal(size=3), rng.normal(size=3)
    found = pose.copy()
    found[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * turn / np.linalg.norm(turn)).as_matrix() @ pose[:3, :3]
    found[:3, 3] += length * move / np.linalg.norm(move)
    return found
