"""Scenes and parameters whose gradients' accuracy is predicted and spent, for two benchmarks."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import boundary_global
import boundary_soft_shadow
import numpy as np
from common import psdr

from scenes import BLUE, CASES, CORNELL, DELTA, SKY, Case, stage, write_data

#: How far what moves lies from where it is sought, over the scene's radius, and samples a pixel of the two images.
SHIFT, RESIDUAL_SPP = 0.05, 256
KDTREE = psdr.boundary.PathSpace(guiding=psdr.guiding.KdTree())

CUBE = f"""<shape type="cube" id="object"><transform name="to_world"><scale value="0.4"/><rotate x="1" z="1"
angle="30"/>
    </transform>{BLUE}</shape>"""


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
)


class Loaded:
    """A pair's scene, and the arguments of its accuracy and its gradient.

    Args:
        pair: what is loaded.
        folder: where its files are written.
        resolution: pixels of a side.
        adjoint: "waves": smooth and of both signs, in the place of a loss's; "loss", where something moves: of the mean
            squared difference to an image of the scene with that moved by ``SHIFT``, as a fit starts with.
    """

    def __init__(self, pair: Pair, folder: Path, resolution: int, adjoint: str = "waves"):
        write_data(folder)
        self.scene = psdr.load_file(pair.file(folder), resolution=resolution)
        self.params = psdr.traverse(self.scene)
        self.integrator = psdr.PathIntegrator(max_depth=pair.depth, boundary=pair.boundary)
        self.image = not pair.parameters
        if self.image:
            return
        self.params.requires_grad(*pair.parameters)
        film = self.scene.description.sensors[0].film
        if adjoint == "loss" and self.moves:
            self.adjoint = self._residual(pair.parameters[0])
            return
        y, x = np.mgrid[0 : film.crop_height, 0 : film.crop_width] / film.crop_height
        waves = [0.5 + np.sin(3.0 * x + 5.0 * y + k) for k in range(3)]
        self.adjoint = np.stack(waves, axis=-1).astype(np.float32) / (film.crop_height * film.crop_width)

    def _residual(self, name: str) -> np.ndarray:
        base = self.params[name].numpy().copy()
        images = []
        for shift in (0.0, SHIFT * self.scene.radius):
            moved = base.copy()
            if moved.shape == (4, 4):
                moved[0, 3] += shift
            else:
                moved[:, 0] += shift
            self.params[name] = moved
            self.params.update()
            image = psdr.render(self.scene, integrator=self.integrator, spp=RESIDUAL_SPP, seed=7)
            images.append(image.numpy())
        self.params[name] = base
        self.params.update()
        return (2.0 / images[0].size) * (images[0] - images[1])

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

    @property
    def moves(self) -> bool:
        """Whether there is a boundary term."""
        return not self.image and psdr.plan(self.scene, self.params, integrator=self.integrator).boundary is not None

    def _blocks(self) -> list[np.ndarray]:
        return [self.params[n].grad.numpy().reshape(-1).astype(np.float64) for n in self.params.requested]


def scatter(runs: list[list[np.ndarray]]) -> float:
    """Return the relative error of runs from how they differ: root mean square over the blocks."""
    squared = []
    for block in zip(*runs, strict=True):
        x = np.array(block)
        variance = x.var(axis=0, ddof=1).sum()
        mean = x.mean(axis=0)
        squared.append(variance / (mean @ mean - variance / len(x)))
    return float(np.sqrt(np.mean(squared)))
