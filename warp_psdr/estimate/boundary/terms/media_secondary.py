"""Shadow edges in media, which cut off light from surfaces and from points of the medium."""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_psdr.estimate.boundary import projective
from warp_psdr.estimate.boundary.terms.request import OWN_SHARE, OWN_SHARE_DIRECT, BoundaryTerm, Request, Term, term_of
from warp_psdr.estimate.boundary.touching import Touched, guided_kernel
from warp_psdr.kernels.boundary.path_space.media_secondary import make_media_secondary_kernel
from warp_psdr.options.boundary import PathSpace, Projective
from warp_psdr.options.words import words
from warp_psdr.plan.motion import moving_shapes
from warp_psdr.topology.edges_there import secondary_edges_there


def applies(r: Request) -> bool:
    """Whether light is scattered, or a medium shines on what scatters it, and edges, lights or the camera move."""
    media = r.config.media
    shines = media is not None and media.emissive and r.plan.max_depth != 1
    return media is not None and (r.lit or shines) and r.moves.edges


def own_share(r: Request) -> float:
    """Return the share of the segments that are not aimed at lights."""
    if not r.scene.builder.emitters:
        return 1.0
    media = r.config.media
    spread = r.scene.builder.environment >= 0 or (media is not None and media.emissive)  # light comes from everywhere
    return OWN_SHARE if spread else OWN_SHARE_DIRECT


def launch(r: Request) -> Term | None:
    """Return the term of the edges of what is there."""
    edges = secondary_edges_there(r.scene, set(r.moves.shapes))
    if edges is None:
        return None
    deep = r.plan.max_depth != 2
    assert r.config.media is not None
    head = [r.scene.data(), r.camera, edges, moving_shapes(r.scene, r.moves)]

    def make(role: str, camera_moves: bool, light_pose: bool, guided: bool) -> wp.Kernel:
        moved = r.moves.grids and role != "target"
        return make_media_secondary_kernel(r.config, role, camera_moves, light_pose, deep, moved, guided)

    cdf = edges.cdf.numpy().astype(np.float64)
    unlit = not r.scene.builder.emitters
    projects = isinstance(r.method, Projective)
    seeds = None
    if projects and not unlit:
        ask = projective.asker(r)
        seeds = lambda technique: ask(technique, edges)  # noqa: E731
    touched = Touched(seeds=seeds, unlit=unlit)
    kernel, guide = guided_kernel(r, TERM.name, make, head, len(cdf) - 1, cdf, touched)
    if getattr(r.method, "guiding", None) is None:
        guide.share = projective.uniform_share(r) if projects and not unlit else own_share(r)
    return term_of(r, TERM, kernel, [*head, guide], r.pixels * (r.method.spp_secondary or r.spp))


TERM = BoundaryTerm(
    name="media_secondary",
    title="shadows in media",
    stream=11,
    methods=(PathSpace, Projective),
    launch=launch,
    applies=applies,
    guided=True,
    knows=words("media", "material_points"),
)
