"""Derivatives in public scene files, each by another author, against central finite differences.

    python examples/benchmarks/public_scenes.py --scenes FOLDER [--only NAME] [--quick] [--output results.jsonl]

FOLDER holds clones of the repositories of ``CASES``, OWNER+NAME each. Of a file all stays but its film, which becomes
small and gets a box filter, and its depth. Slopes are those of derivatives on differences, both weighted by a
difference with other random numbers. Batches are added until the standard error is ``ENOUGH`` or a row's time is over.
"""

import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from common import Report, arguments, psdr

from warp_psdr.estimate.passes import STREAM_INTERIOR
from warp_psdr.scene.files.xml import describe_string

#: Standard error of a slope at which no batch is added.
ENOUGH = 0.005
#: Least and most batches, and their first seeds.
FEWEST, MOST = 24, 400
SEED, WEIGHT_SEED = 300, 900
NO_ROULETTE = 1 << 20
AXES = "xyz"
#: What a row finds: of the difference of twice the step, its ratio to that of the step.
FOUND = ("slope", "standard error", "difference of twice the step", "batches")


@dataclass(frozen=True)
class Row:
    """A parameter and how it changes.

    Attributes:
        name: of the parameter.
        how: "scale": all values in proportion; "add": by one number; "ramp": texels in proportion, none on the left and
            all on the right; "x", "y", "z": along an axis of the world, in units of the scene.
        step: of the differences, half of it as well.
    """

    name: str
    how: str
    step: float = 0.02

    @property
    def moves(self) -> bool:
        """Whether it moves something."""
        return self.how in AXES

    def tangent(self, values: np.ndarray) -> np.ndarray:
        """Return the direction, in the shape of the values."""
        if self.how == "scale":
            return values.copy()
        if self.how == "add":
            return np.ones_like(values)
        tangent = np.zeros_like(values)
        if self.how == "ramp":
            width = values.shape[1]
            return values * np.linspace(0.0, 1.0, width).reshape((1, width) + (1,) * (values.ndim - 2))
        axis = AXES.index(self.how)
        if values.shape == (4, 4):
            tangent[axis, 3] = 1.0
        else:
            tangent[..., axis] = 1.0
        return tangent


@dataclass(frozen=True)
class Case:
    """A scene file, the depth of its paths, and parameters.

    Attributes:
        file: below the folder of scenes; the first part is the repository.
        rows: parameters.
        depth: most path vertices.
        hidden: the camera does not see the lights.
        more: elements added to the scene.
        view: where the camera stands, what it looks at, and what is up, in place of the file's.
    """

    file: str
    rows: tuple[Row, ...]
    depth: int = 3
    hidden: bool = False
    more: str = ""
    view: tuple[tuple[float, float, float], ...] = ()


