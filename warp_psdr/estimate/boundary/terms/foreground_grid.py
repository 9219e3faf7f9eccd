"""Light that grids of signed distances send past their silhouettes to path vertices other than the camera."""

from __future__ import annotations

import math

import warp as wp

from warp_psdr.estimate.boundary.terms import secondary_grid
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.silhouette.foreground import make_foreground_kernel
from warp_psdr.kernels.boundary.silhouette.grid_points import GridItems
from warp_psdr.kernels.primitive.dispatch import has_flow
from warp_psdr.options.boundary import PathSpace
from warp_psdr.plan.motion import moving_shapes
from warp_psdr.topology.grid_silhouettes import grid_items, grid_shapes, only

#: Vertices of the shortest path: x_1, one on a grid, and one on a light.
SHORTEST = 3
#: Samples over the interior's (``docs/theory/implicit.md#shares-of-the-samples``) of silhouettes, and of creases: where
#: single values move the surface, and where a pose or the camera does.
SHARE_OF_VALUES, SHARE = 1.0 / 16.0, 1.0 / 4.0
SHADING_SHARE_OF_VALUES, SHADING_SHARE = 1.0 / 24.0, 1.0 / 8.0


def applies(r: Request) -> bool:
    """Whether paths are long enough for light that is scattered by a grid and then by another surface."""
    return secondary_grid.applies(r) and not 0 <= r.plan.max_depth < SHORTEST


def slides(r: Request) -> bool:
    """The same of smooth surfaces, where it is a part of form S: vertices that flow along normals have none."""
    return not 0 <= r.plan.max_depth < SHORTEST and not has_flow(r.config.primitives)


def launch_foreground(r: Request, term: BoundaryTerm, shading: bool, cubic: bool = False) -> Term | None:
    """Return the term of silhouettes, or with ``shading`` of creases that are seen from the front."""
    kernel = make_foreground_kernel(
        r.config, r.role, r.moves.camera, "grid creases" if shading else "cubic" if cubic else "grid"
    )
    found = grid_items(r.scene, grid_shapes(r.scene, cubic), [], concave=shading)
    found = found if r.creases is None else only(found, r.creases)
    return launch_items(r, term, kernel, found, shading)


def launch_items(
    r: Request, term: BoundaryTerm, kernel: wp.Kernel, found: GridItems | None, shading: bool = False
) -> Term | None:
    """Return the term of items; ``shading``: of creases that are seen from the front."""
    if found is None:
        return None
    of_values, of_pose = (SHADING_SHARE_OF_VALUES, SHADING_SHARE) if shading else (SHARE_OF_VALUES, SHARE)
    head = [r.scene.data(), r.camera, found, moving_shapes(r.scene, r.moves)]
    return launch_with(r, term, kernel, head, of_values if r.moves.values else of_pose)


def launch_with(r: Request, term: BoundaryTerm, kernel: wp.Kernel, head: list, share: float) -> Term:
    """Return the term of a kernel with a share of the samples of segments between path vertices."""
    samples = math.ceil(r.pixels * (r.method.spp_secondary or r.spp) * share)
    return term_of(r, term, kernel, head, samples)


def launch(r: Request) -> Term | None:
    """Return the term of what a grid sends beside its silhouettes."""
    return launch_foreground(r, TERM, False)


TERM = BoundaryTerm(
    name="foreground_grid",
    title="silhouettes of grids, in front",
    stream=15,
    methods=(PathSpace,),
    launch=launch,
    applies=applies,
    exact=True,
    part="both",
    recorded="secondary",
)
