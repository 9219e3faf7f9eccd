"""Creases and smooth silhouettes of grids of signed distances between two path vertices."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.estimate.boundary.touching import Touched, guided_kernel
from warp_psdr.estimate.guiding.intervals import Listing, grid_names
from warp_psdr.kernels.boundary.silhouette.grid_points import GridItems
from warp_psdr.kernels.boundary.silhouette.secondary import make_secondary_silhouette_kernel
from warp_psdr.kernels.primitive.linear_grid import LINEAR_GRID
from warp_psdr.options.boundary import PathSpace
from warp_psdr.plan.motion import moving_shapes
from warp_psdr.scene.kinds.zero_set import ZeroSet
from warp_psdr.topology.grid_silhouettes import grid_items, grid_shapes, light_eyes, only

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Samples over the interior's (``docs/theory/implicit.md#shares-of-the-samples``) where single values move the surface.
SHARE_OF_VALUES = 5.0 / 16.0
#: Share of the segments whose direction is drawn for the item they touch instead of towards a light, at most.
OWN_SHARE = 0.25


def applies(r: Request) -> bool:
    """Whether light is scattered beside grids, and anything moves."""
    return LINEAR_GRID.number in r.config.primitives and r.lit and r.moves.edges and r.scatters_smoothly


def launch_segments(r: Request, term: BoundaryTerm, cubic: bool) -> Term | None:
    """Return the term of linear grids, or of cubic ones."""
    eyes = light_eyes(r.scene)
    found = grid_items(r.scene, grid_shapes(r.scene, cubic), eyes)
    return launch_items(r, term, found if r.creases is None else only(found, r.creases), eyes == [], cubic)


def launch_items(
    r: Request, term: BoundaryTerm, found: GridItems | None, unlit: bool, cubic: bool, network: bool = False
) -> Term | None:
    """Return the term of items; ``unlit``: there is no light to aim at."""
    if found is None:
        return None
    found.share = 1.0 if found.aimed == 0 or unlit else min(r.own_share, OWN_SHARE)

    def make(role: str, camera_moves: bool, light_pose: bool, guided: bool) -> wp.Kernel:
        family = "network" if network else "cubic" if cubic else "grid"
        return make_secondary_silhouette_kernel(r.config, role, camera_moves, light_pose, family, guided, r.indirect)

    listed = _listed(r.scene, found) if getattr(r.method, "guiding", None) is not None else {}
    head = [r.scene.data(), r.camera, found, moving_shapes(r.scene, r.moves)]
    touched = Touched(record=found, listed=listed, unlit=found.share == 1.0)
    kernel, guide = guided_kernel(r, term.name, make, head, found.items.shape[0], touched=touched)
    share = SHARE_OF_VALUES if r.moves.values else 1.0
    samples = math.ceil(r.pixels * (r.method.spp_secondary or r.spp) * share)
    return term_of(r, term, kernel, [*head, guide], samples)


def _listed(scene: Scene, found: GridItems) -> dict[str, Listing]:
    """Return the items of either technique."""
    items = found.items.numpy()
    nodes = {
        int(record): _nodes(scene, scene.builder.primitives[record - scene.face_count]) for record in set(items[:, 0])
    }
    names = grid_names(items, nodes)
    return {t: Listing(names[:n], np.ones(n)) for t, n in (("wedge", len(names)), ("light", found.aimed))}


def _nodes(scene: Scene, shape: int) -> tuple[int, int]:
    """Return the numbers of nodes of a grid, or of a network's cells, along x and y."""
    geometry = scene.geometry(shape)
    assert isinstance(geometry, ZeroSet)
    return geometry.nodes[0], geometry.nodes[1]


def launch(r: Request) -> Term | None:
    """Return the term of the silhouettes between two path vertices, neither of which need be on what moves."""
    return launch_segments(r, TERM, False)


TERM = BoundaryTerm(
    name="secondary_grid",
    title="{} silhouettes of grids",
    stream=14,
    methods=(PathSpace,),
    launch=launch,
    applies=applies,
    splits=True,
    guided=True,
    exact=True,
    part="both",
    recorded="secondary",
)