CASES = {
    "material preview, plastic": Case(
        "mitsuba-renderer+mitsuba-data/scenes/matpreview/matpreview.xml",
        (
            Row("bsdf-matpreview.diffuse_reflectance.value", "scale"),
            Row("bsdf-matpreview.eta", "add", 0.2),
            Row("texture-checkerboard.color0.value", "scale"),
            Row("emitter-envmap.data", "ramp"),
            Row("shape-matpreview-exterior.vertex_positions", "z", 0.005),
        ),
    ),
    "material preview, rough glass": Case(
        "4016-daiki-nakajima+volume_renderer/scenes/matpreview/matpreview.xml",
        (
            Row("shape_0.bsdf.specular_transmittance.value", "scale"),
            Row("__planetex.color1.value", "scale"),
            Row("Area_002-light.scale", "scale"),
        ),
        depth=5,
    ),
    "Cornell box of measured colours": Case(
        "AyoubKhammassi+diff-rend-opt/scenes/cbox/cbox-rgb.xml",
        (
            Row("box.reflectance.value", "scale"),
            Row("shape_0.emitter.radiance.value", "scale"),
            Row("shape_6.vertex_positions", "x", 4.0),
        ),
    ),
    "street with cars": Case(
        "NVlabs+sionna-rt/src/sionna/rt/scenes/simple_street_canyon_with_cars/simple_street_canyon_with_cars.xml",
        (
            Row("mat-itu_brick.brdf_0.reflectance.value", "scale"),
            Row("mesh-building_5.vertex_positions", "x", 0.25),
            Row("mesh-building_5.vertex_positions", "y", 1.0),
        ),
        more='<emitter type="constant"/>',
        # The file's camera looks through the ground at the buildings' bottoms, which lie in it.
        view=((60.0, -170.0, 130.0), (0.0, 0.0, 5.0), (0.0, 0.0, 1.0)),
    ),
    "shadow art, tube about a spline": Case(
        "alv02+StatMitsuba/scenes/shadow_art.xml",
        (
            Row("wall1.bsdf.reflectance.value", "scale"),
            Row("light1.emitter.radiance.value", "scale"),
            Row("curve.to_world", "x", 0.01),
            Row("light1.to_world", "x", 0.02),
        ),
        depth=2,
    ),
    "Blender's cube": Case(
        "mitsuba-renderer+mitsuba-blender/tests/res/scenes/test1.xml",
        (
            Row("mat-Material.brdf_0.base_color.value", "scale"),
            Row("mat-Material.brdf_0.roughness.value", "add", 0.01),
            Row("mat-Material.brdf_0.specular", "add"),
            Row("emitter_0.position", "x", 0.05),
            Row("shape_0.vertex_positions", "y", 0.02),
        ),
        depth=2,
    ),
    "painting in a Cornell box": Case(
        "niklassanden+ReSTIR_GI_DR/scenes/cornell_box_picture/scene_picture.xml",
        (
            Row("PaintingBSDF.brdf_0.reflectance.data", "ramp"),
            Row("LeftWallBSDF.brdf_0.reflectance.value", "scale"),
            Row("Light.emitter.radiance.value", "scale"),
            Row("ShortBox.to_world", "y", 0.01),
            Row("Painting.vertex_positions", "x", 0.01),
        ),
    ),
    "media in a Cornell box": Case(
        "sarahkfriday+Mitsuba3ToF/scenes/cornell-box_volumetric/scene_v3.xml",
        (
            Row("ShortBox.interior_medium.sigma_t.value.value", "scale", 0.1),
            Row("TallBox.interior_medium.albedo.value.value", "scale"),
            Row("TallBox.interior_medium.phase_function.g", "add", 0.05),
            Row("ShortBox.to_world", "x", 0.01),
        ),
        depth=4,
    ),
    "Cornell box": Case(
        "yuubib+test/cornell-box/scene.xml",
        (
            Row("RightWallBSDF.brdf_0.reflectance.value", "scale"),
            Row("Light.emitter.radiance.value", "scale"),
            Row("TallBox.to_world", "x", 0.01),
            Row("Light.to_world", "z", 0.02),
        ),
        depth=4,
    ),
    "mirror and glass in a Cornell box": Case(
        "mitsuba-renderer+mitsuba-tutorials/scenes/cbox.xml",
        (
            Row("white.reflectance.value", "scale"),
            Row("mirror.specular_reflectance.value", "scale"),
            Row("glass.eta", "add", 0.01),
            Row("mirrorsphere.to_world", "x", 0.005),
        ),
        depth=5,
    ),
    "teapot": Case(
        "camilletaglione+mitsuba-tutorials/scenes/simple.xml",
        (
            Row("teapot.bsdf.reflectance.value", "scale"),
            Row("light1.intensity.value", "scale"),
            Row("light1.position", "x", 0.1),
            Row("teapot.vertex_positions", "x", 0.02),
        ),
        depth=2,
    ),
    "living room": Case(
        "YanniZhangYZ+Mitsuba_LPE/testing_scene/living-room/scene.xml",
        (
            Row("FloorBSDF.brdf_0.diffuse_reflectance.data", "ramp", 0.4),
            Row("PanelingBSDF.brdf_0.alpha", "add", 0.1),
            Row("BrushedStainlessSteelBSDF.brdf_0.specular_reflectance.value", "scale"),
            Row("emitter_0.data", "ramp"),
        ),
        depth=4,
    ),
    "instances": Case(
        "mitsuba-renderer+mitsuba-data/tests/scenes/instancing/test_instancing_path.xml",
        (
            Row("my_shape_group._arg_0.bsdf.reflectance.value", "scale"),
            # Not by the light's place: it stands in the camera, where the derivative has two sides.
            Row("shape_1.to_world", "x", 0.02),
            Row("my_shape_group._arg_1.vertex_positions", "y", 0.01),
        ),
    ),
}


def load(folder: Path, case: Case, size: int) -> psdr.Scene:
    """Load a file with a film of ``size`` pixels across under a box filter."""
    path = folder / case.file
    text = path.read_text(encoding="utf-8").replace("</scene>", case.more + "</scene>")
    description = describe_string(text, base=path.parent, allow_outside=folder)
    for sensor in description.sensors:
        if case.view:
            sensor.to_world = psdr.Transform.look_at(*case.view).matrix.astype(np.float32)
        height = max(1, round(size * sensor.film.height / sensor.film.width))
        whole = {"crop_offset_x": 0, "crop_offset_y": 0, "crop_width": size, "crop_height": height}
        sensor.film = replace(
            sensor.film, width=size, height=height, **whole, filter="box", filter_radius=0.5, sample_border=False
        )
    return psdr.Scene(description, "cpu")


