"""Differential radiative transfer in the plan: where its own boundary is complete, and which edges it takes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.kernels import constants as c
from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.options import interior
from warp_psdr.plan.motion import motion, moves_in_media
from warp_psdr.topology.absent import absent_faces
from warp_psdr.topology.edges import upload
from warp_psdr.topology.edges_there import edges_there, joined
from warp_psdr.topology.interpolated_normals import interpolated_faces

if TYPE_CHECKING:
    from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.scene.scene import Scene

NAME = "interior.RadiativeTransfer()"
ALONE = "interior.RadiativeTransfer(edges=False) leaves out the edges that path vertices see"


def refused_by_transfer(config: PathConfig, wanted: GradientRequest) -> str:
    """Return why the equation cannot be estimated for what a kernel compiles; empty: it can."""
    if config.media is None:
        return f"{NAME} is for scenes with participating media; use interior.Replay() and a method of psdr.boundary"
    if not moves_in_media(wanted):
        return ""
    if config.rays.hidden:
        return f"{NAME} does not know hide_emitters where something moves; show the lights"
    kinds = {kind for slot in config.surfaces.material for kind in slot.kinds} | set(config.lights.area)
    if wanted.texcoords or kinds - {c.TEXTURE_CONSTANT}:
        return f"{NAME} lets points slide over what moves, and textures would; give constant values"
    return ""


def refused_in_scene(method: interior.Method, scene: Scene, names: list[str], sensor: int) -> str:
    """Return why the boundary that it estimates would not be all of it; empty: it is."""
    assert isinstance(method, interior.RadiativeTransfer)
    moving = motion(scene, names)
    if not (moving.edges or moving.normals):
        return ""
    absent = absent_faces(scene)
    bent = interpolated_faces(scene) & ~absent
    if bent.any():
        shape = scene.description.shapes[scene.builder.face_shape[np.flatnonzero(bent)[0]]]
        return f"{NAME} knows flat normals alone, and {shape.path!r} interpolates them; give it face_normals"
    if not method.edges:
        return ""
    lights = c.DELTA_LIGHTS & {e.kind for e in scene.builder.emitters}
    if lights:
        return (
            f"{NAME} has no term for the shadows of lights without an area, which are surfaces in a medium; use area "
            f"lights, or where nothing hides one of them: {ALONE}"
        )
    met = joined(scene)
    if met:
        return f"{NAME} does not know edges in which shapes meet, and {met}; move them apart a little"
    kind = scene.camera(sensor).kind
    if kind == c.CAMERA_IRRADIANCEMETER or kind == c.CAMERA_ORTHOGRAPHIC:
        return f"{NAME} does not know what moves before such a sensor; use a perspective camera or a radiancemeter"
    return ""


def has_film_edges(method: interior.Method, config: PathConfig) -> bool:
    """Whether edges that the camera sees have a term: a radiance meter has one ray, across which they move."""
    assert isinstance(method, interior.RadiativeTransfer)
    return method.edges and config.camera not in c.METERS


def sphere_edges(scene: Scene) -> Edges:
    """Return the edges between faces that are not in one plane, and open ones, drawn by their length."""
    edges = edges_there(scene)
    keep = np.flatnonzero((edges.length > 0.0) & (edges.wedge > 0.0))
    if not len(keep):
        return Edges()
    return upload(scene, edges, keep, edges.length[keep], np.zeros(len(keep)), np.ones(len(keep)))
