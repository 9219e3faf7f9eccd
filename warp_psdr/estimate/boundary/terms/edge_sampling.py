"""Shadow edges and other silhouettes as the vertices of a camera path see them [LADL18]."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels import constants as c
from warp_psdr.kernels.boundary.edge_sampling.edge_sampling import make_edge_sampling_kernel
from warp_psdr.kernels.boundary.edge_sampling.edge_tree import MAX_SPLIT
from warp_psdr.options.boundary import DEFAULT_CANDIDATES, EdgeSampling
from warp_psdr.topology.edge_trees import edge_trees
from warp_psdr.topology.secondary_edges import secondary_edges


def applies(r: Request) -> bool:
    """Whether an edge can hide anything from a vertex."""
    kinds = {e.kind for e in r.scene.builder.emitters}
    # With one scattering event only a light can be what the edge hides.
    return r.plan.max_depth != 1 and bool(kinds if r.plan.max_depth != 2 else kinds - c.DELTA_LIGHTS)


def candidates_of(method: EdgeSampling) -> int:
    """Return how many edges are resampled for each sample."""
    return method.candidates or (MAX_SPLIT if method.tree else DEFAULT_CANDIDATES)


def launch(r: Request) -> Term | None:
    """Return the term of shadow edges and their like as the vertices of a camera path see them [LADL18]."""
    assert isinstance(r.method, EdgeSampling)
    edges = secondary_edges(r.scene, set(r.moves.shapes))
    if edges is None:
        return None
    spp = r.method.spp_secondary or r.spp
    walk = r.plan.config.unlit()
    candidates = candidates_of(r.method)
    kernel = make_edge_sampling_kernel(r.config, walk, r.role, r.moves.camera, r.method.tree, candidates, r.indirect)
    head = [r.scene.data(), r.camera, edges, edge_trees(r.scene, edges)]
    return term_of(r, TERM, kernel, head, r.pixels * spp, count=spp)


TERM = BoundaryTerm(
    name="edge_sampling",
    title="{} boundary",
    stream=5,
    methods=(EdgeSampling,),
    launch=launch,
    applies=applies,
    splits=True,
)
