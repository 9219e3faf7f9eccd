"""Steps of textures that move against the points that read them.

A path's points ride on their triangles, and the steps with them, but for the points that a ray with a fixed start
finds: those that the camera sees, and those behind smooth mirrors and glass. ``to_uv`` and texture coordinates slide
steps over their surface, at every vertex.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from warp_psdr.kernels import constants as c
from warp_psdr.kernels.bsdf.dispatch import has_chain_lobes
from warp_psdr.options.boundary import EdgeSampling, Method, PathSpace, Projective
from warp_psdr.plan.motion import motion, seen_steps, sliding_steps
from warp_psdr.scene.layout import TEXCOORDS
from warp_psdr.topology.kinds.tube_items import on_curves
from warp_psdr.topology.texture_steps import coincide, on_seams, too_many
from warp_psdr.topology.tube_steps import slide_on_seams, too_many_on_tubes

if TYPE_CHECKING:
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.scene.scene import Scene

#: Methods that have the terms of ``estimate/boundary/terms/texture_steps.py``.
METHODS = (PathSpace, Projective, EdgeSampling)


def slides(scene: Scene, name: str) -> bool:
    """Whether a parameter, texture coordinates or their transformation, slides what jumps inside of a surface."""
    parameter, b = scene.parameters[name], scene.builder
    if TEXCOORDS in parameter.uses:
        read = [t for shape in parameter.owners for t in b.textures_of(b.shapes[shape])]
        if any(t.kind == c.TEXTURE_FACE for t in read):
            return True
    return bool(motion(scene, [name]).steps)


def refused(scene: Scene, config: PathConfig, names: list[str], method: Method) -> str:
    """Say why the boundary term of steps that move cannot be estimated; empty: it can, or none move."""
    moves = motion(scene, names)
    listed = seen_steps(scene, config, moves)
    tubes = on_curves(scene, listed | sliding_steps(scene, moves))
    shown = listed | {(i, t) for i, t in sliding_steps(scene, moves) if i in scene.builder.primitives}
    if has_chain_lobes(config.surfaces.bsdfs, config.media is not None) and not config.material_first:
        shown |= {(i, t) for i, textures in scene.builder.stepped.items() for t in textures}
    smoother = "use a bilinear bitmap, a trilinear volume or a vertex attribute"
    for shape, number in sorted(shown):
        which = f"a texture of {scene.description.shapes[shape].path!r} has steps, which move"
        if scene.builder.textures[number].kind == c.TEXTURE_GRID:
            return f"{which}, and those of a 'gridvolume' are not known; {smoother}"
        if shape in scene.builder.primitives:
            beside = _beside_tubes(config, method) if (shape, number) in tubes else "shapes without triangles"
            if beside:
                return f"{which}, and they are not known on {beside}; {smoother}, or give triangles"
            continue
        if not isinstance(method, METHODS):
            return f"{which}; use boundary.PathSpace(), or {smoother[4:]}"
    if moves.steps:
        path = scene.description.shapes[min(moves.steps)[0]].path
        for there, what in (
            (config.material_first, "interior.FilmAntithetic()"),
            (config.camera in c.METERS, "a sensor without a film"),
        ):
            if there:
                return f"steps of a texture of {path!r} slide, which is not known beside {what}; {smoother}"
    crowded = too_many(scene, listed - tubes) or too_many_on_tubes(scene, tubes)
    if crowded:
        return f"{crowded}; {smoother}"
    if moves.steps - tubes and (moves.camera or moves.shapes) and on_seams(scene, moves.steps - tubes):
        return (
            f"steps of a texture of {path!r} slide along a seam of its texture coordinates, while shapes or the camera "
            "move; request these in a call of their own"
        )
    laid = coincide(scene, moves.steps - tubes)
    if laid >= 0:
        laid_on = scene.description.shapes[laid].path
        return f"steps of two textures of {laid_on!r} lie on each other and slide; shift the to_uv of one a little"
    if slide_on_seams(scene, moves.steps & tubes):
        path = scene.description.shapes[min(moves.steps & tubes)[0]].path
        return (
            f"steps of a texture of {path!r} slide where angles start anew, or over a joint; shift its to_uv a little"
        )
    return ""


def _beside_tubes(config: PathConfig, method: Method) -> str:
    """Say where steps on tubes are not known; empty: they are."""
    if has_chain_lobes(config.surfaces.bsdfs, config.media is not None):
        return "curves beside smooth mirrors and glass"
    if config.media is not None:
        return "curves beside participating media"
    if config.camera in c.METERS or config.pulse:
        return "curves before a sensor without a film, or a transient one"
    return "" if isinstance(method, (PathSpace, Projective)) else f"curves by boundary.{type(method).__name__}()"
