"""Rough glass in whole scenes: a furnace, what is refused, and the names of its values."""

import numpy as np
import pytest

import warp_psdr as psdr

FILM = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}


def scene(**more) -> dict:
    pose = psdr.Transform.look_at([0, -4, 1], [0, 0, 0], [0, 0, 1])
    glass = {"type": "roughdielectric", "alpha": 0.05, "int_ior": 1.5, "ext_ior": 1.0} | more
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 40.0, "to_world": pose, "film": FILM},
        "ball": {"type": "sphere", "bsdf": glass},
        "sky": {"type": "constant", "radiance": 1.0},
    }


@pytest.mark.slow
def test_a_glass_ball_in_a_furnace_is_nearly_invisible() -> None:
    """Radiance that goes in and out again is scaled by the index and back; a little is masked at every crossing."""
    loaded = psdr.load_dict(scene())
    image = psdr.render(loaded, integrator=psdr.PathIntegrator(max_depth=32, rr_depth=32), spp=256, seed=1).numpy()
    assert image.mean() == pytest.approx(1.0, abs=0.02)
    assert image.max() < 1.1


@pytest.mark.parametrize(
    ("more", "boundary", "words"),
    [
        (
            {},
            psdr.boundary.EdgeSampling(),
            "does not know the smooth lobe behind the surface of a 'roughdielectric'; use boundary.PathSpace",
        ),
        (
            {"exact": {"type": "sphere", "exact": True, "center": [5, 0, 0]}},
            "auto",
            "not known together; leave out 'exact'",
        ),
    ],
)
def test_a_boundary_term_is_refused_by_name(more: dict, boundary, words: str) -> None:
    loaded = psdr.load_dict(scene() | more)
    params = psdr.traverse(loaded)
    params.requires_grad_only("ball.to_world")
    with pytest.raises(ValueError, match=f"{words}.*boundary=None"):
        psdr.plan(loaded, params, integrator=psdr.PathIntegrator(boundary=boundary, max_depth=4))
    params.requires_grad_only("ball.bsdf.*", "sky.radiance.value")
    psdr.plan(loaded, params)


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"int_ior": 1.0004}, "both sides of a 'roughdielectric' have to differ, by a ratio of 0.001"),
        ({"alpha_u": 0.2}, "got 'alpha' besides"),
    ],
)
def test_what_rough_glass_cannot_be_is_named(parameters: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        psdr.load_dict(scene(**parameters))


def test_glass_has_no_two_sides() -> None:
    inner = scene()["ball"]["bsdf"]
    with pytest.raises(ValueError, match="nest a bsdf that reflects only"):
        psdr.load_dict(scene() | {"ball": {"type": "sphere", "bsdf": {"type": "twosided", "glass": inner}}})


def test_names_are_mitsubas() -> None:
    names = {n.removeprefix("ball.bsdf.") for n in psdr.traverse(psdr.load_dict(scene())) if n.startswith("ball.bsdf.")}
    assert names == {"eta", "alpha.value", "specular_reflectance.value", "specular_transmittance.value"}
    assert np.isclose(psdr.traverse(psdr.load_dict(scene()))["ball.bsdf.eta"].numpy()[0], 1.5)
