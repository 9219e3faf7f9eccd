"""Transient films in the plan: what it prints of them, and what it refuses."""

from __future__ import annotations

from typing import TYPE_CHECKING

from warp_psdr.kernels.primitive.dispatch import has_sliding
from warp_psdr.kernels.sensor.time_gate import PULSE_BOX, PULSE_DELTA, PULSE_GAUSSIAN, TimeGates
from warp_psdr.rows.replay import MOST_KEPT

if TYPE_CHECKING:
    from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.options.integrator import PathIntegrator
    from warp_psdr.scene.description import TimeBins
    from warp_psdr.scene.scene import Scene


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


def refused(config: PathConfig, integrator: PathIntegrator, wanted: GradientRequest | None) -> str:
    """Say what of a request before a transient film has no derivative; empty: all has."""
    if not config.pulse or wanted is None:
        return ""
    if not 1 <= integrator.max_depth <= MOST_KEPT:
        return (
            f"before a 'transient_hdr_film' max_depth is {integrator.max_depth}, and whole paths are kept; give 1 to "
            f"{MOST_KEPT}"
        )
    moves = wanted.geometry or "pose" in wanted.lights
    if wanted.bends:
        return "an index of refraction changes path lengths, whose derivative is not taken; hold it fixed"
    if moves and config.pulse == PULSE_DELTA:
        return (
            "path lengths change, and without a pulse light jumps from bin to bin, which has a boundary term of its "
            "own; give the film a pulse_width_opl of more than 0"
        )
    if moves and has_sliding(config.surfaces.primitives):
        return "points of grids, networks and curves slide along rays, whose lengths are not differentiated; use meshes"
    return ""
