"""What is asked of a scene: parameters of each kind, drawn at random, and directions along which they change."""

import zlib

import numpy as np
from common import psdr

from warp_psdr.scene import layout

#: Kinds of parameters, in the order of the table.
KINDS = ("number", "light", "vertices", "pose", "camera pose", "texture", "lens")
#: Cameras whose films become small; those of meters and batches stay.
CAMERAS = ("perspective", "orthographic", "thinlens")
#: Half a difference: of what moves, in pixels; of values, relative. The second difference takes twice as much.
PIXELS, RELATIVE = 0.05, 0.015
#: Radians that an environment light turns by for a step of one, and shares of a texture that ``to_uv`` slides it by.
TURN, SLIDE = 0.1, 0.05


def kind_of(parameter: layout.Parameter) -> str | None:
    """Return a parameter's kind by what it acts on; None: normals and texture coordinates, which nobody asks for."""
    uses, last = parameter.uses, parameter.name.rpartition(".")[2]
    if layout.CAMERA in uses:
        return "camera pose" if last == "to_world" else "lens"
    if uses & {layout.POSITIONS, layout.SHAPE_GRID}:
        return "vertices"
    if uses & {layout.SHAPE_POSE, layout.MEDIUM + "pose"}:
        return "pose"
    if uses & {layout.NORMALS, layout.TEXCOORDS}:
        return None
    if uses & layout.BRIGHTNESS:
        return "light"
    return "texture" if layout.TO_UV in uses or len(parameter.numpy_shape) > 1 else "number"


def draw(scene: psdr.Scene, label: str, seed: int, each: int) -> list[tuple[str, str]]:
    """Return kinds and names of parameters, up to ``each`` of a kind."""
    rng = np.random.default_rng([seed, zlib.crc32(label.encode())])
    names: dict[str, list[str]] = {kind: [] for kind in KINDS}
    for name, parameter in scene.parameters.items():
        kind = kind_of(parameter)
        if kind is not None:
            names[kind].append(name)
    return [(kind, str(name)) for kind, held in names.items() for name in rng.permutation(held)[:each]]


def sensor_of(scene: psdr.Scene, name: str) -> int:
    """Return the camera that a parameter belongs to, or the first."""
    paths = [sensor.path for sensor in scene.description.sensors]
    base = name.rpartition(".")[0]
    return paths.index(base) if base in paths else 0


