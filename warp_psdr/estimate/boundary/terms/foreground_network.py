"""Light that networks of signed distances send past their silhouettes to path vertices other than the camera."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms import foreground_grid, secondary_network
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term
from warp_psdr.kernels.boundary.silhouette.foreground import make_foreground_kernel
from warp_psdr.options.boundary import PathSpace
from warp_psdr.topology.network_silhouettes import network_items, network_shapes


def applies(r: Request) -> bool:
    """Whether paths are long enough for light that is scattered by a network and then by another surface."""
    return secondary_network.applies(r) and foreground_grid.slides(r)


def launch(r: Request) -> Term | None:
    """Return the term of what a network sends beside its silhouettes."""
    kernel = make_foreground_kernel(r.config, r.role, r.moves.camera, "network")
    return foreground_grid.launch_items(r, TERM, kernel, network_items(r.scene, network_shapes(r.scene), []))


TERM = BoundaryTerm(
    name="foreground_network",
    title="silhouettes of networks, in front",
    stream=35,
    methods=(PathSpace,),
    launch=launch,
    applies=applies,
    exact=True,
    part="smooth",
    recorded="secondary",
)
