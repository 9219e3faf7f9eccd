"""Mirrored film points in the plan: what they can estimate, and the rooms in which they need no boundary term."""

from __future__ import annotations

from typing import TYPE_CHECKING

from warp_psdr.kernels.constants import RFILTER_BOX
from warp_psdr.options import interior
from warp_psdr.scene.layout import CAMERA, LIGHT_RADIANCE, MATERIAL, POSITIONS, RADIANCE, SHAPE_POSE
from warp_psdr.topology.interpolated_normals import interpolated_faces
from warp_psdr.topology.light_frames import hard_frames
from warp_psdr.topology.outlook import is_room_around

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

NAME = "interior.FilmAntithetic()"
#: Radius of a box that covers its own pixel and no other.
OWN_PIXEL = 0.5


def refused_on_the_film(_method: interior.Method, scene: Scene, _names: list[str], sensor: int) -> str:
    """Return why a film's filters jump where no term knows it; empty: they do not."""
    camera = scene.camera(sensor)
    own = camera.filter == RFILTER_BOX and camera.filter_radius <= OWN_PIXEL
    if not (camera.sample_border or own):
        return (
            f"{NAME} needs whole pixel filters, and those at the border of the film end there: give the film "
            f"sample_border=true, or use interior.Replay()"
        )
    return ""


def sees_a_room(scene: Scene, names: list[str], sensor: int) -> bool:
    """Return whether all that the camera sees is a closed convex room of flat normals, which no request opens.

    There no part of a surface hides another, and no boundary term is needed.
    """
    for name in names:
        uses = scene.parameters[name].uses
        moved = uses & {POSITIONS, SHAPE_POSE}
        still = all(use in (CAMERA, RADIANCE, LIGHT_RADIANCE) or use.startswith(MATERIAL) for use in uses)
        if not still and not (moved and uses <= {POSITIONS, SHAPE_POSE}):
            return False
        if moved and len(scene.description.shapes) > 1:
            return False
        if moved and hard_frames(scene):
            return False
    if interpolated_faces(scene).any():
        return False
    camera = scene.camera(sensor)
    pose = scene.values.numpy()[camera.to_world : camera.to_world + 16].reshape(4, 4)
    return is_room_around(scene, pose[:3, 3])
