"""Projectors: a closed form, Mitsuba's image, the edge of the image as a discontinuity, and what is refused."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.emitter.helpers import floor_under, random_map
from tests.path.helpers import assert_same_mean, batches, blocks
from tests.peer import MITSUBA_ROUNDING, for_mitsuba
from warp_psdr.kernels.emitter.projector import frame_dot, projector_dot

FACING = psdr.Transform.look_at([0.0, 0.0, 2.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0])
UPRIGHT = psdr.Transform.rotate([1.0, 0.0, 0.0], 80.0) @ psdr.Transform.scale(0.3)


def scene_of(size=16, **projector):
    return floor_under({"type": "projector", "fov": 35.0} | projector, size)


def framed(height=5, width=6):
    """An image with a border of black texels."""
    return np.pad(random_map(height, width), ((1, 1), (1, 1), (0, 0)))


def image(values, **more):
    return {"type": "bitmap", "bitmap": values, "raw": True, **more}


def test_a_constant_on_a_facing_plane_has_a_closed_form():
    """rho s E / z^2 all over the frame, and nothing beyond it: the power is all that the fields of view say."""
    scene = psdr.load_dict(scene_of(to_world=FACING, fov=30.0, irradiance={"type": "rgb", "value": [1, 2, 3]}, scale=8))
    found = psdr.render(scene, spp=64).numpy()
    inside = 0.5 * 8.0 * np.array([1.0, 2.0, 3.0]) / 2.0**2
    middle = found[7:9, 7:9]
    np.testing.assert_allclose(middle, np.broadcast_to(inside, middle.shape), rtol=1e-5)
    np.testing.assert_array_equal(found[0], 0.0)
    assert ((found <= inside * (1.0 + 1e-5)) & (found >= 0.0)).all()


@pytest.mark.parametrize(
    "more",
    [
        {"irradiance": image(random_map(5, 7)), "scale": 3.0},
        {"irradiance": image(random_map(5, 7)), "fov_axis": "y"},
        {"irradiance": {"type": "rgb", "value": [1.0, 2.0, 3.0]}, "fov": None, "focal_length": "40mm"},
    ],
    ids=["bitmap", "by the height", "focal length"],
)
def test_image_equals_mitsubas(more):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    described = scene_of(**more)
    described["lamp"] = {k: v for k, v in described["lamp"].items() if v is not None}
    scene = mi.load_dict(for_mitsuba(mi, described))
    ours = batches(psdr.load_dict(described), count=8, spp=16)
    images = np.stack([np.array(mi.render(scene, spp=16, seed=i)) for i in range(len(ours))]).astype(np.float64)
    assert_same_mean(blocks(ours, 4), blocks(images, 4), "projector", MITSUBA_ROUNDING)


def test_parameters_have_mitsubas_names_and_values():
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    described = scene_of(irradiance=image(random_map(5, 7)), scale=3.0)
    theirs = mi.traverse(mi.load_dict(for_mitsuba(mi, described), optimize=False))
    ours = psdr.traverse(psdr.load_dict(described))
    np.testing.assert_allclose(ours["lamp.irradiance.data"].numpy(), np.array(theirs["lamp.irradiance.data"]))
    np.testing.assert_allclose(ours["lamp.scale"].numpy(), 3.0)
    np.testing.assert_allclose(ours["lamp.x_fov"].numpy(), 35.0, rtol=1e-6)


@pytest.mark.parametrize(
    ("irradiance", "edge"),
    [
        ({"type": "rgb", "value": 1.0}, True),
        (image(random_map()), True),
        (image(framed(), filter_type="nearest"), True),
        (image(random_map(), to_uv=psdr.Transform.scale([2.0, 2.0, 1.0])), True),
        (image(framed()), False),
        (image(framed(), wrap_mode="clamp"), False),
    ],
    ids=["constant", "bitmap", "nearest", "to_uv", "black border", "clamped black border"],
)
def test_the_edge_of_an_image_is_named_unless_it_is_black(irradiance, edge):
    scene = psdr.load_dict(scene_of(size=4, irradiance=irradiance))
    params = psdr.traverse(scene)
    for name, moves in [("lamp.to_world", True), ("lamp.x_fov", edge), ("floor.to_world", True), ("lamp.scale", False)]:
        reasons = psdr.plan(scene, names=[name], integrator=psdr.PathIntegrator(max_depth=2)).discontinuities
        assert bool(reasons) == moves
        if name.startswith("lamp") and moves:
            assert ("edge of the projected image" in reasons[0]) == edge
    assert "lamp.irradiance.to_uv" not in params


@pytest.mark.parametrize(
    ("objects", "texture", "match"),
    [
        (
            {"floor": {"type": "rectangle", "bsdf": {"type": "conductor"}}},
            {"filter_type": "nearest"},
            "'nearest' texels .* beside smooth mirrors, glass",
        ),
        (
            {"mirror": {"type": "rectangle", "to_world": UPRIGHT, "bsdf": {"type": "conductor"}}},
            {},
            "where shapes run through each other",
        ),
        ({}, {"filter_type": "nearest", "to_uv": psdr.Transform.scale([2, 2, 1])}, "'nearest'.*to_uv"),
    ],
    ids=["mirror", "sunk mirror", "nearest through to_uv"],
)
def test_an_edge_without_a_term_is_refused(objects, texture, match):
    scene = psdr.load_dict(scene_of(size=4, irradiance=image(random_map(), **texture)) | objects)
    with pytest.raises(ValueError, match=match):
        psdr.plan(scene, names=["lamp.to_world"], integrator=psdr.PathIntegrator(max_depth=2))


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"focal_length": "50mm"}, "both 'fov' and 'focal_length'.*give one of them"),
        ({"fov": 180.0}, "parameter 'fov'.*between 0 and 180"),
        ({"scale": -1.0}, "parameter 'scale'.*at least 0"),
        ({"irradiance": {"type": "mesh_attribute", "name": "vertex_color"}}, "mesh_attribute.*a bitmap or a colour"),
        ({"to_world": psdr.Transform.scale([1.0, 2.0, 1.0])}, "stretches or shears"),
        ({"intensity": 2.0}, "no parameter 'intensity'"),
    ],
)
def test_bad_input_is_refused_with_a_remedy(more, words):
    with pytest.raises(ValueError, match=words) as caught:
        psdr.load_dict(scene_of(**more))
    assert "problems" not in str(caught.value)


@wp.kernel(module="unique", enable_backward=False)
def local_factors(d: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.float32)):
    i = wp.tid()
    x_axis, y_axis, z_axis = wp.vec3(1.0, 0.0, 0.0), wp.vec3(0.0, 1.0, 0.0), wp.vec3(0.0, 0.0, 1.0)
    a = wp.vec3(0.3, -0.7, 0.5)
    g_x, g_p, g_axis, g_e, _w, _a = wp.grad(projector_dot)(d[i], wp.vec3(0.0, 0.0, 0.0), z_axis, a, a, a)
    h_d, h_x, h_y, h_z, h_fov, _t, _uv = wp.grad(frame_dot)(d[i], x_axis, y_axis, z_axis, 178.0, 1.5, wp.vec2(1.0, 1.0))
    total = wp.length(g_x) + wp.length(g_p) + wp.length(g_axis) + wp.length(g_e)
    out[i] = total + wp.length(h_d) + wp.length(h_x) + wp.length(h_y) + wp.length(h_z) + wp.abs(h_fov)


def test_local_factors_are_finite_wherever_the_image_is_read():
    """On the axis, close by, far away and at the edge of the widest image."""
    d = [[0.0, 0.0, 1.0], [0.0, 0.0, 1e-6], [0.0, 0.0, 1e6], [57.0, 57.0, 1.0], [5.7e-2, 0.0, 1e-3]]
    out = wp.empty(len(d), dtype=wp.float32, device="cpu")
    wp.launch(local_factors, len(d), [wp.array(d, dtype=wp.vec3, device="cpu")], [out], device="cpu")
    assert np.isfinite(out.numpy()).all() and (out.numpy() > 0.0).all()
