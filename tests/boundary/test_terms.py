"""The boundary terms declare themselves: a file each, or a family of shapes each; one list, own random numbers."""

import pkgutil
from dataclasses import replace
from importlib import import_module

import warp_psdr as psdr
from warp_psdr.estimate.boundary import terms
from warp_psdr.invalid import KINDS
from warp_psdr.options.boundary import FilmEdges
from warp_psdr.plan.motion import motion

from .scenes import load

OCCLUDER = "occluder.vertex_positions"


def test_every_file_declares_a_term_that_is_in_the_list() -> None:
    files = {m.name for m in pkgutil.iter_modules(terms.__path__)} - {"request"}
    declared = {}
    for name in files:
        module = import_module(f"{terms.__name__}.{name}")
        # Silhouettes: one term a family of shapes.
        declared |= {t.name: t for t in module.TERMS.values()} if hasattr(module, "TERMS") else {name: module.TERM}
    assert {term.name for term in terms.ALL} == set(declared) and len(terms.ALL) == len(declared)
    assert all(declared[term.name] is term and terms.named(term.name) is term for term in terms.ALL)
    assert all(("{}" in term.title) == term.splits for term in terms.ALL)
    assert set(declared) <= set(KINDS), "samples of every term are counted"


def test_the_terms_of_a_method_have_random_numbers_of_their_own() -> None:
    explicit = {psdr.boundary.EdgeSampling, psdr.boundary.PathSpace, psdr.boundary.Projective}
    moving = {psdr.boundary.SignedDistance, psdr.boundary.NeuralSignedDistance}
    moving |= {psdr.boundary.WarpedArea, psdr.boundary.Rotation}
    assert set(terms.TERMS) == explicit | moving | {psdr.boundary.PathWarpedArea, FilmEdges}
    assert [term.name for term in terms.TERMS[FilmEdges]] == ["primary"]
    for found in (terms.TERMS[method] for method in explicit):
        assert len({term.stream for term in found}) == len(found) > 3
    for method in moving:
        assert terms.TERMS[method] == (terms.film_border.TERM,)
    own = terms.TERMS[psdr.boundary.PathWarpedArea]
    assert [term.name for term in own] == ["path_warped_area", "film_border"] and own[0].stream != own[1].stream


def test_what_does_not_apply_is_not_looked_for() -> None:
    scene, _params = load("soft")
    plan = psdr.plan(scene, names=[OCCLUDER], integrator=psdr.PathIntegrator(max_depth=1))
    request = terms.Request(scene, plan, motion(scene, [OCCLUDER]), "reverse", 0, 1, 0)

    def launch(_request):
        raise AssertionError("looked for")

    assert terms.launches(replace(terms.named("secondary"), launch=launch), request) == []
    assert [t.kind for t in terms.launches(terms.named("primary"), request)] == ["primary"]
