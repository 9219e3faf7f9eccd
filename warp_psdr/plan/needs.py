"""What a scene and a request need, in words, and the one comparison of it with what methods know."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from warp_psdr.kernels import constants as c
from warp_psdr.kernels.bsdf.dispatch import has_chain_lobes, has_null_lobes, models_of, passing
from warp_psdr.kernels.phase.microflakes import has_flakes
from warp_psdr.options import boundary, interior
from warp_psdr.options.guiding import Grid
from warp_psdr.options.words import APART, NEVER, WORDS, Word
from warp_psdr.plan import primitives
from warp_psdr.plan.motion import moves_in_media, moves_vertices
from warp_psdr.plan.words import CAMERA_NAMES
from warp_psdr.scene.materials.texture_records import has_steps

if TYPE_CHECKING:
    from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
    from warp_psdr.kernels.vertex import PathConfig
    from warp_psdr.scene.scene import Scene

#: Lights from infinity besides skies.
FAR = (c.EMITTER_DIRECTIONAL, c.EMITTER_DIRECTIONAL_AREA)
#: What errors name in place of a method that does not know something: the first that knows it all.
INTERIOR = ((interior.Replay, "interior.Replay()"),)
BOUNDARY = tuple(
    (m, f"boundary.{m.__name__}()") for m in (boundary.PathSpace, boundary.Projective, boundary.EdgeSampling)
)


def needs(scene: Scene, config: PathConfig, wanted: GradientRequest | None) -> dict[str, Word]:
    """Return the words that a scene and a request have, in the order in which errors look at them."""
    media, lights = config.media, {*config.lights.others, *([c.EMITTER_AREA] if config.lights.area else [])}
    phases = set(media.phases) if media is not None else set()
    geometry, textures = wanted is not None and wanted.geometry, [] if config.shown else scene.builder.textures
    moving_media = media is not None and wanted is not None and moves_in_media(wanted)
    # Images and derivatives of what rests know all lobes beside media.
    looks = media is None or moving_media
    delta = looks and has_chain_lobes(config.surfaces.bsdfs, media is not None)
    rough, solids = passing(config.surfaces.bsdfs), primitives.words_of(scene)
    glass = WORDS["rough_glass"]._replace(what=f"the smooth lobe behind the surface of a {rough!r}")
    told = {**solids, "rough_glass": glass}
    there = {
        "media": media is not None,
        "microflakes": has_flakes(tuple(phases)),
        "blended_grids": c.PHASE_BLEND_GRID in phases,
        "emission": media is not None and media.emissive,
        "moving_media": moving_media,
        "density_grids": moving_media and media is not None and media.grids,
        "solids_in_media": media is not None and bool(solids),
        "material_points": "material_points" in solids,
        "slides": "slides" in solids,
        "moving_slides": "slides" in solids and geometry,
        "shining": bool(config.lights.shining),
        "transient": bool(config.pulse),
        "far_lights": bool(lights & {c.EMITTER_CONSTANT, c.EMITTER_ENVMAP, *FAR}),
        "null": delta and has_null_lobes(config.surfaces.bsdfs),
        "mirrors": delta,
        "moving_mirrors": delta and geometry,
        "moving_vertices": wanted is not None and moves_vertices(config, wanted),
        "rough_glass": bool(rough),
        "turned_normals": any(model.framed for model in models_of(config.surfaces.bsdfs)),
        "vertex_normals": config.surfaces.smooth and not scene.shades_flat,
        "steps": any(has_steps(t) or t.kind == c.TEXTURE_FACE for t in textures),
        "point_lights": config.scatter and bool(lights & c.DELTA_LIGHTS),
        "hide_emitters": config.lights.hide_emitters,
        "hidden_lights": config.rays.hidden,
        "material_first": config.material_first,
        "distortion": config.camera in c.DISTORTED_CAMERAS,
        **{name: CAMERA_NAMES[config.camera] == name for name in CAMERA_NAMES.values() if name in WORDS},
    }
    return {word: told.get(word, WORDS[word]) for word, holds in there.items() if holds}


def _of_guiding(needed: Mapping[str, Word], method: boundary.Method) -> dict[str, Word]:
    """Return what the guiding of a method of the boundary term needs."""
    guiding = getattr(method, "guiding", None)
    there = {
        "guided_bins": guiding is not None and "transient" in needed,
        "guided_by_photons": isinstance(guiding, Grid) and "media" in needed,
    }
    return {word: WORDS[word] for word, holds in there.items() if holds}


def unknown(
    method: interior.Method | boundary.Method,
    needed: Mapping[str, Word],
    others: tuple[tuple[type[interior.Method] | type[boundary.Method], str], ...],
    own: Mapping[str, Word] | None = None,
) -> str:
    """Say what of a scene a method does not know, and what to do, in words that follow it; empty: it knows all.

    Args:
        method: with the words that it knows.
        needed: what the scene and the request need.
        others: methods that may know more, with the expressions that ask for them.
        own: what its own options need besides.
    """
    every = {**needed, **(own or {})}
    lacking = next((word for word in every if word not in method.knows), None)
    if lacking is None:
        return ""
    what, instead = every[lacking]
    other = next((f"use {name}" for kind, name in others if needed.keys() <= kind.knows), "")
    return f"does not know {what}; {', or '.join(filter(None, (other, instead)))}"


def apart(needed: Mapping[str, Word], pairs: Mapping[str, frozenset[str]]) -> str:
    """Say which two words do not go together; empty: all do."""
    for word, others in pairs.items():
        other = next((o for o in needed if o in others), None) if word in needed else None
        if other is not None:
            return f"{needed[word].what} and {needed[other].what} are not known together; {needed[other].instead}"
    return ""


def refuse(method: interior.Method, needed: Mapping[str, Word], names: list[str]) -> None:
    """Raise for what an interior method, or any, does not know of a scene and a request.

    Raises:
        ValueError: with what to do instead.
    """
    asked = bool(names) or isinstance(method, interior.FROM_LIGHTS)
    lacking = unknown(method, needed, INTERIOR) if asked else ""
    reason = apart(needed, NEVER) or (lacking and f"interior.{type(method).__name__}() {lacking}")
    if reason:
        raise ValueError(f"derivatives by {', '.join(names)}: {reason}" if names else reason)


def unknown_to_boundary(method: boundary.Method, needed: Mapping[str, Word]) -> str:
    """Say what of a scene a method of the boundary term, or any, does not know; empty: it knows all."""
    lacking = unknown(method, needed, BOUNDARY, _of_guiding(needed, method))
    return (lacking and f"it {lacking}") or apart(needed, APART)
