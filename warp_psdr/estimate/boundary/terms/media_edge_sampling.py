"""Shadow edges and other silhouettes in media, as the vertices of a camera path see them [LADL18]."""

from __future__ import annotations

from dataclasses import replace

from warp_psdr.estimate.boundary.terms import edge_sampling
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.edge_sampling.media_edge_sampling import make_media_edge_sampling_kernel
from warp_psdr.options import interior
from warp_psdr.options.boundary import EdgeSampling
from warp_psdr.options.words import words
from warp_psdr.rows.replay import keep_blocks
from warp_psdr.topology.edge_trees import edge_trees
from warp_psdr.topology.edges_there import secondary_edges_there


def applies(r: Request) -> bool:
    """Whether an edge can hide anything from a vertex that moves against it."""
    media = r.config.media
    if media is None or r.plan.max_depth == 1 or not r.moves.edges:
        return False
    # What shines on the way to a light may be what the edge hides, too.
    return media.emissive or edge_sampling.applies(r)


def launch(r: Request) -> Term | None:
    """Return the term of the edges of what is there, as the vertices of a camera path see them."""
    assert isinstance(r.method, EdgeSampling) and r.config.media is not None
    edges = secondary_edges_there(r.scene, set(r.moves.shapes))
    if edges is None:
        return None
    spp = r.method.spp_secondary or r.spp
    walk = replace(r.plan.config.unlit(), media=replace(r.config.media, emissive=False))
    kept = keep_blocks(interior.Replay(), r.plan.max_depth, r.rr_depth)
    kernel = make_media_edge_sampling_kernel(
        r.config,
        walk,
        r.role,
        r.moves.camera,
        r.moves.grids,
        r.method.tree,
        edge_sampling.candidates_of(r.method),
        r.config.media.emissive or r.plan.max_depth != 2,
        kept.block,
        kept.longest,
    )
    head = [r.scene.data(), r.camera, edges, edge_trees(r.scene, edges)]
    return term_of(r, TERM, kernel, head, r.pixels * spp, count=spp)


TERM = BoundaryTerm(
    name="media_edge_sampling",
    title="shadows in media, as path vertices see them",
    stream=12,
    methods=(EdgeSampling,),
    launch=launch,
    applies=applies,
    knows=words("media", "material_points"),
)