class Comparison:
    """Weighted sums of a derivative and of two differences, one of each a batch."""

    def __init__(self, scene: psdr.Scene, row: Row, names: list[str], integrator: psdr.PathIntegrator, spp: int):
        self._scene, self._row, self._names, self._integrator, self._spp = scene, row, names, integrator, spp
        self._params = psdr.traverse(scene)
        self._base = self._params[row.name].numpy().astype(np.float64).copy()
        self._tangent = row.tangent(self._base)

    def _difference(self, step: float, seed: int, spp: int) -> np.ndarray:
        images = []
        for sign in (1.0, -1.0):
            self._set(self._base + sign * step * self._tangent)
            image = psdr.render(self._scene, integrator=self._integrator, spp=spp, seed=seed)
            images.append(image.numpy().astype(np.float64))
        self._set(self._base)
        return (images[0] - images[1]) / (2.0 * step)

    def _set(self, values: np.ndarray) -> None:
        self._params[self._row.name] = values.astype(np.float32)
        self._params.update()

    def _derivative(self, weights: np.ndarray, seed: int) -> float:
        self._params.requires_grad_only(*self._names)
        self._params.zero_grad()
        psdr.render_backward(self._scene, self._params, weights, integrator=self._integrator, spp=self._spp, seed=seed)
        return float((self._params[self._row.name].grad.numpy().astype(np.float64) * self._tangent).sum())

    def run(self, limit: float) -> dict:
        """Return the row's numbers; limit: processor seconds."""
        row, start = self._row, time.process_time()
        spp = self._spp * (4 if row.moves else 1)
        weights = self._difference(row.step, WEIGHT_SEED, 4 * spp)
        scale = np.abs(weights).max()
        if not scale > 0.0:
            raise ValueError(f"{row.name} does not change the image")
        weights /= scale
        sums, coarse = [], []
        while len(sums) < FEWEST or (
            len(sums) < MOST and _error(sums) > ENOUGH and time.process_time() - start < limit
        ):
            seed = SEED + len(sums)
            fine = float((weights * self._difference(0.5 * row.step, seed, spp)).sum())
            if len(sums) < FEWEST:
                coarse.append(float((weights * self._difference(row.step, seed, spp)).sum()))
            sums.append((self._derivative(weights.astype(np.float32), seed), fine))
        derivative, fine = np.mean(sums, axis=0)
        twice = float(np.sum(coarse) / np.sum([fine for _, fine in sums[:FEWEST]]))
        return dict(zip(FOUND, (float(derivative / fine), _error(sums), twice, len(sums)), strict=True))


def _error(sums: list[tuple[float, float]]) -> float:
    """Return the standard error of the ratio of the means."""
    derivative, fine = np.array(sums).T
    residual = derivative - fine * (derivative.mean() / fine.mean())
    return float(residual.std(ddof=1) / np.sqrt(len(sums)) / abs(fine.mean()))


def main() -> None:
    """Run and print the table."""
    parser = arguments(__doc__)
    parser.add_argument("--scenes", type=Path, required=True, help="folder with clones of the repositories")
    parser.add_argument("--only", nargs="*", help="names of cases; default: all")
    parser.add_argument("--limit", type=float, default=30.0, help="processor seconds of a row")
    options = parser.parse_args()
    size, spp = (16, 16) if options.quick else (24, 32)
    psdr.set_workers(options.threads)
    sys.modules["warp_psdr.estimate.calls"].STREAM_PRIMAL = STREAM_INTERIOR  # what images and derivatives share cancels
    report = Report("public_scenes.py", options.output)
    title = f"Derivatives in public scene files, {size} pixels across"
    sources, refused = [], []
    for label, case in CASES.items():
        if options.only and label not in options.only:
            continue
        scene = load(options.scenes.resolve(), case, size)
        methods = {"interior": psdr.interior.Replay(), "boundary": psdr.boundary.PathSpace()}
        paths = {"max_depth": case.depth, "rr_depth": NO_ROULETTE, "hide_emitters": case.hidden}
        integrator = psdr.PathIntegrator(**paths, **methods)
        repository, _, file = case.file.partition("/")
        sources.append({"scene": label, "repository": repository.replace("+", "/"), "file": file})
        rows = []
        for row in case.rows:
            names = [r.name for r in case.rows if r.moves == row.moves]
            about = {"scene": label, "parameter": row.name, "change": row.how}
            try:
                rows.append(about | Comparison(scene, row, names, integrator, spp).run(options.limit))
            except ValueError as refusal:
                refused.append(about | {"reason": str(refusal)})
        report.table(title, rows)
    report.table("Derivatives in public scene files that are refused", refused)
    report.table("Public scene files", sources)


if __name__ == "__main__":
    main()
