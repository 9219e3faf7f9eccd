"""Spot lights that project a bitmap: Mitsuba's image, derivatives against differences, and what is refused."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.emitter.helpers import floor_under, ramps, random_map
from tests.path.helpers import assert_same_mean, batches, blocks
from tests.peer import MITSUBA_ROUNDING, for_mitsuba

#: Step of the four-point central differences, and their error relative to the largest one: falloffs begin in kinks.
STEP, DIFFERENCE_TOLERANCE = 1e-2, 2e-3


def scene_of(image, size=16, **spot):
    texture = {"type": "bitmap", "bitmap": image, "raw": True}
    intensity = {"type": "rgb", "value": [9.0, 6.0, 3.0]}
    light = {"type": "spot", "cutoff_angle": 28.0, "intensity": intensity, "texture": texture}
    return floor_under(light | spot, size)


@pytest.mark.parametrize("to_uv", [None, psdr.Transform.rotate([0.0, 0.0, 1.0], 30.0).scale([2.0, 1.0, 1.0])])
def test_image_equals_mitsubas(to_uv):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    described = scene_of(random_map(5, 7))
    theirs = for_mitsuba(mi, described)
    if to_uv is not None:
        described["lamp"]["texture"]["to_uv"] = to_uv
        theirs["lamp"]["texture"]["to_uv"] = mi.ScalarTransform4f(to_uv.matrix)
    scene = mi.load_dict(theirs)
    ours = batches(psdr.load_dict(described), count=8, spp=16)
    images = np.stack([np.array(mi.render(scene, spp=16, seed=i)) for i in range(len(ours))]).astype(np.float64)
    assert_same_mean(blocks(ours, 4), blocks(images, 4), "textured spot", MITSUBA_ROUNDING)


def test_parameters_have_mitsubas_names_and_values():
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    described = scene_of(random_map(5, 7))
    theirs = mi.traverse(mi.load_dict(for_mitsuba(mi, described), optimize=False))
    ours = psdr.traverse(psdr.load_dict(described))
    np.testing.assert_allclose(ours["lamp.texture.data"].numpy(), np.array(theirs["lamp.texture.data"]))


@pytest.fixture(scope="module")
def lit():
    """A scene, its parameters and directions in which they move."""
    scene = psdr.load_dict(scene_of(ramps(), size=8))
    params = psdr.traverse(scene)
    rng = np.random.default_rng(1)
    pose = np.zeros((4, 4))
    pose[:3] = rng.normal(size=(3, 4)) * 0.2
    directions = {
        "lamp.texture.data": rng.normal(size=ramps().shape),
        "lamp.intensity.value": np.array([1.0, -2.0, 3.0]),
        "lamp.to_world": pose,
        "lamp.cutoff_angle": np.ones(1),
    }
    params.requires_grad(*directions)
    return scene, params, directions


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lamp.texture.data", "lamp.intensity.value", "lamp.to_world", "lamp.cutoff_angle"])
def test_derivatives_equal_differences(lit, name):
    scene, params, directions = lit
    options = {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 64}
    zeros = {other: np.zeros_like(direction) for other, direction in directions.items()}
    tangents = {**zeros, name: directions[name]}
    start, step = params[name].numpy().copy(), STEP * (30.0 if name == "lamp.cutoff_angle" else 1.0)

    def image(h, seed):
        params[name] = (start + h * directions[name]).astype(np.float32)
        params.update()
        return psdr.render(scene, params, seed=seed, **options).numpy().astype(np.float64)

    forward, differences = [], []
    for seed in range(8):
        forward.append(psdr.render_forward(scene, params, tangents=tangents, seed=seed, **options).numpy())
        near, far = (image(h, seed) - image(-h, seed) for h in (step, 2.0 * step))
        differences.append((8.0 * near - far) / (12.0 * step))
        image(0.0, seed)
    forward, differences = (np.asarray(x, np.float64) for x in (forward, differences))
    scale = np.abs(differences.mean(axis=0)).max()
    assert scale > 1e-3
    assert_same_mean(blocks(forward, 4) / scale, blocks(differences, 4) / scale, name, DIFFERENCE_TOLERANCE)


@pytest.mark.slow
def test_reverse_and_forward_agree(lit):
    scene, params, directions = lit
    options = {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 16, "seed": 3}
    adjoint = np.random.default_rng(2).normal(size=(8, 8, 3)).astype(np.float32)
    forward = psdr.render_forward(scene, params, tangents=directions, **options).numpy().astype(np.float64)
    psdr.render_backward(scene, params, adjoint, **options)
    reverse = sum((params[name].grad.numpy().astype(np.float64) * v).sum() for name, v in directions.items())
    assert reverse == pytest.approx((forward * adjoint).sum(), rel=1e-4)


@pytest.mark.parametrize(
    ("texture", "words"),
    [
        ({"type": "rgb", "value": 0.5}, "a constant texture.*give a bitmap"),
        ({"type": "bitmap", "bitmap": random_map(), "filter_type": "nearest"}, "'nearest'.*'bilinear'"),
        ({"type": "bitmap", "filename": "none.png"}, "no such file: 'none.png'"),
        ({"type": "mesh_attribute", "name": "vertex_color"}, "a mesh_attribute texture"),
    ],
)
def test_other_textures_are_refused(texture, words):
    with pytest.raises((ValueError, FileNotFoundError), match=words) as caught:
        psdr.load_dict(scene_of(random_map(), texture=texture))
    assert "problems" not in str(caught.value)
