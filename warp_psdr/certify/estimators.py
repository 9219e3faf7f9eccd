"""Check 2: the derivative by every other method that covers the request, with the same adjoints and directions.

It takes no step, so it finds what differences hide: kinks, and biases of differences themselves. Methods that do not
cover the request are listed with their reason; they are no failures.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from warp_psdr.certify.examination import Examination, weighted
from warp_psdr.certify.spending import Row, Sampler
from warp_psdr.certify.subject import SceneSubject
from warp_psdr.options import boundary, interior
from warp_psdr.plan.choice import named
from warp_psdr.plan.plan import decide
from warp_psdr.scene.layout import CAMERA, POSITIONS, SHAPE_GRID, SHAPE_POSE

NAME = "estimators"
#: Unbiased methods that share least of their code with the default ones.
INTERIOR: tuple[interior.Method, ...] = (
    interior.Replay(),
    interior.LightTracing(),
    interior.Resampled(),
    interior.Antithetic(),
    interior.Attached(bsdf="attached", weights="attached"),
    interior.DifferentialRatioTracking(),
)
BOUNDARY: tuple[boundary.Method, ...] = (
    boundary.PathSpace(),
    boundary.EdgeSampling(),
    boundary.Projective(),
    boundary.WarpedArea(),
    boundary.SignedDistance(),
)

#: Time of a batch of another method over that of the one examined, at most, as far as there are samples to spare.
SLOWER = 2.0


def rows(e: Examination) -> list[Row]:
    """Return the rows: one a parameter and method."""
    subject = e.scene_subject
    if subject is None:
        return []
    plan = decide(subject.scene, integrator=subject.integrator, sensor=subject.sensor, names=list(subject.names))
    own = named(subject.integrator)
    found = []
    for method in INTERIOR:
        follows = isinstance(method, interior.LightTracing) and not _drawn_from_lights(subject)
        if type(method) is not type(own) and not follows:
            found += _against(e, subject, {"interior": method}, type(own).__name__, f"interior.{type(method).__name__}")
    for other in BOUNDARY if plan.discontinuities else ():
        if type(other) is not type(plan.boundary):
            label = "none" if plan.boundary is None else type(plan.boundary).__name__
            found += _against(e, subject, {"boundary": other}, label, f"boundary.{type(other).__name__}")
    return found


def _moves(subject: SceneSubject, name: str) -> bool:
    """Whether a parameter moves vertices or the camera, by which light tracing replays paths from the camera."""
    return bool(subject.scene.parameters[name].uses & {POSITIONS, SHAPE_POSE, SHAPE_GRID, CAMERA})


def _drawn_from_lights(subject: SceneSubject) -> bool:
    return not all(_moves(subject, name) for name in subject.names)


def _sampler(e: Examination, other: SceneSubject, label: str) -> Sampler:
    """Return the sampler of another method, whose batches take no more than a few times as long as the base's."""
    while True:
        sampler = Sampler(e.derivatives(other), e.stream(label, 0))
        sampler.try_out(1)
        image, gradient = other.spp
        if sampler.cost <= SLOWER * e.base.cost or gradient == 1:
            return sampler
        other = replace(other, spp=(image, gradient // 2))


def _against(e: Examination, subject: SceneSubject, methods: dict, own: str, label: str) -> list[Row]:
    """Return the rows of one other method; none where it does not cover the request."""
    try:
        other = subject.by(**methods)
        e.compile(e.derivatives(other))
    except ValueError as reason:
        e.refused.append((label, " ".join(str(reason).split()).partition(". ")[0]))
        return []
    sampler = _sampler(e, other, label)
    if not e.affords(sampler, label):
        return []
    sampler.try_out()
    found = []
    for number, direction in e.telling():
        if isinstance(methods.get("interior"), interior.LightTracing) and _moves(subject, direction.parameter):
            continue
        pilots = np.concatenate([np.stack(s.pilot)[:, :, number] for s in (e.base, sampler)])
        mean = pilots.mean(axis=0)
        size = float(np.linalg.norm(mean))
        weights = mean / size**2 if size > 0.0 else np.ones_like(mean)
        of_both = weighted(number, weights)
        found.append(
            Row(
                check=NAME,
                parameter=direction.parameter,
                what=f"{own} against {label.rpartition('.')[2]}",
                a=e.base,
                b=sampler,
                of_a=of_both,
                of_b=_exact(of_both),
            )
        )
    return found


def _exact(of_both: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Return batches -> derivatives, and a remainder of none."""
    return lambda values: (of_both(values), np.zeros(len(values)))
