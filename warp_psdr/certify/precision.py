"""Check 4: the same derivatives with the world a thousand times larger, and smaller.

Lengths are multiplied by s, all of them: positions, poses, cameras, clip planes. Light that falls off with a distance
is multiplied by s^2, and what media have per length is divided by s. The image stays as it is, and the derivative along
the scaled direction, too. Equal seeds draw the same paths, up to rounding. So distances that are taken for zero, and
digits that are lost, show in a few batches. (Worlds far away need no check: positions on the device are relative to a
point near the scene, so that they are the same numbers there.)

Derivation: ``docs/theory/certificates.md#worlds-of-other-sizes``.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from warp_psdr.certify.examination import Examination
from warp_psdr.certify.identities import compared_sides
from warp_psdr.certify.spending import Row
from warp_psdr.certify.subject import SceneSubject
from warp_psdr.kernels.medium.coefficients import EMISSION, SCALE
from warp_psdr.scene.layout import CAMERA, LIGHT_POSE, MEDIUM, SHAPE_GRID, Parameter
from warp_psdr.scene.scene import Scene

NAME = "precision"
SCALES = (1.0e-3, 1.0e3)
#: Sides of a comparison draw the same paths, so that few of them do.
FEWER = 4
#: Lights that fall off with the square of the distance, and values of lenses that are lengths.
FALL_OFF, LENGTHS = ("point", "spot", "projector"), (".aperture_radius", ".focus_distance")


class NotScaled(Exception):
    """A scene has lengths that are no parameters."""


def rows(e: Examination) -> list[Row]:
    """Return the rows: one a parameter and scale."""
    subject = e.scene_subject
    if subject is None:
        return []
    try:
        factors = [scaling(subject.scene, scale) for scale in SCALES]
    except NotScaled as reason:
        e.notes.append(f"{NAME} is left out: {reason}")
        return []
    subject = replace(subject, spp=(subject.spp[0], max(subject.spp[1] // FEWER, 1)))
    chosen, adjoint = [direction for _number, direction in e.telling()], e.adjoints[:1]

    def draw(seed: int) -> np.ndarray:
        """Return derivatives (directions, 1 + scales): of the scene as it is, and in the other worlds."""
        plain = subject.gradients(adjoint, seed)
        found = [[float(d.along(plain[d.parameter])[0]) for d in chosen]]
        for scale, factor in zip(SCALES, factors, strict=True):
            with world_of(subject, scale, factor):
                gradients = subject.gradients(adjoint, seed)
            tangents = [d.tangent * factor.get(d.parameter, 1.0) for d in chosen]
            found.append([float((gradients[d.parameter][0] * t).sum()) for d, t in zip(chosen, tangents, strict=True)])
        return np.array(found).T

    return compared_sides(e, NAME, chosen, [f"world × {scale:g}" for scale in SCALES], draw)


def scaling(scene: Scene, scale: float) -> dict[str, np.ndarray]:
    """Return name -> factors, in the parameter's shape or one for all, of the parameters that a world's size changes.

    Raises:
        NotScaled: the scene has shapes whose lengths are no parameters.
    """
    found = {name: factor for name, p in scene.parameters.items() if (factor := _factor(p, scene, scale)) is not None}
    for emitter in scene.description.emitters:
        if emitter.kind in FALL_OFF:
            found |= {t.parameter: np.array(scale**2) for t in emitter.radiance.leaves}
    return found


def _factor(p: Parameter, scene: Scene, scale: float) -> np.ndarray | None:
    if SHAPE_GRID in p.uses:
        raise NotScaled(f"{p.name!r} belongs to a shape without triangles, whose lengths are no parameters")
    if p.uses & {MEDIUM + SCALE, MEDIUM + EMISSION}:
        return np.array(1.0 / scale)
    if p.name.endswith(LENGTHS) and CAMERA in p.uses:
        return np.array(scale)
    if not p.placed:
        return None
    if p.numpy_shape != (4, 4):
        return np.array(scale)
    factor = np.ones((4, 4))
    turns = bool(p.uses & {CAMERA, LIGHT_POSE}) and p.name not in _measures(scene)
    factor[:3, 3 if turns else 0 :] = scale
    return factor


def _measures(scene: Scene) -> list[str]:
    """Return the poses of cameras that have a size."""
    return [f"{s.path}.to_world" for s in scene.description.sensors if s.kind == "orthographic"]


@contextlib.contextmanager
def world_of(subject: SceneSubject, scale: float, factors: dict[str, np.ndarray]) -> Iterator[None]:
    """Let the scene be a larger or a smaller one meanwhile, about the origin of the device's coordinates."""
    scene, cameras = subject.scene, subject.scene.builder.cameras
    values = {}
    for name, factor in factors.items():
        values[name] = factor * subject.params[name].numpy().astype(np.float64)
        if scene.parameters[name].placed:
            place = values[name][:3, 3] if factor.shape == (4, 4) else values[name]
            place += (1.0 - scale) * scene.origin
    clips = [(camera.near, camera.far) for camera in cameras]
    try:
        for camera, sensor in zip(cameras, scene.description.sensors, strict=True):
            near = 1.0 if sensor.kind == "orthographic" else scale  # there it follows the pose
            camera.near, camera.far = near * camera.near, near * camera.near + scale * (camera.far - camera.near)
        with subject.moved(values):
            yield
    finally:
        for camera, (near, far) in zip(cameras, clips, strict=True):
            camera.near, camera.far = near, far
