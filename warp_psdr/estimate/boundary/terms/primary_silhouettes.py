"""Silhouettes, rims and creases of shapes without triangles that the camera sees: one term a family of shapes."""

from __future__ import annotations

import functools
import math

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.silhouette.primary import make_primary_silhouette_kernel
from warp_psdr.options.words import words
from warp_psdr.topology.absent import there
from warp_psdr.topology.kinds.family import Family, Shares
from warp_psdr.topology.kinds.table import FAMILIES


def applies(family: Family, r: Request) -> bool:
    """Whether there are shapes of a family, and they or the camera move."""
    return family.is_in(r.config.surfaces.primitives) and bool(r.moves.shapes or r.moves.camera)


def samples_of(r: Request, shares: Shares) -> int:
    """Return how many samples a term of what the camera sees has."""
    share = shares.values if r.moves.values else shares.pose
    return math.ceil(r.pixels * (r.method.spp_primary or r.spp) * share)


def moving(family: Family, r: Request) -> list[int]:
    """Return the shapes of a family whose images may move."""
    shapes = there(r.scene, family.shapes(r.scene))
    return [i for i in shapes if r.moves.camera or i in r.moves.shapes]


def launch(family: Family, r: Request) -> Term | None:
    """Return the term of the silhouettes that the camera sees."""
    shapes = moving(family, r)
    if not shapes:
        return None
    family.require_uncut(r.scene, r.sensor, shapes)
    found = family.seen(r.scene, shapes, r.sensor, r.creases)
    if found is None:
        return None
    kernel = make_primary_silhouette_kernel(r.config, r.role, r.moves.camera, family.touch)
    head = [r.scene.data(), r.camera, found]
    return term_of(r, TERMS[family.touch], kernel, head, samples_of(r, family.primary))


def _term(family: Family) -> BoundaryTerm:
    return BoundaryTerm(
        name=f"primary_{family.term}",
        title=f"primary silhouettes of {family.title}",
        stream=family.streams.primary,
        methods=family.methods,
        launch=functools.partial(launch, family),
        applies=functools.partial(applies, family),
        knows=words("material_points", "slides", *(["media"] if family.in_media else [])),
        part="both" if family.both else "smooth",
        recorded="primary",
    )


#: Family, by its touch -> its term.
TERMS: dict[str, BoundaryTerm] = {family.touch: _term(family) for family in FAMILIES}
