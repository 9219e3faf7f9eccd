"""Which requested parameters move discontinuities of an image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.kernels import constants as c
from warp_psdr.kernels.bsdf.dispatch import has_delta_lobes
from warp_psdr.kernels.medium.coefficients import POSE
from warp_psdr.scene.layout import (
    CAMERA,
    LIGHT_POSE,
    MEDIUM,
    NORMALS,
    POSITIONS,
    SHAPE_GRID,
    SHAPE_POSE,
    TEXCOORDS,
    TO_UV,
)
from warp_psdr.scene.media.volume_pose import of

if TYPE_CHECKING:
    from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.scene.scene import Scene


@dataclass(frozen=True)
class Motion:
    """What moves discontinuities.

    Attributes:
        shapes: numbers of the shapes whose surfaces move.
        camera: the camera moves.
        light_pose: a point, spot or directional light moves or turns.
        normals: numbers of the shapes whose vertex normals turn by themselves.
        grids: a grid of a medium moves, and the points of the medium with it.
        values: values of grids and networks, or control points, move surfaces, each a part of one.
        steps: (shape, texture) whose steps slide over the surface (``kernels/texture/steps.py``).
    """

    shapes: frozenset[int]
    camera: bool
    light_pose: bool
    normals: frozenset[int] = frozenset()
    grids: bool = False
    values: bool = False
    steps: frozenset[tuple[int, int]] = frozenset()

    @property
    def edges(self) -> bool:
        """Whether edges move against the path vertices beside them, or lights against both."""
        return bool(self.shapes or self.camera or self.light_pose or self.grids)


def motion(scene: Scene, names: list[str]) -> Motion:
    """Return what the named parameters move."""
    uses = [(scene.parameters[n].uses, shape) for n in names for shape in scene.parameters[n].owners]
    return Motion(
        shapes=frozenset(owner for use, owner in uses if use & {POSITIONS, SHAPE_GRID, SHAPE_POSE}),
        camera=any(CAMERA in use for use, _owner in uses),
        light_pose=any(LIGHT_POSE in use for use, _owner in uses),
        normals=frozenset(owner for use, owner in uses if NORMALS in use),
        grids=any(MEDIUM + POSE in use for use, _owner in uses),
        values=any(SHAPE_GRID in use for use, _owner in uses),
        steps=_sliding_steps(scene, names),
    )


def _sliding_steps(scene: Scene, names: list[str]) -> frozenset[tuple[int, int]]:
    """Return the (shape, texture) whose steps the named parameters slide over the surface."""
    found = [p for p in (scene.parameters[name] for name in names) if p.uses & {TO_UV, TEXCOORDS}]
    if not found:
        return frozenset()
    moved = {p.offset for p in found} | {p.inverse for p in of(scene, names)}
    shapes = {shape for p in found if TEXCOORDS in p.uses for shape in p.owners}
    return frozenset(
        (shape, number)
        for shape, textures in scene.builder.stepped.items()
        for number in textures
        if shape in shapes or scene.builder.textures[number].to_uv in moved
    )


def seen_steps(scene: Scene, config: PathConfig, moves: Motion) -> frozenset[tuple[int, int]]:
    """Return the (shape, texture) whose steps move against the points that the camera sees."""
    if config.material_first:
        return moves.steps
    carried = {
        (shape, number)
        for shape, textures in scene.builder.stepped.items()
        for number in textures
        if moves.camera or shape in moves.shapes
    }
    return moves.steps | carried


def sliding_steps(scene: Scene, moves: Motion) -> frozenset[tuple[int, int]]:
    """Return the (shape, texture) whose steps move against path vertices that slide along rays."""
    slide = {i for i in scene.builder.primitives if moves.shapes and not scene.geometry(i).is_material}
    carried = {(shape, number) for shape in slide for number in scene.builder.stepped.get(shape, ())}
    return moves.steps | carried


def moves_in_media(wanted: GradientRequest) -> bool:
    """Whether path vertices, lights, directions or grids of media move."""
    return wanted.geometry or "pose" in wanted.lights or POSE in wanted.media


def moves_vertices(config: PathConfig, wanted: GradientRequest) -> bool:
    """Whether vertices of paths move: by geometry, or by a light of no area whose rays mirrors and glass turn."""
    turned = (
        "pose" in wanted.lights
        and c.DELTA_LIGHTS & set(config.lights.others)
        and has_delta_lobes(config.surfaces.bsdfs)
    )
    return wanted.geometry or bool(turned)


def moving_shapes(scene: Scene, moves: Motion) -> wp.array:
    """Return 1 for every shape that moves; a moving camera or light moves all of them, relative to itself."""
    mask = np.zeros(max(len(scene.builder.shapes), 1), np.int32)
    mask[sorted(moves.shapes)] = 1
    if moves.camera or moves.light_pose:
        mask[:] = 1
    return wp.array(mask, dtype=wp.int32, device=scene.device)
