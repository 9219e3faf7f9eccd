"""``psdr.certify``: checks of gradients at the present values of a scene, within a budget of time."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_psdr.certify.adjoints import random_adjoints
from warp_psdr.certify.certificate import Certificate
from warp_psdr.certify.directions import Direction, directions_of
from warp_psdr.certify.issue import NAMES, Request, issue
from warp_psdr.certify.subject import SceneSubject, adjoints_of, untouched
from warp_psdr.estimate.arguments import flat_tangents, requested
from warp_psdr.options.integrator import Integrator
from warp_psdr.plan.integrator import integrator_of
from warp_psdr.plan.transient import require_steady
from warp_psdr.scene.layout import CAMERA, LIGHT_POSE, Parameter
from warp_psdr.scene.loaded import check_loaded
from warp_psdr.topology import contacts

if TYPE_CHECKING:
    from warp_psdr.scene.parameters import Parameters
    from warp_psdr.scene.scene import Scene

#: Distance of what moves where there are no shapes, world units; and the least one, over the radius of the scene.
NOWHERE, LEAST_REACH = 1.0, 1.0e-3


def certify(
    scene: Scene,
    params: Parameters,
    adjoint: Any = None,
    *,
    integrator: Integrator | None = None,
    sensor: int | str = 0,
    budget: float = 60.0,
    level: float = 0.99,
    tolerance: float = 0.02,
    checks: str | Sequence[str] = "all",
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> Certificate:
    """Examine the gradients of the requested parameters: are they right, at the scene's present values?

    Each is compared with differences of images along several directions, and with every other method that covers it.
    The scene, the requests, gradients and what guiding has built stay as they are.

    Args:
        scene: a loaded scene.
        params: its parameters, after ``requires_grad``.
        adjoint: derivative of a loss with respect to the image, (H, W, 3), whose gradient is examined. None: a smooth
            one that sees much of all derivatives and little noise, as a pilot tells.
        integrator: as of ``render``; default: what the scene file names. Methods that are left to the plan are those of
            a first gradient.
        sensor: which camera, by its number or its id.
        budget: seconds that samples may take, compiling left out. A pilot and eight batches of every comparison are
            taken whatever it is.
        level: probability with which no right gradient is called biased, and with which intervals hold.
        tolerance: a slope within 1 +- tolerance is right.
        checks: "all", or names: "slope", "identities", "estimators", "necessity",
            "price".
        seed: of all random numbers. How many batches there are depends on the clock.
        progress: called with the finished fraction.

    Returns:
        The certificate; ``print`` it, or ask it for ``.ok`` and ``["name"].slope``.

    Raises:
        ValueError: nothing is requested, an option out of range, a value of the scene that is not finite, or a
            derivative that is refused.
    """
    check_loaded(scene)
    names = requested(scene, params)
    request = Request.checked(budget, level, tolerance, checks, seed, NAMES)
    integrator = integrator_of(scene, integrator)
    if not isinstance(sensor, int | str):
        raise ValueError(f"sensor: got {sensor!r}, expected the number or the id of one; call it for each")
    number = scene.description.sensor_number(sensor)
    require_steady(scene, number, "psdr.certify")
    with untouched(scene) as ledger:
        subject = SceneSubject.of(scene, names, integrator, number)
        adjoints = (
            random_adjoints(subject.shape, seed)
            if adjoint is None
            else adjoints_of(scene, number, adjoint, subject.shape)
        )
        subject = subject.sized(adjoints, request.budget)
        return issue(
            subject,
            adjoints,
            lambda name, mean, deviation: _directions(subject, name, mean, deviation, request.seed),
            request,
            progress,
            adjoint is None,
            lambda: _dropped(ledger.snapshot()),
        )


def _directions(
    subject: SceneSubject, name: str, mean: np.ndarray, deviation: np.ndarray, seed: int
) -> tuple[list[Direction], list[str]]:
    """Return the directions of a parameter, and notes on those that are left out."""
    scene, values = subject.scene, subject.values[name]
    p, pixels = scene.parameters[name], max(subject.shape)
    return _smooth(subject, directions_of(p, values, mean, deviation, _reach(scene, p, values), pixels, seed))


def _reach(scene: Scene, p: Parameter, values: np.ndarray) -> float:
    """Return how far away is what a parameter moves, or moves against, world units.

    That is the scene's size for shapes, and the distance of most shapes for cameras and lights.
    """
    if not scene.vertex_count:
        return NOWHERE
    if not p.uses & {CAMERA, LIGHT_POSE}:
        return 2.0 * scene.radius
    centers = 0.5 * (scene.boxes.low + scene.boxes.high) + scene.origin
    place = values[:3, 3] if values.shape == (4, 4) else values if values.shape == (3,) else centers.mean(axis=0)
    return max(float(np.median(np.linalg.norm(centers - place, axis=1))), LEAST_REACH * scene.radius)


def _smooth(subject: SceneSubject, found: list[Direction]) -> tuple[list[Direction], list[str]]:
    """Return the directions along which the image has a derivative, one of each name, and notes on the others."""
    kept: dict[str, Direction] = {}
    left_out: dict[str, str] = {}
    for direction in found:
        if direction.what in kept:
            continue
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            tangents = {direction.parameter: direction.tangent}
            contacts.warn(subject.scene, flat_tangents(subject.scene, subject.params, tangents).numpy())
        if caught:
            left_out[direction.what] = f"{direction.parameter}, {direction.what}: {caught[0].message}"
        else:
            kept[direction.what] = direction
    return list(kept.values()), [text for what, text in left_out.items() if what not in kept]


def _dropped(counts: dict[str, tuple[int, int]]) -> list[str]:
    return [
        f"{dropped} of {samples} samples of {kind!r} were not finite, and were dropped: that is a bias"
        for kind, (samples, dropped) in counts.items()
        if dropped
    ]
