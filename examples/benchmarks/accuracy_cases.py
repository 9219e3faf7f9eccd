"""Scenes and parameters whose gradients' accuracy is predicted and spent, for two benchmarks."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import boundary_global
import boundary_soft_shadow
import numpy as np
from common import psdr
from work_precision_data import Records

from scenes import BLUE, CASES, CORNELL, DELTA, SKY, Case, mesh, stage, write_data
from warp_psdr.accuracy import quantity as quantities

#: How far what moves lies from where it is sought, over the scene's radius; what is sought of other values, in times of
#: what they are and plus; and samples a pixel of the image and of the target that a loss compares.
SHIFT, FACTOR, OFFSET, IMAGE_SPP, TARGET_SPP = 0.05, 0.7, 0.1, 32, 256
KDTREE = psdr.boundary.PathSpace(guiding=psdr.guiding.KdTree())

CUBE = f"""<shape type="cube" id="object"><transform name="to_world"><scale value="0.4"/><rotate x="0.70710678"
z="0.70710678" angle="30"/>
    </transform>{BLUE}</shape>"""
MIRROR = """<shape type="rectangle" id="mirror"><transform name="to_world"><scale value="1.5"/>
    <translate y="0.3" z="-1.2"/></transform><bsdf type="conductor"><string name="material" value="none"/></bsdf>
    </shape>"""


@dataclass(frozen=True)
class Pair:
    """A scene and what is differentiated in it.

    Attributes:
        scene: what it is.
        file: folder -> the scene file in it.
        parameters: names or patterns; empty: the image itself.
        depth: most path vertices.
        boundary: method of the boundary term.
    """

    scene: str
    file: Callable[[Path], Path]
    parameters: tuple[str, ...]
    depth: int
    boundary: psdr.boundary.Method | str = "auto"

    def __str__(self) -> str:
        return f"{self.scene}: {', '.join(self.parameters) or 'the image'}"


def _case(name: str) -> Callable[[Path], Path]:
    return lambda folder: CASES[name].write(folder, name)


def _cube(folder: Path) -> Path:
    return Case(stage(CUBE, DELTA)).write(folder, "cube")


def _cube_under_sky(folder: Path) -> Path:
    return Case(stage(CUBE, SKY)).write(folder, "cube_sky")


def _small(folder: Path) -> Path:
    return Case(stage(mesh("ball.ply", BLUE, scale=0.12, y=-0.85), SKY)).write(folder, "small")


def _mirrored(folder: Path) -> Path:
    return Case(stage(CUBE + MIRROR, SKY)).write(folder, "mirrored")


def _sliding(folder: Path) -> Path:
    return next(iter(boundary_global.write_scenes(folder).values()))


PAIRS = (
    Pair("Cornell box", lambda _folder: CORNELL, (), 6),
    Pair("Cornell box", _case("Cornell box"), ("*.reflectance.value",), 6),
    Pair("rough gold under a sky", _case("rough gold under a sky"), ("object.bsdf.alpha.value",), 4),
    Pair("textured mesh", _case("textured mesh"), ("object.bsdf.reflectance.data",), 4),
    Pair("100 lights", _case("100 lights"), ("floor.bsdf.reflectance.value",), 3),
    Pair("a cube under point, spot and sun", _cube, ("object.vertex_positions",), 2),
    Pair("Cornell box, a box slides", _sliding, ("small-box.vertex_positions",), 4),
    Pair("soft shadow of a mesh", boundary_soft_shadow.write_scene, ("sphere.vertex_positions",), 2),
    Pair("soft shadow, guided", boundary_soft_shadow.write_scene, ("sphere.vertex_positions",), 2, KDTREE),
    Pair("Cornell box, the camera moves", _case("Cornell box"), ("sensor.to_world",), 3),
    Pair("a cube under a sky", _cube_under_sky, ("object.vertex_positions",), 2),
    Pair("a small ball under a sky", _small, ("object.vertex_positions",), 3),
    Pair("a cube before a mirror", _mirrored, ("object.vertex_positions",), 3),
)
#: Pairs that nothing of the pilot or of budgets was chosen by: predictions are judged by them, too.
FRESH = (
    Pair("Cornell box, the light moves", _case("Cornell box"), ("light.to_world",), 3),
    Pair("rough gold under a sky", _case("rough gold under a sky"), ("object.bsdf.eta.value",), 4),
    Pair("a ball under point, spot and sun", _case("point, spot and sun"), ("emitter_0.position",), 2),
    Pair("textured mesh, the camera zooms", _case("textured mesh"), ("sensor.x_fov",), 2),
)


class Loaded:
    """A pair's scene, and the arguments of its accuracy and its gradient.

    Args:
        pair: what is loaded.
        folder: where its files are written.
        resolution: pixels of a side.
        adjoint: "loss": of the mean squared difference between an image and a target, as a fit has them: noisy, and the
            target of a scene whose geometry lies ``SHIFT`` away, whose other values are ``FACTOR`` times as large plus
            ``OFFSET``. "waves": smooth over the whole image and of both signs, which no residual is.
    """

    def __init__(self, pair: Pair, folder: Path, resolution: int, adjoint: str = "loss"):
        write_data(folder)
        self.scene = psdr.load_file(pair.file(folder), resolution=resolution)
        self.params = psdr.traverse(self.scene)
        self.integrator = psdr.PathIntegrator(max_depth=pair.depth, boundary=pair.boundary)
        self.image = not pair.parameters
        if self.image:
            return
        self.params.requires_grad(*pair.parameters)
        film = self.scene.description.sensors[0].film
        if adjoint == "loss":
            self.adjoint = self._residual()
            return
        y, x = np.mgrid[0 : film.crop_height, 0 : film.crop_width] / film.crop_height
        waves = [0.5 + np.sin(3.0 * x + 5.0 * y + k) for k in range(3)]
        self.adjoint = np.stack(waves, axis=-1).astype(np.float32) / (film.crop_height * film.crop_width)

    def _residual(self) -> np.ndarray:
        image = psdr.render(self.scene, integrator=self.integrator, spp=IMAGE_SPP, seed=8).numpy()
        base = {name: self.params[name].numpy().copy() for name in self.params.requested}
        for name, values in base.items():
            self.params[name] = self._sought(name, values)
        self.params.update()
        target = psdr.render(self.scene, integrator=self.integrator, spp=TARGET_SPP, seed=7).numpy()
        for name, values in base.items():
            self.params[name] = values
        self.params.update()
        return (2.0 / image.size) * (image - target)

    def _sought(self, name: str, values: np.ndarray) -> np.ndarray:
        shift = SHIFT * self.scene.radius
        if values.shape == (4, 4):
            moved = values.copy()
            moved[0, 3] += shift
            return moved
        if name.endswith("vertex_positions"):
            return values + np.array([shift, 0.0, 0.0], values.dtype)
        return FACTOR * values + OFFSET

    def accuracy(self, **options):
        """Run the pilot."""
        if self.image:
            return psdr.accuracy(self.scene, integrator=self.integrator, **options)
        return psdr.accuracy(self.scene, self.params, self.adjoint, integrator=self.integrator, **options)

    def spend(self, **options):
        """Return (what was reached, the blocks of the gradient or of the image)."""
        if self.image:
            bought = []
            image = psdr.render(self.scene, integrator=self.integrator, reached=bought.append, **options)
            return bought[0], [image.numpy().reshape(-1).astype(np.float64)]
        self.params.zero_grad()
        options["integrator"] = self.integrator
        reached = psdr.render_backward(self.scene, self.params, self.adjoint, **options)
        return reached, self._blocks()

    def gradient(self, **options) -> list[np.ndarray]:
        """Return the blocks of a gradient without a budget."""
        self.params.zero_grad()
        psdr.render_backward(self.scene, self.params, self.adjoint, integrator=self.integrator, **options)
        return self._blocks()

    def quantity(self) -> quantities.Quantity:
        """Return what is estimated, term by term."""
        if self.image:
            return quantities.image(self.scene, integrator=self.integrator, sensor=0)
        return quantities.gradient(self.scene, self.params, self.adjoint, integrator=self.integrator, sensor=0)

    @property
    def moves(self) -> bool:
        """Whether there is a boundary term."""
        return not self.image and psdr.plan(self.scene, self.params, integrator=self.integrator).boundary is not None

    def _blocks(self) -> list[np.ndarray]:
        return [self.params[n].grad.numpy().reshape(-1).astype(np.float64) for n in self.params.requested]


def kept(file: Path | None, key: dict[str, str | int], measure: Callable[[], dict]) -> dict:
    """Return what is measured, or what an earlier run with the same file and key has measured."""
    if file is None:
        return measure()
    records = Records(file)
    for row in records.rows:
        if key.items() <= row.items():
            return row["found"]
    records.append(key | {"found": measure()})
    return records.rows[-1]["found"]


def scatter(runs: list[list[np.ndarray]]) -> float:
    """Return the relative error of runs from how they differ: root mean square over the blocks."""
    squared = []
    for block in zip(*runs, strict=True):
        x = np.array(block)
        variance = x.var(axis=0, ddof=1).sum()
        mean = x.mean(axis=0)
        squared.append(variance / (mean @ mean - variance / len(x)))
    return float(np.sqrt(np.mean(squared)))
