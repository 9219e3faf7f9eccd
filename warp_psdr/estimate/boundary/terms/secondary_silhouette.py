"""Smooth silhouettes and rims of shapes without triangles between two path vertices."""

from __future__ import annotations

import warp as wp

from warp_psdr.estimate.boundary import projective
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.estimate.boundary.touching import Touched, guided_kernel
from warp_psdr.kernels.boundary.silhouette.exact_touch import OutlineItems
from warp_psdr.kernels.boundary.silhouette.secondary import make_secondary_silhouette_kernel
from warp_psdr.kernels.primitive.table import affine_of
from warp_psdr.options.boundary import PathSpace, Projective
from warp_psdr.plan.motion import moving_shapes
from warp_psdr.topology.joined_rims import outlines


def applies(r: Request) -> bool:
    """Whether light is scattered beside such shapes, and anything moves."""
    return bool(affine_of(r.config.primitives)) and r.lit and r.moves.edges and r.scatters_smoothly


def launch(r: Request) -> Term | None:
    """Return the term of the silhouettes between two path vertices, neither of which need be on a shape that moves."""
    found = outlines(r.scene, None)
    if found is None:
        return None
    items = OutlineItems()
    items.items, items.share = found, r.own_share
    seeds = None
    if isinstance(r.method, Projective):
        if r.method.guiding is None:
            items.share = projective.uniform_share(r)
        else:
            seeds = projective.exact_asker(r, items)
    head = [r.scene.data(), r.camera, items, moving_shapes(r.scene, r.moves)]

    def make(role: str, camera_moves: bool, light_pose: bool, guided: bool) -> wp.Kernel:
        return make_secondary_silhouette_kernel(r.config, role, camera_moves, light_pose, "exact", guided, r.indirect)

    kernel, guide = guided_kernel(r, TERM.name, make, head, found.shape[0], touched=Touched(seeds=seeds))
    return term_of(r, TERM, kernel, [*head, guide], r.pixels * (r.method.spp_secondary or r.spp))


TERM = BoundaryTerm(
    name="secondary_silhouette",
    title="{} silhouettes of exact shapes",
    stream=10,
    methods=(PathSpace, Projective),
    launch=launch,
    applies=applies,
    splits=True,
    guided=True,
    exact=True,
    part="smooth",
    recorded="secondary",
)
