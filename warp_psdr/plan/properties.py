"""What images of properties (``psdr.AovIntegrator``) have no derivatives of."""

from __future__ import annotations

from typing import TYPE_CHECKING

from warp_psdr.kernels.constants import METERS
from warp_psdr.kernels.medium.coefficients import POSE
from warp_psdr.plan import media
from warp_psdr.plan.transient import require_steady
from warp_psdr.plan.words import CAMERA_NAMES
from warp_psdr.scene.distortion import AFFINE, MODELS
from warp_psdr.scene.layout import MEDIUM

if TYPE_CHECKING:
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.scene.scene import Scene

#: Parameters of cameras that change how far the near clip plane is along a ray.
_TURNS_RAYS = ("x_fov", "principal_point_offset_x", "principal_point_offset_y", *AFFINE, *MODELS["opencv"])


def refuse(scene: Scene, config: PathConfig, names: list[str], sensor: int) -> None:
    """Raise for a property and a request that do not go together.

    Raises:
        ValueError: with what does.
    """
    if not config.shown:
        return
    require_steady(scene, sensor, "psdr.AovIntegrator")
    if config.camera in METERS:
        expected = "a 'perspective', 'thinlens' or 'orthographic' sensor"
        raise ValueError(f"AovIntegrator: got a {CAMERA_NAMES[config.camera]!r}, expected {expected}")
    if config.shown == "position" and scene.origin.any():
        raise ValueError(
            "AovIntegrator(aov='position'): the scene is far from the origin of the world, where float32 keeps no "
            "digits of positions; take 'depth', or move the scene to the origin"
        )
    if not names:
        return
    absent = [n for n in names if MEDIUM + POSE not in scene.parameters[n].uses and media.moves_media_alone(scene, n)]
    if absent:
        raise ValueError(
            f"AovIntegrator: {absent[0]} moves a surface that is not there ('null'), which images of properties show; "
            "leave it out of the request, or give the shape another bsdf"
        )
    if config.shown == "sh_normal" and config.surfaces.primitives:
        raise ValueError(
            "AovIntegrator(aov='sh_normal'): derivatives of normals are those of meshes; leave out 'exact', or take "
            "'mask', 'depth' or 'position', which shapes without triangles have, too"
        )
    turns = [name for name in names if name.rpartition(".")[2] in _TURNS_RAYS]
    if config.shown == "depth" and turns:
        raise ValueError(
            f"AovIntegrator(aov='depth'): {turns[0]} moves the near clip plane along the rays, of which depth has no "
            "derivative; take 'position'"
        )
