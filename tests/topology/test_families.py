"""Families of shapes without triangles: what the host says of them fits what the kernels do."""

import pytest

from tests.cuda_configs import CUBIC, CURVES, DISTANCES, EXACT
from warp_psdr.estimate.boundary import terms
from warp_psdr.estimate.boundary.terms import foreground_silhouettes, primary_silhouettes, secondary_silhouettes
from warp_psdr.invalid import KINDS
from warp_psdr.kernels.boundary.silhouette.table import TOUCHES, touch_of
from warp_psdr.topology.kinds.table import FAMILIES

CONFIGS = {"exact": EXACT, "grid": DISTANCES, "cubic": CUBIC, "network": CUBIC, "tubes": CURVES}


def test_every_family_has_a_touch() -> None:
    assert {family.touch for family in FAMILIES} == set(TOUCHES) - {"grid creases"} == set(CONFIGS)


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.touch)
def test_terms_are_those_that_the_touch_serves(family) -> None:
    config = CONFIGS[family.touch]
    touch = touch_of(family.touch, config.surfaces.primitives, config.sampler)
    assert family.is_in(config.surfaces.primitives) and not family.is_in(())
    assert (touch.own_scale is None) == (family.streams.foreground is None)
    found = [of.TERMS.get(family.touch) for of in (primary_silhouettes, secondary_silhouettes, foreground_silhouettes)]
    made = [term for term in found if term is not None]
    assert [term.stream for term in made] == [stream for stream in family.streams if stream is not None]
    assert all(term in terms.ALL and term.name in KINDS for term in made)
