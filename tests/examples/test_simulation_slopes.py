"""Slopes of the examples that simulate: of a fixed weighting of their pictures, against differences of equal seeds."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from scipy import ndimage

import warp_psdr as psdr
from tests.gradients import measure

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch):
    """Import an example by its name."""
    monkeypatch.syspath_prepend(str(EXAMPLES))

    def load(name: str):
        monkeypatch.delitem(sys.modules, name, raising=False)
        return importlib.import_module(name)

    return load


def loss_weights(pictures, targets):
    """Return the derivatives of ``losses.l2`` by the pixels; what is compared has no noise of its own then."""
    return [2.0 * (image - target) / image.size for image, target in zip(pictures, targets, strict=True)]


def compare(pictures, sought, base, weights, *, seeds, spp, step):
    """Return slopes by each number, and their standard errors.

    Args:
        pictures: (seed, samples a pixel) -> images, on the tape that is active.
        sought: arrays of the numbers.
        base: where, all numbers in their order.
        weights: of the images' pixels.
        seeds: how many independent batches.
        spp: samples a pixel.
        step: of the differences.
    """

    def at(values):
        parts = np.split(values, np.cumsum([array.numpy().size for array in sought])[:-1])
        for array, part in zip(sought, parts, strict=True):
            array.assign(part.reshape(array.numpy().shape).astype(np.float32))

    def value(values, seed):
        at(values)
        images = pictures(seed, spp)
        return sum(float((i.numpy().astype(float) * w).sum()) for i, w in zip(images, weights, strict=True))

    slopes, differences = [], []
    with measure.shared_random_numbers():
        for seed in range(seeds):
            at(base)
            tape = wp.Tape()
            with tape:
                images = pictures(100 * seed, spp)
            adjoints = [wp.array(w.astype(np.float32), dtype=wp.vec3, device="cpu") for w in weights]
            tape.backward(grads=dict(zip(images, adjoints, strict=True)))
            slopes.append(np.concatenate([array.grad.numpy().ravel() for array in sought]).astype(float))
            tape.zero()
            ends = [[value(base + side * step * e, 100 * seed) for side in (1.0, -1.0)] for e in np.eye(len(base))]
            differences.append(np.diff(ends, axis=1)[:, 0] / (-2.0 * step))
    slopes, differences = np.array(slopes), np.array(differences)
    mean = differences.mean(axis=0)
    return slopes.mean(axis=0) / mean, (slopes - differences).std(axis=0, ddof=1) / np.sqrt(seeds) / np.abs(mean)


def assert_slopes(slopes, errors):
    """Fail unless slopes are one, within what the project promises or three standard errors of a small noise."""
    assert errors.max() <= measure.SLOPE_TOLERANCE, f"too noisy to tell: {errors}"
    assert (np.abs(slopes - 1.0) <= np.maximum(measure.SLOPE_TOLERANCE, 3.0 * errors)).all(), f"{slopes} +- {errors}"


@pytest.mark.slow
def test_slopes_through_the_glass(example):
    """By stiffness, damping and angle, through glass and water; two frames in which no two parts cancel."""
    module, shown = example("pour_and_look"), [5, 8]
    swing = module.Swing(module.load(24, fov=8.0), 12)
    module.INTEGRATOR = psdr.PathIntegrator(
        max_depth=9, rr_depth=measure.NO_ROULETTE, boundary=psdr.boundary.PathSpace(spp_mirrors=128)
    )
    truth, films = np.log(module.TRUTH), []
    base = truth + np.array([0.07, -0.2, 0.1])
    for numbers in (base, truth):
        swing.logarithms.assign(numbers.astype(np.float32))
        films.append([image.numpy() for image in swing.film(module.FILM_SEED, 1024, shown)])

    def pictures(seed, spp):
        return swing.film(seed, spp, shown)

    weights = loss_weights(*films)
    assert_slopes(*compare(pictures, [swing.logarithms], base, weights, seeds=8, spp=1024, step=0.02))


@pytest.mark.slow
def test_slopes_of_the_arm_and_its_camera(example):
    """By four joint angles and the camera's six numbers."""
    pytest.importorskip("newton")
    module = example("robot_pose")
    module.INTEGRATOR = psdr.PathIntegrator(max_depth=2, rr_depth=measure.NO_ROULETTE)
    robot = module.Robot(32)
    camera = np.concatenate([np.radians(module.TURN), module.SHIFT])
    base = np.concatenate([np.radians(module.TRUTH + 0.4 * module.OFF), 0.4 * camera])

    def at(numbers):
        robot.joints.assign(numbers[:4].astype(np.float32))
        robot.motion.assign(numbers[4:].reshape(2, 3).astype(np.float32))

    def blurred(direction, step=0.04):
        ends = []
        for side in (1.0, -1.0):
            at(base + side * step * direction)
            ends.append(robot.picture(module.PHOTO_SEED, 1024).numpy().astype(float))
        return ndimage.gaussian_filter((ends[0] - ends[1]) / (2.0 * step), (1.5, 1.5, 0.0)).ravel()

    # Smooth weights, under which every number has an equal share of its own change: no two parts cancel.
    changes = np.array([blurred(direction) for direction in np.eye(len(base))])
    changes /= np.linalg.norm(changes, axis=1)[:, None]
    mixed = changes.T @ np.linalg.solve(changes @ changes.T, np.ones(len(base)))
    weights = [mixed.reshape(32, 32, 3)]

    def pictures(seed, spp):
        return [robot.picture(seed, spp)]

    assert_slopes(*compare(pictures, robot.sought, base, weights, seeds=10, spp=2048, step=0.02))


@pytest.mark.slow
def test_slopes_of_the_throw(example):
    """By the three numbers of the velocity; two frames of the shadow."""
    module, shown = example("throw_from_shadow"), [6, 15]
    flight = module.Flight(module.load(24), 24)

    def pictures(seed, spp):
        return flight.film(seed, spp, shown)

    base = module.START.astype(float) + np.array([0.2, -0.1, 0.2])
    films = []
    for numbers in (base, module.START):
        flight.velocity.assign(np.float32(numbers)[None])
        films.append([image.numpy() for image in pictures(module.FILM_SEED, 256)])
    weights = loss_weights(*films)
    assert_slopes(*compare(pictures, [flight.velocity], base, weights, seeds=12, spp=2048, step=0.04))
