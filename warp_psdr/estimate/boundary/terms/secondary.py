"""Shadow edges and other jumps of the visibility between two path vertices [ZMY*20]."""

from __future__ import annotations

import math

from warp_psdr import compiler
from warp_psdr.estimate.boundary import projective
from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.estimate.guiding import store
from warp_psdr.kernels.boundary.guiding.techniques import Guide
from warp_psdr.kernels.boundary.path_space.secondary import make_secondary_kernel
from warp_psdr.options.boundary import PathSpace, Projective
from warp_psdr.options.words import words
from warp_psdr.plan.motion import moving_shapes
from warp_psdr.topology.kinds.grids import SECONDARY
from warp_psdr.topology.secondary_edges import secondary_edges


def applies(r: Request) -> bool:
    """Whether light is scattered, and edges, lights or the camera move."""
    return r.lit and r.vertex_motion.edges and r.scatters_smoothly


def launch(r: Request) -> Term | None:
    """Return the term of shadow edges and their like: visibility between two path vertices."""
    guiding = getattr(r.method, "guiding", None)
    kernel = make_secondary_kernel(
        r.config, r.role, r.moves.camera, r.moves.light_pose, guiding is not None, r.indirect
    )
    if guiding is None:
        edges, guide = secondary_edges(r.scene, set(r.moves.shapes)), Guide()
        guide.share = r.own_share
        if isinstance(r.method, Projective):
            guide.share = projective.uniform_share(r)
    else:
        compiler.begin([*store.kernels(r), kernel], r.scene.device)
        seeds = projective.asker(r) if isinstance(r.method, Projective) else None
        edges, guide = store.guide(r, guiding, seeds)
    if edges is None:
        return None
    share = SECONDARY.values if r.values_alone else 1.0
    samples = math.ceil(r.pixels * (r.method.spp_secondary or r.spp) * share)
    return term_of(
        r, TERM, kernel, [r.scene.data(), r.camera, edges, moving_shapes(r.scene, r.vertex_motion), guide], samples
    )


TERM = BoundaryTerm(
    name="secondary",
    title="{} boundary",
    stream=1,
    methods=(PathSpace, Projective),
    launch=launch,
    applies=applies,
    splits=True,
    guided=True,
    knows=words("material_points", "slides", "transient"),
    recorded="secondary",
)
