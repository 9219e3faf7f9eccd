"""Steps of textures: those that the camera sees move, and those that slide over surfaces at other path vertices."""

from __future__ import annotations

import math

import numpy as np

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.crossing.film_tube_steps import make_film_tube_steps_kernel
from warp_psdr.kernels.boundary.crossing.vertex_tube_steps import make_vertex_tube_steps_kernel
from warp_psdr.kernels.boundary.path_space.media_sliding_steps import make_media_sliding_steps_kernel
from warp_psdr.kernels.boundary.path_space.primary import make_primary_kernel
from warp_psdr.kernels.boundary.path_space.sliding_steps import make_sliding_steps_kernel
from warp_psdr.options.boundary import EdgeSampling, PathSpace, Projective
from warp_psdr.options.words import words
from warp_psdr.plan.discontinuities import SLIDING_STEPS
from warp_psdr.plan.motion import moving_shapes, seen_steps, sliding_steps
from warp_psdr.topology.kinds.tube_items import on_curves
from warp_psdr.topology.texture_steps import film_lines, world_lines
from warp_psdr.topology.tube_steps import tube_lines

#: Least share of the samples that the lines on the film take; they take all where they are a pixel apart.
LEAST_SHARE = 0.125


def launch_seen(r: Request) -> Term | None:
    """Return the term of the steps that the camera sees move."""
    seen = seen_steps(r.scene, r.config, r.moves)
    carriers = frozenset() if r.config.shown else seen - on_curves(r.scene, seen)
    seams = not (r.moves.camera or r.moves.shapes)  # else they are edges that move
    found = film_lines(r.scene, r.sensor, carriers, seams) if carriers else None
    if found is None:
        return None
    edges, length = found
    share = float(np.clip(length / r.pixels, LEAST_SHARE, 1.0))
    samples = math.ceil(r.pixels * (r.method.spp_primary or r.spp) * share)
    kernel = make_primary_kernel(r.config, r.role, r.moves.camera)
    return term_of(r, SEEN, kernel, [r.scene.data(), r.camera, edges], samples)


def slides(r: Request) -> bool:
    """Whether steps slide over surfaces, and paths have vertices that the camera does not see."""
    return SLIDING_STEPS.applies(r.asked)


def launch_sliding(r: Request) -> Term | None:
    """Return the term of the steps that slide over surfaces, at vertices that the camera does not see."""
    carriers = r.moves.steps - on_curves(r.scene, r.moves.steps)
    edges = world_lines(r.scene, carriers) if carriers else None
    if edges is None:
        return None
    samples = r.pixels * (r.method.spp_secondary or r.spp)
    make = make_sliding_steps_kernel if r.config.media is None else make_media_sliding_steps_kernel
    kernel = make(r.config, r.role, r.moves.camera)
    return term_of(r, SLIDING, kernel, [r.scene.data(), r.camera, edges], samples)


def launch_on_tubes(r: Request) -> Term | None:
    """Return the term of the steps that the camera sees move."""
    carriers = frozenset() if r.config.shown else on_curves(r.scene, seen_steps(r.scene, r.config, r.moves))
    found = tube_lines(r.scene, carriers) if carriers else None
    if found is None:
        return None
    kernel = make_film_tube_steps_kernel(r.config, r.role, r.moves.camera)
    return term_of(r, ON_TUBES, kernel, [r.scene.data(), r.camera, found], r.pixels * (r.method.spp_primary or r.spp))


def launch_at_vertices(r: Request) -> Term | None:
    """Return the term of the steps at vertices, which slide along rays, that the camera does not see."""
    if not (r.lit and r.scatters_smoothly) or r.plan.max_depth == 2:  # curves do not shine
        return None
    carriers = on_curves(r.scene, sliding_steps(r.scene, r.moves))
    found = tube_lines(r.scene, carriers) if carriers else None
    if found is None:
        return None
    kernel = make_vertex_tube_steps_kernel(r.config, r.role, r.moves.camera)
    head = [r.scene.data(), r.camera, found, moving_shapes(r.scene, r.moves)]
    return term_of(r, AT_VERTICES, kernel, head, r.pixels * (r.method.spp_secondary or r.spp))


SEEN = BoundaryTerm(
    name="texture_steps",
    title="steps of textures",
    stream=60,
    methods=(PathSpace, Projective, EdgeSampling),
    launch=launch_seen,
    knows=words("material_points", "slides", "media", "transient"),
    recorded="primary",
)
SLIDING = BoundaryTerm(
    name="sliding_steps",
    title="steps that slide over surfaces",
    stream=61,
    methods=(PathSpace, Projective, EdgeSampling),
    launch=launch_sliding,
    applies=slides,
    knows=SLIDING_STEPS.knows,
)
ON_TUBES = BoundaryTerm(
    name="film_tube_steps",
    title="steps of textures on tubes",
    stream=66,
    methods=(PathSpace, Projective),
    launch=launch_on_tubes,
    knows=words("material_points", "slides"),
)
AT_VERTICES = BoundaryTerm(
    name="vertex_tube_steps",
    title="vertices at steps of textures on tubes",
    stream=67,
    methods=(PathSpace, Projective),
    launch=launch_at_vertices,
    knows=words("material_points", "slides"),
)
TERMS = {term.name: term for term in (SEEN, SLIDING, ON_TUBES, AT_VERTICES)}
