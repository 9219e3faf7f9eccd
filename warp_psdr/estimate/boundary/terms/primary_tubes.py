"""Silhouettes, open ends and creases of curves with a radius that the camera sees."""

from __future__ import annotations

import math

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.silhouette.primary import make_primary_silhouette_kernel
from warp_psdr.kernels.primitive.curve_kinds import CURVES
from warp_psdr.options.boundary import PathSpace
from warp_psdr.topology.tube_contacts import require_uncut_tubes
from warp_psdr.topology.tubes import curve_shapes, tube_items

#: Samples over the interior's (``docs/theory/implicit.md#shares-of-the-samples``): where control points move the
#: surface, and where a pose or the camera does.
SHARE_OF_VALUES, SHARE = 1.0 / 6.0, 1.0 / 2.0


def applies(r: Request) -> bool:
    """Whether there are curves, and they or the camera move."""
    return bool(set(CURVES) & set(r.config.primitives)) and bool(r.moves.shapes or r.moves.camera)


def launch(r: Request) -> Term | None:
    """Return the term of what the camera sees of curves."""
    shapes = [i for i in curve_shapes(r.scene) if r.moves.camera or i in r.moves.shapes]
    if not shapes:
        return None
    require_uncut_tubes(r.scene, r.sensor, shapes)
    found = tube_items(r.scene, shapes, creases=True)
    if found is None:
        return None
    kernel = make_primary_silhouette_kernel(r.config, r.role, r.moves.camera, "tubes")
    share = SHARE_OF_VALUES if r.moves.values else SHARE
    samples = math.ceil(r.pixels * (r.method.spp_primary or r.spp) * share)
    return term_of(r, TERM, kernel, [r.scene.data(), r.camera, found], samples)


TERM = BoundaryTerm(
    name="primary_tubes",
    title="primary silhouettes of curves",
    stream=18,
    methods=(PathSpace,),
    launch=launch,
    applies=applies,
    exact=True,
    part="smooth",
    recorded="primary",
)
