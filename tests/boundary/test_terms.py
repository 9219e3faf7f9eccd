"""The boundary terms declare themselves: a file each, or a family of shapes each; one list, own random numbers."""

import pkgutil
import re
from dataclasses import replace
from importlib import import_module

import pytest

import warp_psdr as psdr
from warp_psdr.estimate.boundary import terms
from warp_psdr.invalid import KINDS
from warp_psdr.options.boundary import FilmEdges
from warp_psdr.options.words import APART, NEVER, WORDS, words
from warp_psdr.plan import discontinuities
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


#: Words without which terms of such names find nothing.
ONLY_BESIDE = {
    "media": "media_",
    "mirrors": "through_mirrors",
    "slides": "grid|cubic|network|tube|silhouette|crossing",
}


def test_a_term_knows_what_its_methods_know_or_the_plan_asks_where_it_exists() -> None:
    declared = {term.name: getattr(discontinuities, term.name.upper(), None) for term in terms.ALL}
    asked = {kind for kinds in discontinuities.OF_METHODS.values() for kind in kinds}
    assert {kind for kind in declared.values() if kind is not None} == asked
    for term in terms.ALL:
        if (kind := declared[term.name]) is not None:
            assert term.knows == kind.knows and set(term.methods) <= set(discontinuities.OF_METHODS)
            continue
        beside = {word for word, names in ONLY_BESIDE.items() if re.search(names, term.name)}
        for word in set(discontinuities.FILMS_AND_SHAPES) - term.knows:
            never = any(
                word in pairs.get(a, ()) or a in pairs.get(word, ()) for a in beside for pairs in (APART, NEVER)
            )
            assert never or not any(word in method.knows for method in term.methods), (term.name, word)


def test_every_word_that_is_declared_is_in_the_list() -> None:
    methods = [*psdr.interior.Method.__subclasses__(), *terms.METHODS]
    declared = [m.knows for m in methods] + [term.knows for term in terms.ALL] + [*APART.values(), *NEVER.values()]
    assert set().union(*declared, APART, NEVER) <= set(WORDS)
    assert all(word.what and word.instead for word in WORDS.values())
    with pytest.raises(KeyError, match="mirors"):
        words("mirors")


@pytest.mark.parametrize("name", ["ball.to_world", "lamp.to_world"])
def test_the_plan_refuses_what_a_term_does_not_know(name: str) -> None:
    """Vertex normals before a transient film: the curves where they turn away have no term that knows time bins."""
    film = {"type": "transient_hdr_film", "temporal_bins": 4, "bin_width_opl": 2.0, "pulse_width_opl": 0.5}
    facing = psdr.Transform.look_at([1, 1, -2], [0, 0, 0], [0, 1, 0])
    described = {
        "type": "scene",
        "sensor": {"type": "perspective", "to_world": psdr.Transform.translate([0, 0, -4]), "film": film},
        "lamp": {"type": "rectangle", "to_world": facing, "emitter": {"type": "area", "radiance": 3.0}},
        "ball": {"type": "sphere"},
    }
    integrator = psdr.PathIntegrator(max_depth=2)
    with pytest.raises(ValueError, match=r"interpolated normals.*does not know the time bins.*face_normals"):
        psdr.plan(psdr.load_dict(described), names=[name], integrator=integrator)
    described["ball"]["face_normals"] = True
    assert psdr.plan(psdr.load_dict(described), names=[name], integrator=integrator).boundary is not None
