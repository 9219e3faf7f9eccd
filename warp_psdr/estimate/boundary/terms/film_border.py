"""The flux of moving rays across the borders of pixels."""

from __future__ import annotations

from warp_psdr.estimate.boundary.terms.request import BoundaryTerm, Request, Term, term_of
from warp_psdr.kernels.boundary.signed_distance.film_border import make_film_border_kernel
from warp_psdr.kernels.constants import RFILTER_BOX
from warp_psdr.options.boundary import (
    AuxiliaryRays,
    NeuralSignedDistance,
    PathWarpedArea,
    Rotation,
    SignedDistance,
    WarpedArea,
)
from warp_psdr.options.words import words
from warp_psdr.rows import reparametrised, warped_area


def applies(r: Request) -> bool:
    """Whether pixels, or the film, have a border at which a filter jumps."""
    return bool(r.moves.shapes) and (r.camera.filter == RFILTER_BOX or not r.camera.sample_border)


def launch(r: Request) -> Term:
    """Return the term."""
    if isinstance(r.method, AuxiliaryRays):
        options = warped_area.compiled(r.method)
    else:
        options = reparametrised.compiled(r.method)
    assert options is not None
    kernel = make_film_border_kernel(r.config, r.role, options)
    samples = r.pixels * (r.method.spp_primary or r.spp)
    return term_of(r, TERM, kernel, [r.scene.data(), r.camera], samples)


TERM = BoundaryTerm(
    name="film_border",
    title="borders of pixels",
    stream=40,
    methods=(SignedDistance, NeuralSignedDistance, WarpedArea, PathWarpedArea, Rotation),
    launch=launch,
    applies=applies,
    knows=words("material_points", "slides"),
)
