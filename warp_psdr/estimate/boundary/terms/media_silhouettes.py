"""Shadows of exact shapes in media, which cut off light from surfaces and from points of the medium."""

from __future__ import annotations

import functools

import warp as wp

from warp_psdr.estimate.boundary import projective
from warp_psdr.estimate.boundary.terms import media_secondary
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.estimate.boundary.terms.secondary_silhouettes import samples_of
from warp_psdr.estimate.boundary.touching import Touched, guided_kernel
from warp_psdr.kernels.boundary.silhouette.media_secondary import make_media_secondary_silhouette_kernel
from warp_psdr.options.boundary import Projective
from warp_psdr.options.words import words
from warp_psdr.plan.motion import moving_shapes
from warp_psdr.topology.kinds.exact import EXACT
from warp_psdr.topology.kinds.family import Family


def applies(family: Family, r: Request) -> bool:
    """Whether there are shapes of a family, and anything that moves light past them."""
    return family.is_in(r.config.surfaces.primitives) and media_secondary.applies(r)


def launch(family: Family, r: Request) -> Term | None:
    """Return the term of the silhouettes and rims of what is there."""
    share = media_secondary.own_share(r)
    found = family.touched(r.scene, share, r.creases)
    if found is None:
        return None
    seeds = None
    if isinstance(r.method, Projective) and share < 1.0:
        if r.method.guiding is None:
            found.share = projective.uniform_share(r)
        else:
            seeds = projective.exact_asker(r, found)
    head = [r.scene.data(), r.camera, found, moving_shapes(r.scene, r.moves)]
    deep = r.plan.max_depth != 2

    def make(role: str, camera_moves: bool, light_pose: bool, guided: bool) -> wp.Kernel:
        moved = r.moves.grids and role != "target"
        options = (family.touch, deep, moved, guided)
        return make_media_secondary_silhouette_kernel(r.config, role, camera_moves, light_pose, *options)

    term = TERMS[family.touch]
    touched = Touched(record=found, seeds=seeds, unlit=share == 1.0)
    kernel, guide = guided_kernel(r, term.name, make, head, found.items.shape[0], touched=touched)
    return term_of(r, term, kernel, [*head, guide], samples_of(r, family.secondary))


def _term(family: Family, stream: int) -> BoundaryTerm:
    return BoundaryTerm(
        name=f"media_{family.term}",
        title=f"shadows of {family.title} in media",
        stream=stream,
        methods=family.methods,
        launch=functools.partial(launch, family),
        applies=functools.partial(applies, family),
        guided=True,
        knows=words("media", "material_points"),
        part="smooth",
    )


#: Family, by its touch -> its term.
TERMS: dict[str, BoundaryTerm] = {EXACT.touch: _term(EXACT, 68)}
