"""Shadows of edges and of exact shapes in media, which cut off light from surfaces and from points of the medium."""

from __future__ import annotations

import functools

import numpy as np
import warp as wp

from warp_psdr.estimate.boundary import projective
from warp_psdr.estimate.boundary.terms.request import OWN_SHARE, OWN_SHARE_DIRECT, BoundaryTerm, Request, Term, term_of
from warp_psdr.estimate.boundary.terms.secondary_silhouettes import samples_of
from warp_psdr.estimate.boundary.touching import Touched, guided_kernel
from warp_psdr.kernels.boundary.path_space.media_secondary import make_media_secondary_kernel
from warp_psdr.kernels.boundary.silhouette.media_secondary import make_media_secondary_silhouette_kernel
from warp_psdr.options.boundary import PathSpace, Projective
from warp_psdr.options.words import words
from warp_psdr.plan.motion import moving_shapes
from warp_psdr.topology.edges_there import secondary_edges_there
from warp_psdr.topology.kinds.exact import EXACT
from warp_psdr.topology.kinds.family import Family


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


def applies_to(family: Family, r: Request) -> bool:
    """Whether there are shapes of a family, and anything that moves light past them."""
    return family.is_in(r.config.surfaces.primitives) and applies(r)


def launch_silhouettes(family: Family, r: Request) -> Term | None:
    """Return the term of the silhouettes and rims of what is there."""
    share = own_share(r)
    found = family.touched(r.scene, share, r.creases)
    if found is None:
        return None
    seeds = None
    if isinstance(r.method, Projective) and share < 1.0:
        if r.method.guiding is None:
            found.share = projective.uniform_share(r)
        else:
            seeds = projective.exact_asker(r, found)
    head = [r.scene.data(), r.camera, found, moving_shapes(r.scene, r.moves)]
    deep = r.plan.max_depth != 2

    def make(role: str, camera_moves: bool, light_pose: bool, guided: bool) -> wp.Kernel:
        moved = r.moves.grids and role != "target"
        options = (family.touch, deep, moved, guided)
        return make_media_secondary_silhouette_kernel(r.config, role, camera_moves, light_pose, *options)

    term = OF_SHAPES[family.touch]
    touched = Touched(record=found, seeds=seeds, unlit=share == 1.0)
    kernel, guide = guided_kernel(r, term.name, make, head, found.items.shape[0], touched=touched)
    return term_of(r, term, kernel, [*head, guide], samples_of(r, family.secondary))


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


def _term(family: Family, stream: int) -> BoundaryTerm:
    return BoundaryTerm(
        name=f"media_{family.term}",
        title=f"shadows of {family.title} in media",
        stream=stream,
        methods=family.methods,
        launch=functools.partial(launch_silhouettes, family),
        applies=functools.partial(applies_to, family),
        guided=True,
        knows=words("media", "material_points"),
        part="smooth",
    )


#: Family, by its touch -> its term.
OF_SHAPES: dict[str, BoundaryTerm] = {EXACT.touch: _term(EXACT, 68)}
TERMS = {term.name: term for term in (TERM, *OF_SHAPES.values())}