class Directions:
    """Random directions, in which a step of one moves what moves by about a pixel, or changes values by about all."""

    def __init__(self, scene: psdr.Scene, params: psdr.Parameters, sensor: int, rng: np.random.Generator):
        self._scene, self._params, self._rng = scene, params, rng
        camera = scene.description.sensors[sensor]
        self._pixels = max(camera.film.width, camera.film.height)
        self._origin = self._values(f"{camera.path}.to_world")[:3, 3] if camera.kind in CAMERAS else np.zeros(3)
        self._angle = 2.0 * np.tan(np.radians(max(camera.x_fov, 1.0)) / 2.0) / self._pixels
        corners = [self._values(name) for name in params if name.endswith(".vertex_positions")]
        points = np.concatenate(corners) if corners else np.array([[-1.0] * 3, [1.0] * 3])
        self._low, self._high = points.min(axis=0), points.max(axis=0)

    def _values(self, name: str) -> np.ndarray:
        return self._params[name].numpy().astype(np.float64)

    def _pixel(self, center: np.ndarray) -> float:
        return self._angle * max(float(np.linalg.norm(center - self._origin)), 1e-6)

    def _unit(self) -> np.ndarray:
        v = self._rng.normal(size=3)
        return v / np.linalg.norm(v)

    def of(self, kind: str, name: str) -> np.ndarray:
        """Return a direction in the shape of the values; zero where a step leaves a parameter's range."""
        values = self._values(name)
        tangent = self._of(kind, name, values)
        low, high = self._scene.parameters[name].bounds
        reach = 2.0 * half_step(kind, name) * np.abs(tangent)
        return np.where((values - reach < low) | (values + reach > high), 0.0, tangent)

    def _of(self, kind: str, name: str, values: np.ndarray) -> np.ndarray:
        rng, last = self._rng, name.rpartition(".")[2]
        if values.shape == (4, 4):
            return self._rigid(kind, name, values)
        if kind == "vertices" and values.ndim == 2 and values.shape[1] in (3, 4):
            return self._field(values)
        if last == "position":
            return self._unit().reshape(values.shape) * self._pixel(values.ravel())
        if last == "direction" or last.endswith("_direction"):
            return TURN * rng.normal(size=values.shape)
        if last == "to_uv":
            tangent = np.zeros(values.shape)
            tangent[:2] = SLIDE * rng.normal(size=(2, values.shape[1]))
            return tangent
        if last.startswith("principal_point_offset"):
            return np.full(values.shape, rng.choice([-1.0, 1.0]) / self._pixels)
        if last == "x_fov":
            return np.full(values.shape, rng.choice([-1.0, 1.0]) * values.mean() / self._pixels)
        scale = float(np.abs(values).mean()) or 0.1
        if kind == "texture" or values.size > 4:
            return values * self._waves(values.shape) if np.abs(values).max() else np.full(values.shape, scale)
        spread = rng.uniform(0.2, 1.0, values.shape) * rng.choice([-1.0, 1.0])
        return scale * spread

    def _waves(self, shape: tuple[int, ...]) -> np.ndarray:
        """Return smooth factors of texels (or of what has an axis or more), and one a channel."""
        rng = self._rng
        axes = shape[:-1] if len(shape) > 1 else shape
        factors = np.full(axes, 0.5)
        for grid in np.meshgrid(*[np.arange(n) / n for n in axes], indexing="ij"):
            factors += 0.5 * rng.normal() * np.sin(2.0 * np.pi * (rng.integers(1, 4) * grid + rng.random()))
        return factors[..., None] * rng.uniform(0.3, 1.0, shape[-1]) if len(shape) > 1 else factors

    def _rigid(self, kind: str, name: str, pose: np.ndarray) -> np.ndarray:
        """Return a translation and a turn about the object's center; of a camera, of what it sees about its place."""
        base, center = name.rpartition(".")[0], pose[:3, 3]
        if kind == "light" and base not in self._moved_lights():
            turn, move = self._unit() * TURN, np.zeros(3)
        elif kind == "camera pose":
            away = max(float(np.linalg.norm(0.5 * (self._low + self._high) - center)), 1e-3)
            turn, move = self._unit() * self._angle, self._unit() * self._angle * away
        else:
            points = self._values(f"{base}.vertex_positions") if f"{base}.vertex_positions" in self._params else None
            size = 2.0 * abs(np.linalg.det(pose[:3, :3])) ** (1.0 / 3.0)
            if points is not None:
                center, size = 0.5 * (points.min(axis=0) + points.max(axis=0)), np.linalg.norm(np.ptp(points, axis=0))
            pixel = self._pixel(center)
            turn, move = self._unit() * pixel / max(0.5 * size, pixel), self._unit() * pixel
        x, y, z = turn
        rate = np.zeros((4, 4))
        rate[:3, :3] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
        rate[:3, 3] = move - rate[:3, :3] @ center
        return rate @ pose

    def _moved_lights(self) -> set[str]:
        """Return paths of lights that stand somewhere."""
        return {e.path for e in self._scene.description.emitters if e.kind in ("spot", "projector")}

    def _field(self, points: np.ndarray) -> np.ndarray:
        """Return a smooth motion of points: a translation, a linear map, and waves; radii of curves stay."""
        rng, x = self._rng, points[:, :3]
        center, size = 0.5 * (x.min(axis=0) + x.max(axis=0)), max(float(np.linalg.norm(np.ptp(x, axis=0))), 1e-9)
        y = 2.0 * (x - center) / size
        moved = self._unit() + 0.5 * y @ rng.normal(size=(3, 3)) + 0.3 * np.sin(3.0 * y @ rng.normal(size=(3, 3)))
        tangent = np.zeros(points.shape)
        tangent[:, :3] = moved * self._pixel(center)
        return tangent


def half_step(kind: str, name: str) -> float:
    """Return half of the smaller difference, along a tangent."""
    lens = kind == "lens" and not name.endswith(("aperture_radius", "focus_distance"))
    moves = kind in ("vertices", "pose", "camera pose") or lens or name.endswith((".to_world", ".position", ".to_uv"))
    return PIXELS if moves or name.endswith("direction") else RELATIVE
