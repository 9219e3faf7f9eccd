"""Light that curves with a radius send past silhouettes and beside joints to path vertices other than the camera."""

from __future__ import annotations

import math

from warp_psdr.estimate.boundary.terms import secondary_tubes
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.silhouette.foreground import make_foreground_kernel
from warp_psdr.options.boundary import PathSpace
from warp_psdr.plan.motion import moving_shapes
from warp_psdr.topology.tubes import curve_shapes, tube_items

#: Vertices of the shortest path: x_1, one on a curve, and one on a light.
SHORTEST = 3
#: Samples over the interior's (``docs/theory/implicit.md#shares-of-the-samples``): where control points move the
#: surface, and where a pose or the camera does.
SHARE_OF_VALUES, SHARE = 1.0 / 16.0, 1.0 / 3.0


def applies(r: Request) -> bool:
    """Whether paths are long enough for light that is scattered by a curve and then by another surface."""
    return secondary_tubes.applies(r) and not 0 <= r.plan.max_depth < SHORTEST


def launch(r: Request) -> Term | None:
    """Return the term of what curves send beside their discontinuities."""
    found = tube_items(r.scene, curve_shapes(r.scene), creases=True)
    if found is None:
        return None
    kernel = make_foreground_kernel(r.config, r.role, r.moves.camera, "tubes")
    share = SHARE_OF_VALUES if r.moves.values else SHARE
    samples = math.ceil(r.pixels * (r.method.spp_secondary or r.spp) * share)
    return term_of(r, TERM, kernel, [r.scene.data(), r.camera, found, moving_shapes(r.scene, r.moves)], samples)


TERM = BoundaryTerm(
    name="foreground_tubes",
    title="silhouettes of curves, in front",
    stream=20,
    methods=(PathSpace,),
    launch=launch,
    applies=applies,
    exact=True,
    part="smooth",
    recorded="secondary",
)
