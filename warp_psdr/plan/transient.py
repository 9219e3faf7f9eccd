"""Transient films in the plan: what it prints of them, and what it refuses."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.kernels import constants as c
from warp_psdr.kernels.bsdf.dispatch import has_smooth_lobes, passing
from warp_psdr.kernels.primitive.dispatch import has_sliding
from warp_psdr.kernels.sensor.time_gate import PULSE_BOX, PULSE_DELTA, PULSE_GAUSSIAN, TimeGates
from warp_psdr.options import interior
from warp_psdr.plan.motion import Motion, motion
from warp_psdr.plan.replay import MOST_KEPT
from warp_psdr.plan.words import EMITTER_NAMES
from warp_psdr.topology.interpolated_normals import interpolated_choice, terminator_faces
from warp_psdr.topology.intersection_curves import moving_curves, scene_curves

if TYPE_CHECKING:
    from warp_psdr.kernels.interior.gradient_request import GradientRequest
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.options.integrator import PathIntegrator
    from warp_psdr.scene.description import TimeBins
    from warp_psdr.scene.scene import Scene

#: Lights whose points are somewhere, so that light from there has a length.
NEAR = c.DELTA_LIGHTS - {c.EMITTER_DIRECTIONAL, c.EMITTER_DIRECTIONAL_AREA} | {c.EMITTER_AREA}


def times_of(scene: Scene, sensor: int) -> TimeBins | None:
    """Return the time bins of a sensor's film; None: it has none."""
    return scene.description.sensors[sensor].film.times


def pulse_of(times: TimeBins | None) -> int:
    """Return the kind of pulse that the kernels compile; 0: there are no bins."""
    if times is None:
        return 0
    if times.pulse_length == 0.0:
        return PULSE_DELTA
    return PULSE_BOX if times.pulse == "box" else PULSE_GAUSSIAN


def gates_of(times: TimeBins) -> TimeGates:
    """Return the kernels' record of a film's bins."""
    gates = TimeGates()
    gates.bins, gates.start, gates.width = times.count, times.start, times.width
    gates.pulse, gates.unwarp = times.pulse_length, int(times.unwarp)
    return gates


def shape_of(scene: Scene, sensor: int) -> tuple[int, ...]:
    """Return the shape of a sensor's image: (H, W), or (H, W, bins) of a transient film."""
    camera, times = scene.camera(sensor), times_of(scene, sensor)
    size = camera.crop_height, camera.crop_width
    return size if times is None else (*size, times.count)


def require_steady(scene: Scene, sensor: int | str, what: str) -> None:
    """Raise before a transient film.

    Raises:
        ValueError: the sensor has one; ``what`` says what does not take it.
    """
    number = scene.description.sensor_number(sensor)
    if times_of(scene, number) is not None:
        raise ValueError(
            f"{what} does not take the 'transient_hdr_film' of sensor {scene.description.sensors[number].path!r}; call "
            "render, render_forward or render_backward with spp, or give it an 'hdrfilm'"
        )


def describe(times: TimeBins | None) -> list[tuple[str, str, str]]:
    """Return the plan's line on a film's bins; none where there are none."""
    if times is None:
        return []
    pulse = "none" if times.pulse_length == 0.0 else f"{times.pulse} pulse of {times.pulse_length:g}"
    since = "the first surface" if times.unwarp else "the camera"
    bins = f"{times.count} bins of {times.width:g}"
    return [("film", bins, f"optical path lengths from {times.start:g} on, counted from {since}; {pulse}")]


def refuse(
    scene: Scene,
    config: PathConfig,
    integrator: PathIntegrator,
    method: interior.Method,
    wanted: GradientRequest | None,
    names: list[str],
    sensor: int,
) -> None:
    """Refuse what has no path length, or no derivative of it, before a transient film.

    Raises:
        ValueError: with what to do instead.
    """
    if not config.pulse:
        return
    reason = _untimed(config, method)
    if not reason and wanted is not None:
        reason = _undifferentiated(config, integrator, method, wanted)
    if reason:
        of = f"derivatives by {', '.join(names)} before" if wanted is not None else "before"
        path = scene.description.sensors[sensor].path
        raise ValueError(f"{of} the 'transient_hdr_film' of {path!r}: {reason}")


