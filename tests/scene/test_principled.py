"""Scene files with ``principled``: which names are listed, what is refused, what passes the surface."""

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.kernels.bsdf.model import key_of
from warp_psdr.scene import describe_dict

RATES = ("main_specular_sampling_rate", "clearcoat_sampling_rate", "diffuse_reflectance_sampling_rate")


def scene(**parameters):
    return {"type": "scene", "floor": {"type": "rectangle", "bsdf": {"type": "principled", **parameters}}}


def described(**parameters):
    return describe_dict(scene(**parameters)).shapes[0].bsdf


def key(bsdf):
    return key_of(bsdf.model, bsdf.variant)


@pytest.mark.parametrize("given", [{"eta": 1.4, "spec_trans": 0.5}, {"spec_trans": 0.5}])
def test_names_and_values_are_mitsubas_but_for_sampling_rates(given):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    theirs = mi.traverse(mi.load_dict({"type": "principled", **given}))
    rest = {"sensor": {"type": "perspective", "fov": 40.0}, "sky": {"type": "constant"}}
    params = psdr.traverse(psdr.load_dict(scene(**given) | rest))
    ours = {name.removeprefix("floor.bsdf."): params[name] for name in params if name.startswith("floor.bsdf.")}
    assert set(ours) == set(theirs.keys()) - set(RATES)
    for name, value in ours.items():
        np.testing.assert_allclose(value.numpy().ravel(), np.ravel(theirs[name]), rtol=1e-6, err_msg=name)


def test_sampling_rates_are_kept_but_not_listed():
    bsdf = described(clearcoat_sampling_rate=0.5)
    assert bsdf.fixed == {"ior": 0.0, **dict(zip(RATES, (1.0, 0.5, 1.0), strict=True))}


@pytest.mark.parametrize(
    ("given", "expected"),
    [({}, "principled"), ({"spec_trans": 0.0}, "principled"), ({"spec_trans": 0.3}, "principled (spec_trans)")],
)
def test_without_transmission_it_is_opaque(given, expected):
    assert key(described(**given)) == expected


def test_what_is_opaque_has_two_sides():
    inner = {"type": "principled", "spec_trans": 0.0}
    floor = {"type": "rectangle", "bsdf": {"type": "twosided", "inner": inner}}
    assert describe_dict({"type": "scene", "floor": floor}).shapes[0].bsdf.two_sided
    inner["spec_trans"] = 0.1
    with pytest.raises(ValueError, match=r"'principled' inside 'twosided'.*reflects only"):
        describe_dict({"type": "scene", "floor": floor})


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"eta": 1.5, "specular": 0.4}, "got 'eta' and 'specular'; give one"),
        ({"eta": 0.0}, "eta"),
        ({"specular": 0.0, "spec_trans": 1.0}, "specular 0, an index of refraction of 1, beside 'spec_trans'"),
        ({"eta": 1.0005, "spec_trans": 1.0}, "differs from 1 by 0.001 or more"),
        ({"main_specular_sampling_rate": 0.0}, "at least 0.001"),
        ({"metallic": 1.5}, "metallic"),
    ],
)
def test_bad_input(given, words):
    with pytest.raises(ValueError, match="floor") as caught:
        describe_dict(scene(**given))
    assert words in str(caught.value)


def test_shapes_need_no_texture_coordinates_and_it_may_be_nested():
    """Its lobes follow dp/du where there is one, since ``anisotropic`` has a derivative at 0."""
    corners = {"type": "mesh", "vertices": np.eye(3), "faces": [[0, 1, 2]], "bsdf": {"type": "principled"}}
    assert describe_dict({"type": "scene", "bare": corners}).shapes[0].bsdf.model == "principled"
    bitmap = {"type": "bitmap", "bitmap": np.full((2, 2, 3), (0.5, 0.5, 1.0)), "raw": True}
    mapped = {"type": "normalmap", "normalmap": bitmap, "inner": {"type": "principled"}}
    floor = {"type": "rectangle", "bsdf": mapped}
    assert describe_dict({"type": "scene", "floor": floor}).shapes[0].bsdf.children == ("principled",)
