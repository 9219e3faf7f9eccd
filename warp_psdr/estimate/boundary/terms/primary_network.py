"""Smooth silhouettes of networks of signed distances that the camera sees."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms import primary_grid
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term
from warp_psdr.kernels.boundary.silhouette.primary import make_primary_silhouette_kernel
from warp_psdr.kernels.primitive.network_kind import NETWORK
from warp_psdr.options.boundary import PathSpace
from warp_psdr.topology.grid_contacts import require_uncut_grids
from warp_psdr.topology.grid_silhouettes import camera_eyes
from warp_psdr.topology.network_silhouettes import network_items, network_shapes


def applies(r: Request) -> bool:
    """Whether there are networks, and they or the camera move."""
    return NETWORK.number in r.config.primitives and bool(r.moves.shapes or r.moves.camera)


def launch(r: Request) -> Term | None:
    """Return the term of the silhouettes that the camera sees."""
    shapes = [i for i in network_shapes(r.scene) if r.moves.camera or i in r.moves.shapes]
    require_uncut_grids(r.scene, r.sensor, shapes)
    kernel = make_primary_silhouette_kernel(r.config, r.role, r.moves.camera, "network")
    return primary_grid.launch_items(r, TERM, kernel, network_items(r.scene, shapes, [camera_eyes(r.scene, r.sensor)]))


TERM = BoundaryTerm(
    name="primary_network",
    title="primary silhouettes of networks",
    stream=33,
    methods=(PathSpace,),
    launch=launch,
    applies=applies,
    exact=True,
    part="smooth",
    recorded="primary",
)