def refuse_boundary(
    scene: Scene, config: PathConfig, integrator: PathIntegrator, names: list[str], sensor: int
) -> None:
    """Refuse moving discontinuities whose boundary terms do not know time bins (``estimate/boundary/terms``).

    Raises:
        ValueError: with what they are, and what to do instead.
    """
    if not config.pulse:
        return
    moves, depth = motion(scene, names), integrator.max_depth
    reason = _crossing(scene, config, moves, depth)
    if not reason and _shades_smoothly(scene, config, moves, depth, sensor):
        reason = (
            "interpolated normals turn away from light and camera along curves that move; give the meshes face_normals"
        )
    if reason:
        path = scene.description.sensors[sensor].path
        raise ValueError(
            f"derivatives by {', '.join(names)} before the 'transient_hdr_film' of {path!r}: {reason}, or say "
            "PathIntegrator(boundary=None) to get the interior term alone"
        )


def _crossing(scene: Scene, config: PathConfig, moves: Motion, depth: int) -> str:
    """Say which shapes run through each other where paths can scatter, if one of them moves; empty: none."""
    lit = bool(scene.builder.emitters) and depth != 1 and (depth != 2 or bool(config.area))
    if not (lit and has_smooth_lobes(config.bsdfs)):
        return ""
    curves = scene_curves(scene)
    found = np.flatnonzero(moving_curves(scene, curves, set(moves.shapes)))
    if not len(found):
        return ""
    faces = curves.faces.reshape(-1, 2)[found[0]]
    a, b = (scene.description.shapes[i].path for i in scene.builder.face_shape[faces])
    return f"{a!r} and {b!r} run through each other, along a curve that moves; move them apart"


def _shades_smoothly(scene: Scene, config: PathConfig, moves: Motion, depth: int, sensor: int) -> bool:
    """Whether curves move at which interpolated normals turn away from the camera, from light or from each other."""
    turned = set(moves.shapes | moves.normals)
    if config.scatter and terminator_faces(scene, sensor, turned, camera_moves=moves.camera) is not None:
        return True
    kinds = {e.kind for e in scene.builder.emitters}
    if not has_smooth_lobes(config.bsdfs) or not kinds or depth == 1:
        return False
    indirect = not 0 <= depth <= 2 and bool(moves.edges or moves.normals)
    horizons = bool(moves.shapes) and (depth != 2 or bool(kinds - c.DELTA_LIGHTS))
    return (indirect or horizons) and interpolated_choice(scene) is not None


def _untimed(config: PathConfig, method: interior.Method) -> str:
    """Say what of a scene has no path length; empty: all has."""
    if config.media is not None:
        return "participating media are not timed; leave them out, or use an 'hdrfilm'"
    far = sorted(set(config.lights) - NEAR)
    if far:
        return f"light of {EMITTER_NAMES[far[0]]!r} comes from infinity and has no path length; use 'area' or 'point'"
    rough = passing(config.bsdfs)
    if rough:
        return f"a {rough!r} lets light through in a smooth lobe, which is not timed; use a 'dielectric'"
    if isinstance(method, interior.FROM_LIGHTS):
        return f"interior.{type(method).__name__}() traces light paths, which are not timed; use interior.Replay()"
    return ""


def _undifferentiated(
    config: PathConfig, integrator: PathIntegrator, method: interior.Method, wanted: GradientRequest
) -> str:
    """Say what of a request has no derivative; empty: all has."""
    if type(method) is not interior.Replay:
        return f"interior.{type(method).__name__}() does not differentiate path lengths; use interior.Replay()"
    if not 1 <= integrator.max_depth <= MOST_KEPT:
        return f"max_depth is {integrator.max_depth}, and whole paths are kept; give 1 to {MOST_KEPT}"
    moves = wanted.geometry or "pose" in wanted.lights
    if wanted.bends:
        return "an index of refraction changes path lengths, whose derivative is not taken; hold it fixed"
    if moves and config.pulse == PULSE_DELTA:
        return (
            "path lengths change, and without a pulse light jumps from bin to bin, which has a boundary term of its "
            "own; give the film a pulse_width_opl of more than 0"
        )
    if moves and has_sliding(config.primitives):
        return "points of grids, networks and curves slide along rays, whose lengths are not differentiated; use meshes"
    return ""
