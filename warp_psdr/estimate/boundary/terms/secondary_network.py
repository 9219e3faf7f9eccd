"""Smooth silhouettes of networks of signed distances between two path vertices."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms import secondary_grid
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term
from warp_psdr.kernels.primitive.network_kind import NETWORK
from warp_psdr.options.boundary import PathSpace
from warp_psdr.topology.grid_silhouettes import light_eyes
from warp_psdr.topology.network_silhouettes import network_items, network_shapes


def applies(r: Request) -> bool:
    """Whether light is scattered beside networks, and anything moves."""
    return NETWORK.number in r.config.primitives and r.lit and r.moves.edges and r.scatters_smoothly


def launch(r: Request) -> Term | None:
    """Return the term of the silhouettes between two path vertices, neither of which need be on what moves."""
    eyes = light_eyes(r.scene)
    found = network_items(r.scene, network_shapes(r.scene), eyes)
    return secondary_grid.launch_items(r, TERM, found, eyes == [], True, True)


TERM = BoundaryTerm(
    name="secondary_network",
    title="{} silhouettes of networks",
    stream=34,
    methods=(PathSpace,),
    launch=launch,
    applies=applies,
    splits=True,
    guided=True,
    exact=True,
    part="smooth",
    recorded="secondary",
)
