"""Point, spot and directional lights behind masks and thin sheets, while something moves.

Shadow rays to such lights pass null lobes; to all other lights they do not, for paths find these behind them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from warp_psdr.kernels import constants as c
from warp_psdr.options.boundary import EdgeSampling, Method, PathSpace, Projective
from warp_psdr.options.interior import Replay
from warp_psdr.plan import media
from warp_psdr.scene.materials.bsdfs import model_of
from warp_psdr.topology.light_frames import has_hard_frame
from warp_psdr.topology.sheet_edges import creases_and_seams

if TYPE_CHECKING:
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.options import interior
    from warp_psdr.options.integrator import PathIntegrator
    from warp_psdr.scene.scene import Scene

#: Methods of the boundary term whose shadow rays to lights of no area pass sheets.
METHODS = (PathSpace, Projective, EdgeSampling)
#: Models whose null lobe weighs the same from all directions.
EVEN = ("mask", "null")


def passes(
    scene: Scene, config: PathConfig, integrator: PathIntegrator, method: interior.Method, names: list[str]
) -> bool:
    """Whether there are lights of no area, whose shadow rays pass what has a null lobe.

    Raises:
        ValueError: there are, and their derivatives beside what moves are not known; with what to do.
    """
    shapes, emitters = scene.description.shapes, zip(scene.description.emitters, scene.builder.emitters, strict=True)
    points = [e.path for e, record in emitters if record.kind in c.DELTA_LIGHTS]
    if not points:
        return False
    reason = _unknown(scene, config, integrator, method)
    if reason:
        sheet = next(s.path for s in shapes if any(media.lets_pass(scene, side) for side in s.bsdf.sides))
        raise ValueError(
            f"derivatives by {', '.join(names)}: path vertices or shadows move, light of {points[0]!r} passes shape "
            f"{sheet!r} without being turned, and {reason}; or make the light an area light, or say "
            "PathIntegrator(caustics=False), which leaves this light out of images and derivatives alike"
        )
    return True


def _unknown(scene: Scene, config: PathConfig, integrator: PathIntegrator, method: interior.Method) -> str:
    """Say what keeps shadow rays from passing sheets while something moves; empty: nothing."""
    b = scene.builder
    if not isinstance(method, Replay):
        return f"interior.{type(method).__name__}() does not follow it; use interior.Replay()"
    if isinstance(integrator.boundary, Method) and not isinstance(integrator.boundary, METHODS):
        return f"boundary.{type(integrator.boundary).__name__}() does not know it; use boundary.PathSpace()"
    if config.media is not None:
        return "that is not known beside participating media; leave these out"
    if config.surfaces.primitives:
        return "that is not known beside shapes without triangles; give them triangles"
    if config.pulse:
        return "that is not known before a transient film; use an hdrfilm"
    if any(e.kind == c.EMITTER_PROJECTOR and has_hard_frame(scene, e) for e in b.emitters):
        return "a projector's image ends in a hard edge there; give it a border of black texels"
    for i, shape in enumerate(scene.description.shapes):
        models = [model_of(side) for side in shape.bsdf.sides if model_of(side).has_null]
        if not models:
            continue
        if b.stepped.get(i):
            return f"a texture of {shape.path!r} has steps, whose shadows are not known; use a bilinear bitmap"
        creases, seams = creases_and_seams(scene)
        if creases[i] and any(model.plugin not in EVEN for model in models):
            return f"{shape.path!r} lets through another part of it on either side of its creases; give it normals"
        if seams[i] and c.READ_TEXCOORDS & {t.kind for t in map(b.textures.__getitem__, b.textures_of(b.shapes[i]))}:
            return f"the texture of {shape.path!r} jumps along a seam of its coordinates; split the mesh along the seam"
    return ""
