"""Steps of textures that move against the points that read them.

A path's points ride on their triangles, and the steps with them, but for the points that a ray with a fixed start
finds: those that the camera sees, and those behind smooth mirrors and glass. ``to_uv`` and texture coordinates slide
steps over their surface, at every vertex.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from warp_psdr.kernels import constants as c
from warp_psdr.kernels.bsdf.dispatch import has_delta_lobes
from warp_psdr.options.boundary import EdgeSampling, Method, PathSpace, Projective
from warp_psdr.plan.motion import motion, seen_steps
from warp_psdr.scene.layout import TEXCOORDS
from warp_psdr.topology.texture_steps import too_many

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
    seen = seen_steps(scene, config, moves)
    if has_delta_lobes(config.surfaces.bsdfs) and config.media is None and not config.material_first:
        seen |= {(i, t) for i, textures in scene.builder.stepped().items() for t in textures}
    if not seen:
        return ""
    shape = min(seen)[0]
    which = f"a texture of {scene.description.shapes[shape].path!r} has steps, which move"
    smoother = "use a bilinear bitmap, a trilinear volume or a vertex attribute"
    if any(scene.builder.textures[t].kind == c.TEXTURE_GRID for _shape, t in seen):
        return f"{which}, and those of a 'gridvolume' are not known; {smoother}"
    if not isinstance(method, METHODS):
        return f"{which}; use boundary.PathSpace(), or {smoother[4:]}"
    if moves.steps:
        for there, what in (
            (config.material_first, "interior.FilmAntithetic()"),
            (config.media is not None, "participating media"),
            (config.camera in c.METERS, "a sensor without a film"),
        ):
            if there:
                return f"{which} over the surface, which is not known beside {what}; {smoother}"
    crowded = too_many(scene, seen)
    return f"{crowded}; {smoother}" if crowded else ""
