"""Participating media in the plan: what it prints of them, and the derivatives that it refuses."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.kernels import constants as c
from warp_psdr.kernels.bsdf.dispatch import has_chain_lobes, models_of
from warp_psdr.kernels.bsdf.null import NULL
from warp_psdr.kernels.medium.coefficients import ALBEDO, EMISSION, PHASE, POSE, SCALE, SIGMA_T
from warp_psdr.kernels.medium.volume import GRID
from warp_psdr.plan import primitives
from warp_psdr.plan.motion import motion, moves_in_media
from warp_psdr.scene.layout import MEDIUM, NORMALS, POSITIONS, SHAPE_GRID, SHAPE_POSE
from warp_psdr.scene.materials.bsdfs import model_of
from warp_psdr.topology.absent import absent_faces
from warp_psdr.topology.edges_there import edges_there, pierced
from warp_psdr.topology.interpolated_normals import interpolated_faces

if TYPE_CHECKING:
    from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.scene.description import BsdfDescription
    from warp_psdr.scene.scene import Scene

#: What of a medium is differentiated.
PARAMETERS = (SIGMA_T, ALBEDO, SCALE, EMISSION, PHASE, POSE)
PHASE_NAMES = {
    c.PHASE_ISOTROPIC: "isotropic",
    c.PHASE_HG: "hg",
    c.PHASE_RAYLEIGH: "rayleigh",
    c.PHASE_TABLE: "tabphase",
    c.PHASE_BLEND: "blendphase",
    c.PHASE_BLEND_GRID: "blendphase of a grid",
    c.PHASE_SGGX: "sggx",
    c.PHASE_SGGX_GRID: "sggx of a grid",
}


def describe(scene: Scene, config: PathConfig, wanted: GradientRequest | None) -> list[tuple[str, str, str]]:
    """Return the plan's lines on the media of a scene; none where there are none."""
    if config.media is None:
        return []
    bounds = sum(sides[0] != c.NO_INTERFACE for sides in scene.builder.sides)
    phases = ", ".join(PHASE_NAMES[kind] for kind in config.media.phases)
    of_grids = len(scene.builder.super_grids)
    kinds = ((len(scene.builder.media) - of_grids, "homogeneous"), (of_grids, "heterogeneous"))
    if c.PHASE_SGGX_GRID in config.media.phases:
        kinds = (kinds[0], (of_grids, "of an extinction that varies"))
    several = " and ".join(f"{count} {kind}" for count, kind in kinds if count)
    chromatic = "colours: one channel is drawn, all weigh" if config.media.chromatic else "grey: no channel is drawn"
    lines = [
        ("media", several, f"bounded by {bounds} shapes; null lobes do not count as depth, collisions do"),
        ("phase functions", phases, "those of the media"),
        ("extinction", "by channel" if config.media.chromatic else "grey", chromatic),
    ]
    if config.media.emissive:
        drawn = "; in grids at four points of each stretch" if of_grids else ""
        lines.append(("emission", "by media", f"of each stretch in closed form, without a draw{drawn}"))
    for grid in scene.builder.super_grids:
        voxels, cells = (" x ".join(str(n) for n in size) for size in (grid.voxels, grid.cells))
        tracked = f"majorants of {cells} cells; delta tracking, and ratio tracking for shadow rays"
        lines.append((f"grid {grid.parameter.removesuffix('.data')}", f"{voxels} voxels", tracked))
    for m, name in zip(scene.builder.media, scene.builder.medium_names, strict=True):
        if m.phase == c.PHASE_SGGX_GRID:
            g = scene.builder.textures[m.g]
            bound = "tracked with the largest projected area of all its voxels and directions"
            lines.append(
                (
                    f"grid {name}.phase_function.S",
                    f"{g.width} x {g.height} x {g.first} voxels",
                    f"extinction by place, {bound}",
                )
            )
    if wanted is not None:
        density = SIGMA_T in wanted.media or SCALE in wanted.media
        forced = "some flights are made to collide, for where the density is zero" if density else "density: no"
        if density and of_grids:
            forced += " (in grids when a clock rings, points on each stretch for its transmittance)"
        lines.append(("media derivatives", ", ".join(wanted.media) or "none", forced))
    return lines


def weighs(config: PathConfig) -> bool:
    """Whether light passes surfaces that are path vertices: in media masks and thin glass, elsewhere ``null``, too."""
    absent = NULL if config.media is not None else None
    return any(model.has_null and model is not absent for model in models_of(config.surfaces.bsdfs))


def lets_pass(scene: Scene, bsdf: BsdfDescription) -> bool:
    """Whether it is a material of such surfaces."""
    return model_of(bsdf).has_null and not (scene.builder.media and model_of(bsdf) is NULL)


