"""Discontinuities whose boundary terms know less than their methods: where a scene holds one, the plan refuses.

A boundary term that lacks a word of its methods is declared here, and its file in ``estimate/boundary/terms`` takes its
words and its condition from here. So the plan and the gradient ask the same question.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.kernels import constants as c
from warp_psdr.kernels.bsdf.dispatch import has_smooth_lobes
from warp_psdr.options.boundary import EdgeSampling, Method, PathSpace, Projective
from warp_psdr.options.words import Word, words
from warp_psdr.plan.motion import Motion
from warp_psdr.topology.interpolated_normals import interpolated_choice, terminator_faces
from warp_psdr.topology.intersection_curves import moving_curves, scene_curves
from warp_psdr.topology.light_frames import hard_frames

if TYPE_CHECKING:
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.scene.scene import Scene


@dataclass(frozen=True)
class Asked:
    """What a declaration is asked about: a scene, what its path loop compiles, what moves, a sensor, a depth."""

    scene: Scene
    config: PathConfig
    moves: Motion
    sensor: int
    max_depth: int

    @property
    def lit(self) -> bool:
        """Whether there are lights, and paths that reach them by way of a vertex."""
        return self.max_depth != 1 and bool(self.scene.builder.emitters)

    @property
    def glows(self) -> bool:
        """Whether there are media that shine on what scatters their light."""
        return self.max_depth != 1 and self.config.media is not None and self.config.media.emissive

    @property
    def vertex_motion(self) -> Motion:
        """What moves path vertices against each other: not the camera, unless first vertices slide along its rays."""
        return replace(self.moves, camera=False) if self.config.material_first else self.moves

    @property
    def scatters_smoothly(self) -> bool:
        """Whether any surface is more than a mirror or glass: only then can a path vertex be connected to another."""
        return has_smooth_lobes(self.config.surfaces.bsdfs)

    @property
    def scatters_somewhere(self) -> bool:
        """Whether surfaces do so, or media."""
        return self.scatters_smoothly or self.config.media is not None

    @property
    def meets_light(self) -> bool:
        """Whether a direction can meet light: that of lights of no area is met behind another vertex alone."""
        kinds = {e.kind for e in self.scene.builder.emitters}
        return bool(kinds if self.max_depth != 2 else kinds - c.DELTA_LIGHTS)


@dataclass(frozen=True, kw_only=True)
class Discontinuity:
    """A kind of discontinuity.

    Attributes:
        knows: words of what its boundary term copes with.
        applies: whether it can exist at all, without a look at the scene's edges.
        find: what there is of it, in words; empty: nothing.
        instead: what to do where its term does not know a word.
    """

    knows: frozenset[str]
    applies: Callable[[Asked], bool]
    find: Callable[[Asked], str]
    instead: str


def _turned_from_camera(asked: Asked) -> str:
    shapes = set(asked.moves.shapes | asked.moves.normals)
    found = terminator_faces(asked.scene, asked.sensor, shapes, camera_moves=asked.moves.camera)
    return "" if found is None else "interpolated normals turn away from the camera along curves that move"


def _turned_from_others(asked: Asked) -> str:
    found = interpolated_choice(asked.scene)
    return "" if found is None else "interpolated normals turn away from light, or from each other, along curves"


def _pierced(asked: Asked) -> str:
    curves = scene_curves(asked.scene)
    found = np.flatnonzero(moving_curves(asked.scene, curves, set(asked.moves.shapes)))
    if not len(found):
        return ""
    faces = curves.faces.reshape(-1, 2)[found[0]]
    a, b = (asked.scene.description.shapes[i].path for i in asked.scene.builder.face_shape[faces])
    return f"{a!r} and {b!r} run through each other, along a curve that moves"


#: Words by which terms of one method differ.
FILMS_AND_SHAPES = ("slides", "material_points", "transient")
FLAT = "give the meshes that move, and those beside them, face_normals"
TERMINATOR = Discontinuity(
    knows=words("material_points", "slides", "media"),
    applies=lambda asked: asked.config.scatter,
    find=_turned_from_camera,
    instead=FLAT,
)
INDIRECT_TERMINATOR = Discontinuity(
    knows=words("material_points", "slides", "media"),
    applies=lambda asked: (
        (asked.vertex_motion.edges or bool(asked.moves.normals))
        and not 0 <= asked.max_depth <= 2
        and asked.lit
        and asked.scatters_smoothly
    ),
    find=_turned_from_others,
    instead=FLAT,
)
GEOMETRIC_HORIZON = Discontinuity(
    knows=words("material_points", "slides", "media"),
    applies=lambda asked: (
        asked.max_depth != 1 and bool(asked.moves.shapes) and asked.scatters_smoothly and asked.meets_light
    ),
    find=_turned_from_others,
    instead=FLAT,
)
INTERSECTION_CURVE = Discontinuity(
    knows=words("material_points", "slides", "media"),
    applies=lambda asked: (
        (asked.lit or asked.glows)
        and (asked.max_depth != 2 or bool(asked.config.lights.area) or asked.config.media is not None)
        and asked.scatters_somewhere
    ),
    find=_pierced,
    instead="move them apart",
)
SLIDING_STEPS = Discontinuity(
    knows=words("material_points", "slides", "media"),
    applies=lambda asked: bool(asked.moves.steps) and (asked.lit or asked.glows) and asked.scatters_somewhere,
    find=lambda _asked: "steps of a texture slide over its surface",
    instead="use a bilinear bitmap",
)
FRAME = "a projector's image ends in a hard edge of light"
LIGHT_FRAME = Discontinuity(
    knows=words("material_points", "slides"),
    applies=lambda asked: asked.vertex_motion.edges and asked.lit and asked.scatters_smoothly,
    find=lambda asked: FRAME if hard_frames(asked.scene) else "",
    instead="give it a border of black texels (with 'bilinear' filtering and without to_uv)",
)
#: Those of each method, in the order in which they are looked for.
OF_METHODS: dict[type[Method], tuple[Discontinuity, ...]] = dict.fromkeys(
    (PathSpace, Projective, EdgeSampling),
    (INTERSECTION_CURVE, TERMINATOR, INDIRECT_TERMINATOR, GEOMETRIC_HORIZON, SLIDING_STEPS, LIGHT_FRAME),
)


def unknown(asked: Asked, method: Method, needed: Mapping[str, Word]) -> str:
    """Say which discontinuity moves whose boundary term lacks a word; empty: none.

    Args:
        asked: where and what moves.
        method: of the boundary term.
        needed: words of the scene, and what has each.
    """
    if asked.config.media is not None:  # terms of media stand for these (``plan/media.py``)
        return ""
    for kind in OF_METHODS.get(type(method), ()):
        lacking = next(
            (needed[word].what for word in FILMS_AND_SHAPES if word in needed and word not in kind.knows), ""
        )
        if lacking and kind.applies(asked) and (found := kind.find(asked)):
            return f"{found}, whose boundary term does not know {lacking}; {kind.instead}"
    return ""
