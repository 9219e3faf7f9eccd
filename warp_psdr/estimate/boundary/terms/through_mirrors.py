"""Discontinuities seen through smooth mirrors and glass, found by searching along lines."""

from __future__ import annotations

from warp_psdr.estimate.boundary import long_chains
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.specular.line_search import make_line_search_kernel
from warp_psdr.kernels.boundary.specular.media_line_search import make_media_line_search_kernel
from warp_psdr.kernels.bsdf.dispatch import has_chain_lobes
from warp_psdr.options.boundary import Connecting, PathSpace, Projective
from warp_psdr.options.words import words
from warp_psdr.topology.faces import face_tables
from warp_psdr.topology.patches import patch_radii


def applies(r: Request) -> bool:
    """Whether there is a mirror or glass."""
    chains = has_chain_lobes(r.config.surfaces.bsdfs, r.config.media is not None)
    return r.config.scatter and chains and bool(r.scene.face_count)


def launch(r: Request) -> Term | None:
    """Return the term of what is seen through smooth mirrors and glass."""
    assert r.plan.wanted is not None
    edges, tables = face_tables(r.scene)
    assert isinstance(r.method, Connecting)
    samples = r.pixels * (r.method.spp_mirrors or r.spp)
    asked = r.config, r.plan.wanted, r.role, r.moves.light_pose
    data = r.scene.data()
    if r.config.media is None:
        kernel = make_line_search_kernel(*asked)
    else:
        kernel = make_media_line_search_kernel(*asked, r.moves.grids)
        data.radii = patch_radii(r.scene)  # motions of volume vertices are weighted next to surfaces
    term = term_of(r, TERM, kernel, [data, r.camera, edges, tables], samples)
    long_chains.check(r)
    return term


TERM = BoundaryTerm(
    name="through_mirrors",
    title="through mirrors",
    stream=100,
    methods=(PathSpace, Projective),
    launch=launch,
    applies=applies,
    knows=words("material_points", "slides", "media"),
)
