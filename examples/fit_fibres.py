"""Fits 200 fibres to eight photographs: where they are, how they bend and how thick they are.

    python examples/fit_fibres.py            # minutes on two cores
    python examples/fit_fibres.py --quick    # smaller and rougher

The fibres are cubic B-splines with a radius (``bsplinecurve``) before a wall, on which a lamp throws their shadows. At
the start each of them is shifted, tilted and bent, by its width in the mean, and all are equally thick. Three things
make the fit converge:

* Outlines say where a fibre should go only as far as it overlaps what is sought. Images are compared after a blur
  (``scipy.ndimage.gaussian_filter``) that widens the overlap to half a fibre; a wider one would merge neighbours, and
  the first gradient would point towards the truth for fewer of them.
* Unknown are not control points, of which the outer ones count little, but modes of each fibre: shift, tilt, bend ...
  The kernel ``move_fibres`` turns them into control points, on the tape of the rendering. Finer modes take smaller
  steps, and radii have steps of their own.
* Where fibres would run through each other, they are pushed apart after a step; a scene in which many do is refused.

Leaves in ``out/fibres/``: ``result.png`` (photographs, start, recovered), ``gradient.png`` (the first gradient of the
loss, on the fibres, beside what is sought), ``loss.png``, ``error.png`` and ``report.json``.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path

import fibre_pictures
import numpy as np
import recovery
import warp as wp
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree
from warp.optim import Adam

import warp_psdr as psdr
from warp_psdr import plots

ROOT = Path(__file__).resolve().parents[1]
NAME = "fibres.control_points"
FIBRES, POINTS = 200, 6
#: Mean width of a fibre and the length of its control polygon, world units; mean shift at the start, in widths.
WIDTH, LENGTH, SHIFT = 0.036, 0.32, 1.0
#: Photographs that are given, and that judge; samples of each, and their seed, which no step uses.
GIVEN, KEPT, PHOTO_SPP, PHOTO_SEED = 8, 2, 32, 2**32 - 1000
#: Direct light. Boundary terms take as many samples as the interior term, the image itself more.
INTEGRATOR, IMAGE_SPP, GRADIENT_SPP = psdr.PathIntegrator(max_depth=2), 4, 4
#: Learning rates at the start: of places, in world units, and of the logarithm of radii; decay of Adam's means.
MOVE_RATE, SWELL_RATE, BETAS = 0.003, 0.03, (0.9, 0.97)
#: Size of the modes of a fibre: shift, tilt, bend, and finer ones, which noise would wiggle; Adam's steps are as large.
SIZES = (1.0, 0.6, 0.4, 0.1, 0.05, 0.02)
#: Distance of two axes, over the sum of their radii, that is kept; places along a fibre at which it is looked at.
GAP, PLACES = 1.1, 25
SEPARATED = 60


@dataclass(frozen=True)
class Stage:
    """Steps at one resolution (pixels along a side), with a blur (standard deviation, pixels); factor on all rates."""

    steps: int
    resolution: int
    blur: float
    rate: float


STAGES = (Stage(30, 144, 1.0, 1.0), Stage(15, 144, 0.7, 0.4), Stage(15, 144, 0.5, 0.15))
QUICK = (Stage(16, 72, 0.5, 1.0), Stage(8, 72, 0.5, 0.4))


@wp.kernel
def move_fibres(
    # In:
    start: wp.array(dtype=wp.vec4),
    modes: wp.array2d(dtype=wp.float32),
    shifts: wp.array(dtype=wp.vec3),
    swells: wp.array(dtype=wp.float32),
    # Out:
    points_out: wp.array(dtype=wp.float32),
):
    """Add modes to where the control points of a fibre start; those of radii multiply them."""
    f, k = wp.tid()
    i = f * modes.shape[0] + k
    shift = wp.vec3()
    swell = wp.float32(0.0)
    for m in range(wp.static(POINTS)):
        shift += modes[k, m] * shifts[f * modes.shape[1] + m]
        swell += modes[k, m] * swells[f * modes.shape[1] + m]
    for axis in range(3):
        points_out[4 * i + axis] = start[i][axis] + shift[axis]
    points_out[4 * i + 3] = start[i][3] * wp.exp(swell)


def modes() -> np.ndarray:
    """Return polynomials of the degrees 0 to POINTS - 1 at the control points, columns, orthogonal and scaled."""
    s = np.linspace(-1.0, 1.0, POINTS)
    q = np.linalg.qr(np.vander(s, POINTS, increasing=True))[0]
    return q / q[-1] * SIZES


def weights() -> np.ndarray:
    """Return the weights (PLACES, POINTS) of the control points at places along a cubic B-spline."""
    x = np.linspace(0.0, POINTS - 3.0, PLACES)
    first = np.minimum(x.astype(int), POINTS - 4)
    v = x - first
    found = np.zeros((PLACES, POINTS))
    for k, w in enumerate([(1 - v) ** 3, 3 * v**3 - 6 * v**2 + 4, -3 * v**3 + 3 * v**2 + 3 * v + 1, v**3]):
        found[np.arange(PLACES), first + k] = w / 6.0
    return found


def sought() -> np.ndarray:
    """Return the truth, (FIBRES, POINTS, 4), x y z radius: a whorl, like hair around its crown, on a shallow dome."""
    i = np.arange(FIBRES) + 0.5
    radius, angle = np.sqrt(i / FIBRES), i * np.pi * (3.0 - np.sqrt(5.0))  # as seeds of a sunflower
    out = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    around = np.stack([-np.sin(angle), np.cos(angle), 0.0 * angle], axis=1)
    at = radius[:, None] * out + (0.3 * (1.0 - radius**2) - 0.15)[:, None] * [0.0, 0.0, 1.0]
    points = np.zeros((FIBRES, POINTS, 4))
    for k in range(POINTS):
        points[:, k, :3] = at
        turn = 1.1 * k / (POINTS - 1)
        way = np.cos(turn) * (0.75 * out + [0.0, 0.0, 0.35]) + np.sin(turn) * around
        at = at + LENGTH / (POINTS - 1) * way / np.linalg.norm(way, axis=1, keepdims=True)
    thick = 0.5 * WIDTH * (1.0 + 0.25 * np.sin(3.0 * angle))
    points[..., 3] = thick[:, None] * np.linspace(1.1, 0.75, POINTS)
    return points


def disturbed(points: np.ndarray) -> np.ndarray:
    """Return the start: each fibre shifted, tilted and bent at random, and all of one thickness."""
    random = np.random.default_rng(1)
    move = np.einsum("km,fmc->fkc", modes()[:, :3], random.normal(size=(len(points), 3, 3)))
    moved = points.copy()
    moved[..., :3] += SHIFT * WIDTH * move / np.linalg.norm(move, axis=2).mean()
    moved[..., 3] = 0.5 * WIDTH
    return apart(moved)


def apart(points: np.ndarray) -> np.ndarray:
    """Push fibres apart where they are closer than ``GAP`` allows, by the least change of their control points."""
    points, at = points.copy(), weights()
    for _round in range(SEPARATED):
        axes = np.einsum("mk,fkc->fmc", at, points).reshape(-1, 4)
        pairs = cKDTree(axes[:, :3]).query_pairs(2.0 * GAP * axes[:, 3].max(), output_type="ndarray")
        pairs = pairs[pairs[:, 0] // PLACES != pairs[:, 1] // PLACES]
        way = axes[pairs[:, 0], :3] - axes[pairs[:, 1], :3]
        distance = np.linalg.norm(way, axis=1)
        depth = GAP * axes[pairs, 3].sum(axis=1) - distance
        order = np.argsort(-depth)
        order = order[depth[order] > 0.0]
        if not len(order):
            break
        # Of two fibres, the places that are deepest in each other.
        order = order[np.unique(pairs[order] // PLACES, axis=0, return_index=True)[1]]
        fibres, rows = pairs[order] // PLACES, at[pairs[order] % PLACES]  # (N, 2), (N, 2, POINTS)
        push = (depth / np.maximum(distance, 1e-9))[order, None] * way[order]
        push /= (rows**2).sum(axis=(1, 2))[:, None]
        share = np.bincount(fibres.reshape(-1), minlength=len(points))[fibres].max(axis=1)[:, None, None]
        for side, sign in enumerate((1.0, -1.0)):
            np.add.at(points[..., :3], fibres[:, side], sign * rows[:, side, :, None] * push[:, None] / share)
    return points


def origin_of(view: int) -> list[float]:
    """Return where a camera stands: one in front, the others around it, nearer and farther in turn."""
    if view == 0:
        return [0.0, 0.0, 3.5]
    turn = 2.0 * np.pi * (view if view < GIVEN else view + 0.5) / (GIVEN - 1)
    away = (2.6, 1.6)[view % 2] if view < GIVEN else 2.0
    return [away * np.cos(turn), away * np.sin(turn), 2.5]


def build(points: np.ndarray, resolution: int) -> psdr.Scene:
    """Return fibres before a wall, below a lamp and a dim sky, and the cameras."""

    def paint(*albedo: float) -> dict:
        return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(albedo)}}

    t = psdr.Transform
    scene: dict = {
        "type": "scene",
        "fibres": {
            "type": "bsplinecurve",
            "control_points": points.reshape(-1, 4),
            "curve_starts": np.arange(len(points)) * POINTS,
            "bsdf": paint(0.85, 0.45, 0.12),
        },
        "wall": {
            "type": "rectangle",
            "to_world": t.translate([0.0, 0.0, -0.5]) @ t.scale(6.0),
            "bsdf": paint(0.5, 0.6, 0.7),
        },
        "lamp": {
            "type": "rectangle",
            "to_world": t.look_at([1.5, 2.6, 2.7], [0, 0, -0.5], [0, 1, 0]) @ t.scale(0.2),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [190.0, 190.0, 190.0]}},
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.3, 0.3, 0.3]}},
    }
    scene |= recovery.cameras([origin_of(i) for i in range(GIVEN + KEPT)], 40.0, resolution)
    return psdr.load_dict(scene)


def photographs(scene: psdr.Scene, seed: int) -> list[np.ndarray]:
    return recovery.photographs(scene, GIVEN + KEPT, INTEGRATOR, PHOTO_SPP, seed)


def errors(points: np.ndarray, truth: np.ndarray) -> tuple[float, float, float]:
    """Return mean distances of control points and of places on the axes, in widths; relative error of radii."""
    axes = np.einsum("mk,fkc->fmc", weights(), points - truth)
    distances = [float(np.linalg.norm(d[..., :3], axis=2).mean()) / WIDTH for d in (points - truth, axes)]
    return (*distances, float(np.abs(points[..., 3] / truth[..., 3] - 1.0).mean()))


class Fit:
    """Fibres on their way: what is unknown, its optimisers, and the scene that shows them."""

    def __init__(self, start: np.ndarray):
        self.start, self.modes = start, modes()
        self.shifts = wp.zeros(FIBRES * POINTS, dtype=wp.vec3, device="cpu", requires_grad=True)
        self.swells = wp.zeros(FIBRES * POINTS, dtype=wp.float32, device="cpu", requires_grad=True)
        fixed = (start.reshape(-1, 4), wp.vec4), (self.modes, wp.float32)
        self._inputs = [wp.array(values.astype(np.float32), dtype=dtype, device="cpu") for values, dtype in fixed]
        self._inputs += [self.shifts, self.swells]
        unknown = (self.shifts, MOVE_RATE), (self.swells, SWELL_RATE)
        self._optimisers = [(Adam([array], lr=rate, betas=BETAS), array, rate) for array, rate in unknown]

    def show(self, resolution: int) -> psdr.Scene:
        """Make the scene at another resolution, and return it."""
        self.params = psdr.traverse(build(self.start, resolution))
        self.params.requires_grad(NAME)
        self.move()
        return self.params.scene

    def move(self) -> None:
        """Put the control points where the unknowns say; a tape records that."""
        wp.launch(move_fibres, (FIBRES, POINTS), self._inputs, [self.params[NAME]], device="cpu")
        self.params.update(NAME)

    @property
    def points(self) -> np.ndarray:
        """Control points (FIBRES, POINTS, 4), float64."""
        return self.params[NAME].numpy().reshape(FIBRES, POINTS, 4).astype(np.float64)

    def backward(self, photos: dict[int, np.ndarray], blur: float, spp: int, seed: int) -> float:
        """Add the gradient of the mean loss of some views, and return the loss."""
        tape = wp.Tape()
        with tape:
            self.move()
            options = {"integrator": INTEGRATOR, "spp": IMAGE_SPP, "spp_grad": spp, "tape": tape}
            images = {
                v: psdr.render(self.params.scene, self.params, sensor=v, seed=seed + v, **options) for v in photos
            }
        losses, adjoints = [], {}
        for view, image in images.items():
            loss, adjoint = compared(image.numpy(), photos[view], blur)
            adjoints[image] = wp.array(adjoint / len(photos), dtype=wp.vec3, device="cpu")
            losses.append(loss)
        tape.backward(grads=adjoints)
        return float(np.mean(losses))

    def step(self, scale: float) -> None:
        """Make a step, and push fibres apart that would run through each other."""
        for optimiser, array, rate in self._optimisers:
            optimiser.lr = scale * rate
            optimiser.step([array.grad])
            array.grad.zero_()
        self.params.zero_grad()
        self.move()
        before = self.points
        after = apart(before)
        if (after != before).any():
            shifts = np.einsum("mk,fkc->fmc", np.linalg.inv(self.modes), (after - self.start)[..., :3])
            self.shifts.assign(shifts.reshape(-1, 3).astype(np.float32))
            self.move()


def compared(image: np.ndarray, photo: np.ndarray, blur: float) -> tuple[float, np.ndarray]:
    """Return the mean squared difference of two images (H, W, 3) after a blur, and its derivative by the first one."""

    def blurred(values: np.ndarray) -> np.ndarray:
        return gaussian_filter(values, (blur, blur, 0.0), mode="constant")  # black around it: its own transpose

    difference = blurred(image - photo)
    return float(np.mean(difference**2)), blurred(2.0 / difference.size * difference).astype(np.float32)


def first_gradient(folder: Path, fit: Fit, photos: list[np.ndarray], truth: np.ndarray, blur: float) -> float:
    """Draw the gradient of the loss of all photographs, and return the share of fibres that it moves the right way."""
    scene, options = fit.params.scene, {"integrator": INTEGRATOR, "spp": GRADIENT_SPP, "seed": PHOTO_SEED}
    for view, photo in enumerate(photos):
        image = psdr.render(scene, sensor=view, **options).numpy()
        psdr.render_backward(scene, fit.params, compared(image, photo, blur)[1], sensor=view, **options)
    # Of places alone: all radii at once would hide the sides.
    gradient = -fit.params[NAME].grad.numpy().reshape(truth.shape) / len(photos)
    fit.params.zero_grad()
    way = truth - fit.points
    fields = {
        ("first gradient, negated: where the surface should move", "loss [squared radiance] per world unit"): gradient,
        ("truth minus start: where the surface has to move", "outwards [world units]"): way,
    }
    curves = next(shape.geometry for shape in scene.description.shapes if shape.geometry is not None)
    rows = {caption: (values * [1.0, 1.0, 1.0, 0.0]).reshape(-1, 4) for caption, values in fields.items()}
    try:
        fibre_pictures.draw_fields(folder / "gradient.png", curves, fit.points.reshape(-1, 4), rows, origin_of(0))
    except RuntimeError as problem:  # no OpenGL on this machine: everything else does without
        print(f"not drawn: {problem}")
    return float((np.einsum("fkc,fkc->f", gradient[..., :3], way[..., :3]) > 0.0).mean())


def main(
    folder: Path = ROOT / "out" / "fibres", *, stages: tuple[Stage, ...] = STAGES, views: int = 4, spp: int = 1
) -> dict:
    """Fit the fibres, write the pictures and return the report; ``views`` photographs count in a step."""
    began = time.perf_counter()
    folder.mkdir(parents=True, exist_ok=True)
    truth = sought()
    sizes = sorted({stage.resolution for stage in stages})
    photos = {size: photographs(build(truth, size), PHOTO_SEED) for size in sizes}
    fit = Fit(disturbed(truth))
    before = photographs(fit.show(sizes[-1]), PHOTO_SEED + 100)
    towards = first_gradient(folder, fit, photos[sizes[-1]][:GIVEN], truth, stages[0].blur)
    history = [errors(fit.points, truth)]
    losses: list[float] = []
    order = np.random.default_rng(0)
    for stage in stages:
        fit.show(stage.resolution)
        for i in range(stage.steps):
            chosen = {int(v): photos[stage.resolution][v] for v in order.permutation(GIVEN)[:views]}
            losses.append(fit.backward(chosen, stage.blur, spp, len(losses) * GIVEN))
            fit.step(stage.rate)
            history.append(errors(fit.points, truth))
            if i % 10 == 9 or i == stage.steps - 1:
                near, axes, thick = history[-1]
                print(
                    f"step {len(losses)}: loss {losses[-1]:.5f}, control points {near:.3f}, axes {axes:.3f} widths, "
                    f"radii {100.0 * thick:.1f} % off, {time.perf_counter() - began:.0f} s",
                    flush=True,
                )
    found = photographs(fit.params.scene, PHOTO_SEED + 200)
    curves = zip(("control points, in widths", "axes, in widths", "radii, relative"), np.array(history).T, strict=True)
    plots.loss_curve(folder / "error.png", dict(curves), title="mean errors of 200 fibres", ylabel="error")
    plots.loss_curve(folder / "loss.png", losses, title="loss, with the noise of the renderings", ylabel="mean square")
    report = {
        **recovery.view_report(folder, photos[sizes[-1]], before, found, GIVEN),
        "control points, mean distance in widths: start, found": [round(history[i][0], 3) for i in (0, -1)],
        "axes, mean distance in widths: start, found": [round(history[i][1], 3) for i in (0, -1)],
        "radii, mean error in percent: start, found": [round(100.0 * history[i][2], 1) for i in (0, -1)],
        "fibres that the first gradient moves towards what is sought, percent": round(100.0 * towards, 1),
        "steps": len(losses),
        "seconds": round(time.perf_counter() - began),
    }
    (folder / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    return report


if __name__ == "__main__":
    recovery.run(main, __doc__, {"stages": QUICK, "spp": 2})
