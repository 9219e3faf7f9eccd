"""Where mirrored film points are the whole derivative: inside a closed convex room, all of which the camera sees."""

from __future__ import annotations

from typing import TYPE_CHECKING

from warp_psdr.kernels.bsdf.dispatch import has_delta_lobes
from warp_psdr.kernels.constants import CAMERA_PERSPECTIVE, RFILTER_BOX
from warp_psdr.options import interior
from warp_psdr.scene.layout import CAMERA, LIGHT_RADIANCE, MATERIAL, POSITIONS, RADIANCE, SHAPE_POSE
from warp_psdr.topology.interpolated_normals import interpolated_faces
from warp_psdr.topology.outlook import is_room_around

if TYPE_CHECKING:
    from warp_psdr.kernels.interior.gradient_request import GradientRequest
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.scene.scene import Scene

NAME = "interior.FilmAntithetic()"
INSTEAD = "use interior.Replay()"


def refused_by_film_antithetic(config: PathConfig, _wanted: GradientRequest) -> str:
    """Return why mirrored film points cannot estimate what a kernel compiles; empty: they can."""
    if config.camera != CAMERA_PERSPECTIVE:
        return f"{NAME} projects points by a 'perspective' camera; take one, or {INSTEAD}"
    if config.filter == RFILTER_BOX:
        return (
            f"{NAME} differentiates the pixel filter, and that of a box is a jump at the pixel's border: give the film "
            f"a 'tent' or a 'gaussian' rfilter, or {INSTEAD}"
        )
    if has_delta_lobes(config.bsdfs):
        return (
            f"{NAME} has no boundary term for the edges that mirrors, glass and masks show moving; take rough ones, or "
            f"{INSTEAD}"
        )
    if config.hidden:
        return f"{NAME} counts the light that the camera sees; leave out hide_emitters, or {INSTEAD}"
    return ""


def refused_for_what_is_seen(_method: interior.Method, scene: Scene, names: list[str], sensor: int) -> str:
    """Return why a scene, a camera or a request is none of those whose whole derivative is known; empty: it is."""
    camera = scene.camera(sensor)
    if not camera.sample_border:
        return (
            f"{NAME} needs whole pixel filters, and those at the border of the film end there: give the film "
            f"sample_border=true, or {INSTEAD}"
        )
    for name in names:
        parameter = scene.parameters[name]
        moved = parameter.uses & {POSITIONS, SHAPE_POSE}
        still = all(use in (CAMERA, RADIANCE, LIGHT_RADIANCE) or use.startswith(MATERIAL) for use in parameter.uses)
        if not still and not (moved and parameter.uses <= {POSITIONS, SHAPE_POSE}):
            return (
                f"{NAME} is for cameras, and for rooms of one shape that move as a whole, with material values and "
                f"radiances beside them; {name} is none: {INSTEAD}"
            )
        if moved and len(scene.description.shapes) > 1:
            return (
                f"{NAME} moves a room only if it is one shape, for others leave gaps or hide each other, and {name} "
                f"moves one of {len(scene.description.shapes)}: {INSTEAD}"
            )
    if interpolated_faces(scene).any():
        return f"{NAME} knows flat normals alone; give shapes face_normals, or {INSTEAD}"
    pose = scene.values.numpy()[camera.to_world : camera.to_world + 16].reshape(4, 4)
    if not is_room_around(scene, pose[:3, 3]):
        return (
            f"{NAME} has no boundary term for silhouettes: all that the camera sees has to be a closed convex room "
            f"around it, of which no part hides another, and nothing in it; {INSTEAD} with a method of the boundary "
            "term"
        )
    return ""
