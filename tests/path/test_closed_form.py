"""Radiance that a formula gives: the scenes of ``scenes/tests`` with the values stored beside them."""

import tomllib

import numpy as np
import pytest

import warp_psdr as psdr
from tests.path.helpers import CLOSED_FORM, ROUNDING, assert_mean, batches

with open(CLOSED_FORM / "expected.toml", "rb") as file:
    EXPECTED = tomllib.load(file)
CASES = {name: (name, case) for name, case in EXPECTED.items()}
CASES |= {f"{name}.hidden": (name, case["hidden"]) for name, case in EXPECTED.items() if "hidden" in case}
#: Independent images, and the samples a pixel of each.
BATCHES, SPP = 8, 4
#: Largest difference of two pixels of a deterministic image, relative: the radiance varies that much between them.
DETERMINISTIC = 5e-3
#: Scenes whose expected values live in a test of their own.
ELSEWHERE = {"furnace_inside"}
#: Among the handful of ``-m smoke``.
SMOKE = {"area_over_plane"}


def test_every_scene_has_its_value():
    assert {file.stem for file in CLOSED_FORM.glob("*.xml")} == set(EXPECTED) | ELSEWHERE


def expected_image(case, shape):
    return np.array(case["pixels"]) if "pixels" in case else np.broadcast_to(case["radiance"], shape)


@pytest.mark.slow_rows(
    "mirror",
    "spot_falloff",
    "two_sided_back",
    "spot_axis",
    "directional",
    "two_sided_front",
    "furnace_glass",
    "hidden_light",
    "hidden_light.hidden",
    "furnace_outside",
    "point",
)
@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.smoke] * (n in SMOKE)) for n in CASES])
def test_radiance(name):
    stem, case = CASES[name]
    scene = psdr.load_file(CLOSED_FORM / f"{stem}.xml")
    options = scene.description.integrator | case.get("options", {})
    options = {k: options[k] for k in ("max_depth", "hide_emitters") if k in options}
    images = batches(scene, count=BATCHES, spp=case.get("spp", SPP), **options)
    expected = expected_image(case, images.shape[1:])
    if case.get("deterministic"):
        # The mean over the pixels, which surround the point symmetrically, and without any further randomness.
        mean = images.mean(axis=(0, 1, 2))
        np.testing.assert_allclose(mean, case["radiance"], rtol=ROUNDING, atol=1e-7)
        assert np.ptp(images, axis=(0, 1, 2)).max() <= DETERMINISTIC * mean.max(), "pixels differ"
    elif "pixels" in case:
        assert_mean(images, expected, name)
    else:  # every pixel looks at the same point: all are batches
        assert_mean(images.reshape(-1, 3), np.array(case["radiance"]), name)


def test_the_test_can_fail():
    """A renderer that is 3 % off fails the statistical comparison."""
    scene = psdr.load_file(CLOSED_FORM / "area_over_plane.xml")
    images = batches(scene, count=BATCHES, spp=64, max_depth=2).reshape(-1, 3)
    with pytest.raises(AssertionError, match="expected"):
        assert_mean(1.03 * images, np.array(EXPECTED["area_over_plane"]["radiance"]), "3 % off")


@pytest.mark.parametrize("stem", sorted(EXPECTED))
def test_mitsuba_agrees(stem):
    """The scene files mean the same to Mitsuba, unchanged."""
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    case = EXPECTED[stem]
    scene = mitsuba.load_file(str(CLOSED_FORM / f"{stem}.xml"))
    spp = case.get("spp", SPP)
    images = np.stack([np.array(mitsuba.render(scene, spp=spp, seed=i)) for i in range(BATCHES)]).astype(np.float64)
    expected = expected_image(case, images.shape[1:])
    if "pixels" in case:
        assert_mean(images, expected, stem)
    else:
        assert_mean(images.reshape(-1, 3), np.array(case["radiance"]), stem)
