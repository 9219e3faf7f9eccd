"""Light that shapes without triangles send past their silhouettes to path vertices other than the camera.

Points of grids, networks and curves slide along the rays that find them; there is one term a family of such shapes.
"""

from __future__ import annotations

import functools
from typing import Any

from warp_psdr.estimate.boundary.terms import secondary_silhouettes
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.silhouette.foreground import make_foreground_kernel
from warp_psdr.kernels.primitive.dispatch import has_flow
from warp_psdr.options.words import words
from warp_psdr.plan.motion import moving_shapes
from warp_psdr.topology.kinds.family import Family, Shares
from warp_psdr.topology.kinds.table import FAMILIES

#: Vertices of the shortest path: x_1, one on such a shape, and one on a light.
SHORTEST = 3


def applies(family: Family, r: Request) -> bool:
    """Whether paths are long enough for light that is scattered by a shape and then by another surface."""
    if not secondary_silhouettes.applies(family, r) or 0 <= r.plan.max_depth < SHORTEST:
        return False
    # It is a part of form S: vertices that flow along normals have none.
    return not (family.flows and has_flow(r.config.surfaces.primitives))


def launch_items(r: Request, term: BoundaryTerm, touch: str, found: Any, shares: Shares) -> Term | None:
    """Return the term of some items (None: there are none) of a touch."""
    if found is None:
        return None
    kernel = make_foreground_kernel(r.config, r.role, r.moves.camera, touch)
    head = [r.scene.data(), r.camera, found, moving_shapes(r.scene, r.moves)]
    return term_of(r, term, kernel, head, secondary_silhouettes.samples_of(r, shares))


def launch(family: Family, r: Request) -> Term | None:
    """Return the term of what shapes send beside their silhouettes."""
    return launch_items(r, TERMS[family.touch], family.touch, family.fronts(r.scene, r.creases), family.foreground)


def _term(family: Family, stream: int) -> BoundaryTerm:
    return BoundaryTerm(
        name=f"foreground_{family.term}",
        title=f"silhouettes of {family.title}, in front",
        stream=stream,
        methods=family.methods,
        launch=functools.partial(launch, family),
        applies=functools.partial(applies, family),
        knows=words("material_points", "slides"),
        part="both" if family.both else "smooth",
        recorded="secondary",
    )


#: Family, by its touch -> its term.
TERMS: dict[str, BoundaryTerm] = {
    family.touch: _term(family, family.streams.foreground)
    for family in FAMILIES
    if family.streams.foreground is not None
}
