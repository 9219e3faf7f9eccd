"""Silhouettes and open ends of curves with a radius between two path vertices."""

from __future__ import annotations

import math

import numpy as np
import warp as wp

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.estimate.boundary.touching import Touched, guided_kernel
from warp_psdr.estimate.guiding.intervals import Listing, curve_names
from warp_psdr.estimate.guiding.structure import TECHNIQUES
from warp_psdr.kernels.boundary.silhouette.secondary import make_secondary_silhouette_kernel
from warp_psdr.kernels.primitive.curve_kinds import CURVES
from warp_psdr.options.boundary import PathSpace
from warp_psdr.plan.motion import moving_shapes
from warp_psdr.topology.tubes import curve_shapes, tube_items

#: Samples over the interior's (``docs/theory/implicit.md#shares-of-the-samples``) where control points move the
#: surface.
SHARE_OF_VALUES = 1.0 / 6.0


def applies(r: Request) -> bool:
    """Whether light is scattered beside curves, and anything moves."""
    return bool(set(CURVES) & set(r.config.primitives)) and r.lit and r.moves.edges and r.scatters_smoothly


def launch(r: Request) -> Term | None:
    """Return the term of the silhouettes between two path vertices, neither of which need be on what moves."""
    found = tube_items(r.scene, curve_shapes(r.scene), creases=False)
    if found is None:
        return None
    found.share = r.own_share

    def make(role: str, camera_moves: bool, light_pose: bool, guided: bool) -> wp.Kernel:
        return make_secondary_silhouette_kernel(r.config, role, camera_moves, light_pose, "tubes", guided, r.indirect)

    listed = {}
    if getattr(r.method, "guiding", None) is not None:
        listed = dict.fromkeys(TECHNIQUES, Listing(curve_names(found.items.numpy()), np.diff(found.cdf.numpy())))
    head = [r.scene.data(), r.camera, found, moving_shapes(r.scene, r.moves)]
    touched = Touched(record=found, listed=listed)
    kernel, guide = guided_kernel(r, TERM.name, make, head, found.items.shape[0], touched=touched)
    share = SHARE_OF_VALUES if r.moves.values else 1.0
    samples = math.ceil(r.pixels * (r.method.spp_secondary or r.spp) * share)
    return term_of(r, TERM, kernel, [*head, guide], samples)


TERM = BoundaryTerm(
    name="secondary_tubes",
    title="{} silhouettes of curves",
    stream=19,
    methods=(PathSpace,),
    launch=launch,
    applies=applies,
    splits=True,
    guided=True,
    exact=True,
    part="smooth",
    recorded="secondary",
)