def beside_motion(scene: Scene, config: PathConfig, wanted: GradientRequest | None) -> str:
    """Say what of a scene with media has no derivative by what moves; empty: all has."""
    if config.media is None or wanted is None or not moves_in_media(wanted):
        return ""
    solid = _unfollowed_solid(scene, config)
    if solid:
        return solid
    flakes = _microflakes(scene)
    if flakes:
        return f"what moves is not followed through {flakes}"
    stepped = _stepped_grid(scene)
    if stepped:
        return f"the voxels of {stepped!r} are 'nearest', so that it jumps along them; make its filter 'trilinear'"
    if c.EMITTER_DIRECTIONAL_AREA in config.lights.others:
        return "what moves is not followed to a 'directionalarea' beside media; use a 'directional' or an 'area' light"
    for shape in scene.description.shapes:
        if shape.emitter is not None and any(model_of(side) is NULL for side in shape.bsdf.sides):
            return f"the light {shape.path!r} has a surface that is not there; give it another bsdf than 'null'"
    return ""


def _unfollowed_solid(scene: Scene, config: PathConfig) -> str:
    """Say beside which shape without triangles nothing that moves is followed in media, and what to do; empty: none."""
    words = primitives.words_of(scene)
    if "slides" in words:
        solid = words["slides"]
        return f"what moves beside media is not followed where there is {solid.what}; {solid.instead}"
    if "material_points" not in words:
        return ""
    solid = words["material_points"]
    if has_chain_lobes(config.surfaces.bsdfs, True):
        return (
            f"what moves beside media is not followed in mirrors, glass and masks where there is {solid.what}; make "
            f"them rough, or {solid.instead}"
        )
    return ""


def _microflakes(scene: Scene) -> str:
    """Say which microflakes are not followed by what moves, and what to use; empty: there are none."""
    for m in scene.builder.media:
        if m.phase == c.PHASE_SGGX_GRID:
            return "a grid of 'S'; give 'sggx' one 'S', in a 'homogeneous' medium"
        if m.phase == c.PHASE_SGGX and m.sigma_t_channels == GRID:
            return "'sggx' in a 'heterogeneous' medium; make it 'homogeneous'"
        if m.phase == c.PHASE_SGGX and m.emission >= 0:
            return "'sggx' in a medium that emits light; leave 'emission' out"
    return ""


def _stepped_grid(scene: Scene) -> str:
    """Return the name of a grid of a medium that is not interpolated; empty: there is none."""
    names = {p.offset: name for name, p in scene.parameters.items()}
    b = scene.builder
    for m in b.media:
        if m.phase == c.PHASE_BLEND_GRID:
            g = b.textures[b.textures[m.g].offset]
            if g.filter == c.FILTER_NEAREST and g.width * g.height * g.first > 1:
                return names[g.offset]
        volumes = ((m.sigma_t, m.sigma_t_channels), (m.albedo, m.albedo_channels), (m.emission, m.emission_channels))
        for number, channels in volumes:
            if channels == GRID and m.sigma_t_channels == GRID:
                g = b.textures[number]
                if g.filter == c.FILTER_NEAREST and g.width * g.height * g.first > 1:
                    return names[g.offset]
    return ""


def refused(scene: Scene, config: PathConfig, names: list[str]) -> str:
    """Say what of a scene keeps the boundary term from being estimated; empty: nothing."""
    if config.media is None:
        return ""
    if config.media.emissive:
        bent = interpolated_faces(scene) & ~absent_faces(scene)
        if bent.any():
            shape = scene.description.shapes[scene.builder.face_shape[np.flatnonzero(bent)[0]]]
            return f"media that emit light do not know interpolated normals, as {shape.path!r} has; give face_normals"
    points = c.DELTA_LIGHTS & set(config.lights.others)
    if points and has_chain_lobes(config.surfaces.bsdfs, True):
        lights = zip(scene.description.emitters, scene.builder.emitters, strict=True)
        light = next(e.path for e, record in lights if record.kind in points)
        return (
            f"{light!r} is a light of no area, whose hard shadows in media are not searched for through mirrors, glass "
            "and masks; make it an area light"
        )
    met = pierced(scene, set(motion(scene, names).shapes)) if has_chain_lobes(config.surfaces.bsdfs, True) else ""
    return f"{met}, along a curve that moves, beside mirrors or glass; move them apart, by a little" if met else ""


def moves_media_alone(scene: Scene, name: str) -> bool:
    """Whether a parameter moves a grid, or shapes that are surfaces which are not there: they hide nothing."""
    parameter = scene.parameters[name]
    if MEDIUM + POSE in parameter.uses:
        return True
    if not scene.builder.media or not parameter.uses & {POSITIONS, SHAPE_GRID, SHAPE_POSE, NORMALS}:
        return False
    described = [scene.description.shapes[i] for i in parameter.owners]
    return all(model_of(side) is NULL for shape in described for side in shape.bsdf.sides)


def hides(scene: Scene) -> bool:
    """Whether anything casts shadows in a medium."""
    return len(edges_there(scene).length) > 0
