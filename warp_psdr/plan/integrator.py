"""The integrator of a call: the given one, in whatever form, or that of the scene's file."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

from warp_psdr.options.integrator import AovIntegrator, Integrator, PathIntegrator
from warp_psdr.options.interior import LightTracing
from warp_psdr.scene.files.dictionary import describe_integrator
from warp_psdr.scene.load import SceneWarning

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene


def integrator_of(scene: Scene, integrator: Integrator | None) -> PathIntegrator:
    """Return the integrator that is given, else the one that the scene's file names.

    Raises:
        TypeError: what is given is none.
        ValueError: Mitsuba's dictionary, or name, of a plugin or with a parameter that is not supported.

    Warns:
        SceneWarning: a parameter of the dictionary is ignored.
    """
    if integrator is None:
        return from_description(scene.description.integrator)
    if isinstance(integrator, AovIntegrator):
        return integrator.as_path()
    if isinstance(integrator, PathIntegrator):
        return integrator
    if isinstance(integrator, str):
        integrator = {"type": integrator}
    if not isinstance(integrator, dict):
        raise TypeError(
            f"integrator: got {integrator!r}, expected a psdr.PathIntegrator or AovIntegrator, a dictionary such as "
            "{'type': 'path', 'max_depth': 4}, or 'path'"
        )
    described, notes = describe_integrator(integrator)
    for note in notes:
        warnings.warn(note, SceneWarning, stacklevel=4)
    return from_description(described)


def from_description(integrator: dict) -> PathIntegrator:
    """Return the integrator that a scene file names, or the default one.

    Raises:
        ValueError: it computes no image.
    """
    if integrator.get("type") == "aov":
        raise ValueError(
            "integrator: 'aov' without a nested integrator computes no image; call psdr.render_aov(scene), or pass "
            "integrator='path'"
        )
    known = {k: integrator[k] for k in ("max_depth", "rr_depth", "hide_emitters") if k in integrator}
    if integrator.get("type") == "ptracer":
        return PathIntegrator(**known, interior=LightTracing())
    return PathIntegrator(**known)
