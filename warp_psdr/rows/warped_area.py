"""Warped-area sampling and rotations: the scenes in which their rays move correctly.

The motion of a ray has to meet every discontinuity near it with the speed of that discontinuity. Auxiliary rays know
the edges of the triangles that they meet. Scenes with jumps elsewhere are refused.

Derivation: ``docs/theory/reparameterisation.md#what-is-refused``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from warp_psdr.kernels import constants as c
from warp_psdr.kernels.boundary.warped_area.auxiliary import WarpedOptions
from warp_psdr.kernels.boundary.warped_area.rotation import RotationOptions
from warp_psdr.kernels.boundary.warped_area.warped_area import make_warped_area_kernel
from warp_psdr.options import interior
from warp_psdr.options.boundary import AuxiliaryRays, Rotation, WeightedRays
from warp_psdr.plan.motion import motion
from warp_psdr.rows.replay import Kept
from warp_psdr.topology import contacts
from warp_psdr.topology.clip_planes import require_uncut
from warp_psdr.topology.intersection_curves import scene_curves

if TYPE_CHECKING:
    from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.options.integrator import PathIntegrator
    from warp_psdr.scene.scene import Scene

#: Most path vertices, which are kept as a whole.
MOST_VERTICES = 16
INSTEAD = "use boundary.PathSpace()"


def compiled(method: AuxiliaryRays) -> WarpedOptions | RotationOptions:
    """Return what of a method is compiled."""
    if isinstance(method, Rotation):
        return RotationOptions(method.rays, float(method.kappa), float(method.film_sigma), method.pairs, method.fresh)
    assert isinstance(method, WeightedRays)
    return WarpedOptions(method.rays, float(method.kappa), method.debias)


def describe(method: AuxiliaryRays) -> list[tuple[str, str, str]]:
    """Return the plan's lines."""
    if isinstance(method, Rotation):
        rays = f"{method.rays} auxiliary rays{' for each of two kernels' if method.pairs else ''}"
        return [("edges", "rays turn with them", f"biased by design, by 5 to 80 % and more: {rays} choose a rotation")]
    assert isinstance(method, WeightedRays)
    rays = f"{method.rays} auxiliary rays about each ray"
    why = f"{rays}, doubled at random: unbiased" if method.debias else f"{rays}: biased, debias=False"
    return [("edges", "rays move with them", why)]


def kept_vertices(max_depth: int) -> int:
    """Return how many vertices of a path are kept: few kernel variants."""
    most = 4
    while most < max_depth:
        most *= 2
    return most


def keep_warped(_method: interior.Method, max_depth: int, _rr_depth: int) -> Kept:
    """Return what is kept of a path."""
    said = "every vertex is found by the ray before it; the whole path fits, one trace"
    return Kept(kept_vertices(max_depth), 1, said)


def make_warped(config: PathConfig, wanted: GradientRequest, role: str, kept: Kept) -> wp.Kernel:
    """Return the kernel of interior and boundary term."""
    assert isinstance(kept.warp, (WarpedOptions, RotationOptions))
    return make_warped_area_kernel(config, wanted, role, kept.warp, kept.longest)


def refused(
    scene: Scene, config: PathConfig, integrator: PathIntegrator, method: AuxiliaryRays, names: list[str], sensor: int
) -> str:
    """Say why rays cannot move rightly; empty: they can."""
    return (
        _of_request(scene, integrator, method, names)
        or _of_camera(scene, config, names, sensor)
        or _of_surfaces(scene, config, names)
        or _of_light(scene, config)
    )


def _of_request(scene: Scene, integrator: PathIntegrator, method: AuxiliaryRays, names: list[str]) -> str:
    """Say what moves whose discontinuities are not followed; empty: nothing."""
    moves = motion(scene, names)
    if moves.camera:
        return f"the camera moves; {INSTEAD}"
    if moves.light_pose:
        return f"a light without a surface moves; {INSTEAD}"
    if not 1 <= integrator.max_depth <= MOST_VERTICES:
        return f"max_depth is {integrator.max_depth}, and it keeps whole paths; say 1 to {MOST_VERTICES}, or {INSTEAD}"
    return ""


def _of_camera(scene: Scene, config: PathConfig, names: list[str], sensor: int) -> str:
    """Say why a camera's rays cannot move; empty: they can."""
    require_uncut(scene, sensor, set(motion(scene, names).shapes), camera_moves=False)
    return ""


def _of_surfaces(scene: Scene, config: PathConfig, names: list[str]) -> str:
    """Say which surfaces have discontinuities beside the edges of their triangles; empty: none."""
    if len(scene_curves(scene).length):
        return f"shapes run through each other along a curve that is no edge; move them apart, or {INSTEAD}"
    found = contacts.touching(scene, motion(scene, names).shapes)
    if found:
        return f"{found} touch, and rays next to the contact would be arbitrarily fast; leave a gap, or {INSTEAD}"
    return ""


def _of_light(scene: Scene, config: PathConfig) -> str:
    """Say which lights have shadows that no ray moves with; empty: none."""
    if config.scatter and scene.builder.radiance_kinds - {c.TEXTURE_CONSTANT}:
        return f"an area light has a texture, past which sampled points would move; give it one radiance, or {INSTEAD}"
    return ""
