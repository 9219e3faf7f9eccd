"""The list of all boundary terms; each kind of discontinuity declares itself in a file of its own.

A new kind of edge is a file with a ``BoundaryTerm`` and its place in ``ALL``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import warp as wp

from warp_psdr.estimate.boundary.terms import (
    creases,
    creases_grid,
    edge_sampling,
    film_border,
    film_crossing,
    flat_creases,
    foreground_silhouettes,
    geometric_horizon,
    grid_horizon,
    grid_indirect_terminator,
    grid_light_horizon,
    grid_terminator,
    hard_shadows,
    indirect_terminator,
    intersection_curve,
    media_edge_sampling,
    media_secondary,
    path_warped_area,
    primary,
    primary_silhouettes,
    secondary,
    secondary_silhouettes,
    shaded_grid,
    terminator,
    texture_steps,
    through_mirrors,
    vertex_crossing,
)
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term
from warp_psdr.estimate.guiding import store
from warp_psdr.kernels.constants import METERS
from warp_psdr.options.boundary import (
    EdgeSampling,
    FilmEdges,
    Method,
    NeuralSignedDistance,
    PathSpace,
    PathWarpedArea,
    Projective,
    Rotation,
    SignedDistance,
    WarpedArea,
)
from warp_psdr.plan.motion import motion
from warp_psdr.topology.kinds.tubes import TUBES
from warp_psdr.topology.unchanged import at_rest

if TYPE_CHECKING:
    from warp_psdr.plan.plan import Plan
    from warp_psdr.scene.scene import Scene

#: All terms, in the order in which they are estimated.
ALL: tuple[BoundaryTerm, ...] = (
    primary.TERM,
    *primary_silhouettes.TERMS.values(),
    creases_grid.TERM,
    grid_terminator.TERM,
    flat_creases.TERM,
    creases.TERM,
    terminator.TERM,
    secondary.TERM,
    *(term for touch, term in secondary_silhouettes.TERMS.items() if touch != TUBES.touch),
    *(term for touch, term in foreground_silhouettes.TERMS.items() if touch != TUBES.touch),
    shaded_grid.TERM,
    grid_indirect_terminator.TERM,
    grid_horizon.TERM,
    grid_light_horizon.TERM,
    *media_secondary.TERMS.values(),
    secondary_silhouettes.TERMS[TUBES.touch],
    foreground_silhouettes.TERMS[TUBES.touch],
    edge_sampling.TERM,
    media_edge_sampling.TERM,
    *hard_shadows.TERMS.values(),
    *intersection_curve.TERMS.values(),
    film_crossing.TERM,
    *vertex_crossing.TERMS.values(),
    indirect_terminator.TERM,
    *geometric_horizon.TERMS.values(),
    through_mirrors.TERM,
    *texture_steps.TERMS.values(),
    path_warped_area.TERM,
    film_border.TERM,
)
#: The methods that have terms.
METHODS = (
    PathSpace,
    Projective,
    EdgeSampling,
    SignedDistance,
    NeuralSignedDistance,
    WarpedArea,
    PathWarpedArea,
    Rotation,
    FilmEdges,
)
#: What each method consists of.
TERMS: dict[type[Method], tuple[BoundaryTerm, ...]] = {
    method: tuple(term for term in ALL if method in term.methods) for method in METHODS
}


def named(name: str) -> BoundaryTerm:
    """Return the term of a name."""
    return next(term for term in ALL if term.name == name)


def terms(scene: Scene, plan: Plan, names: list[str], role: str, sensor: int, spp: int, seed: int) -> list[Term]:
    """Return the launches that estimate the boundary term of the named parameters."""
    request = Request(scene, plan, motion(scene, names), role, sensor, spp, seed)
    kinds = _kinds(request)
    # Those that may build guiding, with kernels of their own, come last: all others are compiled meanwhile.
    with at_rest(scene):
        found = {term.name: launches(term, request) for term in sorted(kinds, key=lambda term: term.guided)}
    return [t for term in kinds for t in found[term.name]]


def _kinds(request: Request) -> tuple[BoundaryTerm, ...]:
    """Return the terms that a method consists of before a sensor and in a scene."""
    if request.config.camera in METERS:  # what is sampled on a film has measure zero on one ray
        return (edge_sampling.TERM,)
    return TERMS[type(request.method)]


def by_parts(scene: Scene, plan: Plan, names: list[str], sensor: int, spp: int, seed: int) -> dict[str, list[Term]]:
    """Return the launches of forward mode of "smooth" silhouettes, and those of "edges" and creases."""
    request = Request(scene, plan, motion(scene, names), "forward", sensor, spp, seed)
    found: dict[str, list[Term]] = {"smooth": [], "edges": []}
    for term in _kinds(request):
        for part, launched in found.items():
            if term.part == "both":
                launched += launches(term, replace(request, creases=part == "edges"))
            elif term.part == part:
                launched += launches(term, request)
    return found


def prepare(scene: Scene, plan: Plan, names: list[str], sensor: int) -> list[wp.Kernel]:
    """Return the kernels of the terms; those that build guiding are run once, and what they built is forgotten."""
    request = Request(scene, plan, motion(scene, names), "reverse", sensor, 1, 0)
    guiding = getattr(request.method, "guiding", None)
    fresh = [t.name for t in ALL if t.guided and guiding is not None and not store.built(request, guiding, t.name)]
    kernels = [term.kernel for term in terms(scene, plan, names, "reverse", sensor, 1, 0)]
    for name in fresh:
        assert guiding is not None
        store.forget(request, guiding, name)
    return kernels


def launches(term: BoundaryTerm, request: Request) -> list[Term]:
    """Return the launches of one of a method's terms, under its name; in media, of those that know them.

    What else a term does not know has been refused by the plan (``plan/discontinuities.py``).
    """
    known = "media" in term.knows or request.config.media is None
    found = term.launch(request) if known and term.applies(request) else None
    return [] if found is None else [replace(found, kind=term.name)]
