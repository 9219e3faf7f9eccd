"""Steps of textures on tubes: as the camera sees them, and at other path vertices."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.crossing.film_tube_steps import make_film_tube_steps_kernel
from warp_psdr.kernels.boundary.crossing.vertex_tube_steps import make_vertex_tube_steps_kernel
from warp_psdr.options.boundary import PathSpace, Projective
from warp_psdr.options.words import words
from warp_psdr.plan.motion import moving_shapes, seen_steps, sliding_steps
from warp_psdr.topology.tube_steps import on_curves, tube_lines


def launch_film(r: Request) -> Term | None:
    """Return the term of the steps that the camera sees move."""
    carriers = frozenset() if r.config.shown else on_curves(r.scene, seen_steps(r.scene, r.config, r.moves))
    found = tube_lines(r.scene, carriers) if carriers else None
    if found is None:
        return None
    kernel = make_film_tube_steps_kernel(r.config, r.role, r.moves.camera)
    return term_of(r, FILM, kernel, [r.scene.data(), r.camera, found], r.pixels * (r.method.spp_primary or r.spp))


def launch_vertex(r: Request) -> Term | None:
    """Return the term of the steps at vertices, which slide along rays, that the camera does not see."""
    if not (r.lit and r.scatters_smoothly) or r.plan.max_depth == 2:  # curves do not shine
        return None
    carriers = on_curves(r.scene, sliding_steps(r.scene, r.moves))
    found = tube_lines(r.scene, carriers) if carriers else None
    if found is None:
        return None
    kernel = make_vertex_tube_steps_kernel(r.config, r.role, r.moves.camera)
    head = [r.scene.data(), r.camera, found, moving_shapes(r.scene, r.moves)]
    return term_of(r, VERTEX, kernel, head, r.pixels * (r.method.spp_secondary or r.spp))


FILM = BoundaryTerm(
    name="film_tube_steps",
    title="steps of textures on tubes",
    stream=62,
    methods=(PathSpace, Projective),
    launch=launch_film,
    knows=words("material_points", "slides"),
)
VERTEX = BoundaryTerm(
    name="vertex_tube_steps",
    title="vertices at steps of textures on tubes",
    stream=63,
    methods=(PathSpace, Projective),
    launch=launch_vertex,
    knows=words("material_points", "slides"),
)
TERMS = {term.name: term for term in (FILM, VERTEX)}
