"""What the plan says of participating media, and which derivatives in scenes with media it refuses."""

from __future__ import annotations

from typing import TYPE_CHECKING

from warp_psdr.kernels import constants as c
from warp_psdr.kernels.medium.coefficients import ALBEDO, PHASE, SCALE, SIGMA_T
from warp_psdr.options import interior
from warp_psdr.scene.super_grid import PhaseTable

if TYPE_CHECKING:
    from warp_psdr.kernels.interior.gradient_request import GradientRequest
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.scene.scene import Scene

#: What of a medium is differentiated.
PARAMETERS = (SIGMA_T, ALBEDO, SCALE, PHASE)
PHASE_NAMES = {
    c.PHASE_ISOTROPIC: "isotropic",
    c.PHASE_HG: "hg",
    c.PHASE_RAYLEIGH: "rayleigh",
    c.PHASE_TABLE: "tabphase",
}


def describe(scene: Scene, config: PathConfig, wanted: GradientRequest | None) -> list[tuple[str, str, str]]:
    """Return the plan's lines on the media of a scene; none where there are none."""
    if config.media is None:
        return []
    bounds = sum(sides[0] != c.NO_INTERFACE for sides in scene.builder.sides)
    phases = ", ".join(PHASE_NAMES[kind] for kind in config.media.phases)
    of_grids = len(scene.builder.super_grids)
    kinds = ((len(scene.builder.media) - of_grids, "homogeneous"), (of_grids, "heterogeneous"))
    several = " and ".join(f"{count} {kind}" for count, kind in kinds if count)
    chromatic = "colours: one channel is drawn, all weigh" if config.media.chromatic else "grey: no channel is drawn"
    lines = [
        ("media", several, f"bounded by {bounds} shapes; null lobes do not count as depth, collisions do"),
        ("phase functions", phases, "those of the media"),
        ("extinction", "by channel" if config.media.chromatic else "grey", chromatic),
    ]
    for grid in scene.builder.super_grids:
        voxels, cells = (" x ".join(str(n) for n in size) for size in (grid.voxels, grid.cells))
        tracked = f"majorants of {cells} cells; delta tracking, and ratio tracking for shadow rays"
        lines.append((f"grid {grid.parameter.removesuffix('.data')}", f"{voxels} voxels", tracked))
    if wanted is not None:
        density = SIGMA_T in wanted.media or SCALE in wanted.media
        forced = "some flights are made to collide, for where the density is zero" if density else "density: no"
        if density and of_grids:
            forced += " (in grids when a clock rings, points on each stretch for its transmittance)"
        lines.append(("media derivatives", ", ".join(wanted.media) or "none", forced))
    return lines


def refuse(config: PathConfig, method: interior.Method, wanted: GradientRequest | None, names: list[str]) -> None:
    """Refuse what there is not in scenes with media: other methods, and derivatives by what moves.

    Raises:
        ValueError: with what to do instead.
    """
    if config.media is None:
        return
    known = (interior.Replay, interior.DifferentialRatioTracking)
    if type(method) not in known and (names or isinstance(method, interior.LightTracing)):
        raise ValueError(
            f"interior.{type(method).__name__}() does not know participating media; use interior.Replay(), or leave "
            "them out"
        )
    if wanted is not None and (wanted.geometry or "pose" in wanted.lights):
        _refuse_motion(f"derivatives by {', '.join(names)}: path vertices, lights or directions move")


def refuse_zeros(scene: Scene, names: list[str]) -> None:
    """Refuse derivatives by tables of phase functions that hold zeros: no direction is drawn there.

    Raises:
        ValueError: with what to do instead.
    """
    for table in scene.builder.media_followers:
        if isinstance(table, PhaseTable) and table.parameter in names:
            values = scene.view(table.parameter).numpy()
            if not values.all():
                raise ValueError(
                    f"the derivative by {table.parameter} would lack the light that is scattered where it is 0; write "
                    "a small value in place of each 0"
                )


def refuse_motion(config: PathConfig, moving: tuple[str, ...]) -> None:
    """Refuse what moves a discontinuity in a scene with media.

    Raises:
        ValueError: with what to do instead.
    """
    if config.media is not None and moving:
        _refuse_motion("; ".join(moving))


def _refuse_motion(what: str) -> None:
    raise ValueError(
        f"{what}, which has no derivative in a scene with participating media yet; hold still what moves (coefficients "
        "of media, phase functions, reflectances, roughnesses and radiances are differentiated), or leave the media out"
    )
