"""Silhouettes, rims and creases of shapes without triangles between two path vertices: one term a family of shapes."""

from __future__ import annotations

import functools
import math

import warp as wp

from warp_psdr.estimate.boundary import projective
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.estimate.boundary.touching import Touched, guided_kernel
from warp_psdr.estimate.guiding.intervals import Listing
from warp_psdr.kernels.boundary.silhouette.secondary import make_secondary_silhouette_kernel
from warp_psdr.options.boundary import Projective
from warp_psdr.options.words import words
from warp_psdr.plan.motion import moving_shapes
from warp_psdr.topology.kinds.family import Family, Shares
from warp_psdr.topology.kinds.table import FAMILIES


def applies(family: Family, r: Request) -> bool:
    """Whether light is scattered beside shapes of a family, and anything moves."""
    return family.is_in(r.config.surfaces.primitives) and r.lit and r.moves.edges and r.scatters_smoothly


def samples_of(r: Request, shares: Shares) -> int:
    """Return how many samples a term of segments between path vertices has."""
    share = shares.values if r.moves.values else shares.pose
    return math.ceil(r.pixels * (r.method.spp_secondary or r.spp) * share)


def launch(family: Family, r: Request) -> Term | None:
    """Return the term of the silhouettes between two path vertices, neither of which need be on a shape that moves."""
    found = family.touched(r.scene, r.own_share, r.creases)
    if found is None:
        return None
    guiding, seeds, listed = getattr(r.method, "guiding", None), None, {}
    if isinstance(r.method, Projective):  # exact shapes alone
        if guiding is None:
            found.share = projective.uniform_share(r)
        else:
            seeds = projective.exact_asker(r, found)
    if guiding is not None:
        listed = {technique: Listing(*masses) for technique, masses in family.masses(r.scene, found).items()}
    head = [r.scene.data(), r.camera, found, moving_shapes(r.scene, r.moves)]

    def make(role: str, camera_moves: bool, light_pose: bool, guided: bool) -> wp.Kernel:
        options = (family.touch, guided, r.indirect)
        return make_secondary_silhouette_kernel(r.config, role, camera_moves, light_pose, *options)

    term = TERMS[family.touch]
    touched = Touched(record=found, listed=listed, seeds=seeds, unlit=found.share == 1.0)
    kernel, guide = guided_kernel(r, term.name, make, head, found.items.shape[0], touched=touched)
    return term_of(r, term, kernel, [*head, guide], samples_of(r, family.secondary))


def _term(family: Family) -> BoundaryTerm:
    return BoundaryTerm(
        name=f"secondary_{family.term}",
        title=f"{{}} silhouettes of {family.title}",
        stream=family.streams.secondary,
        methods=family.methods,
        launch=functools.partial(launch, family),
        applies=functools.partial(applies, family),
        splits=True,
        guided=True,
        knows=words("material_points", "slides"),
        part="both" if family.both else "smooth",
        recorded="secondary",
    )


#: Family, by its touch -> its term.
TERMS: dict[str, BoundaryTerm] = {family.touch: _term(family) for family in FAMILIES}
