"""PyTorch: the same image and the same gradients as without it, in PyTorch's graph."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import warp_psdr as psdr

ROOT = Path(__file__).resolve().parents[1]
WALL, SKY = "wall.bsdf.reflectance.value", "sky.radiance.value"
OPTIONS = {"spp": 8, "seed": 3}
#: Rounding of float32 sums over the pixels, relative to the largest entry.
ROUNDING = 1e-5


@pytest.fixture
def scene():
    camera = {"type": "perspective", "fov": 40, "to_world": psdr.Transform.look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])}
    film = {"type": "hdrfilm", "width": 8, "height": 6, "rfilter": {"type": "box"}}
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.8]}}
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 1.5, 2.0]}}
    return psdr.load_dict(
        {"type": "scene", "camera": {**camera, "film": film}, "wall": {"type": "rectangle", "bsdf": bsdf}, "sky": sky}
    )


def test_without_torch_the_error_says_what_to_install() -> None:
    code = "import sys; sys.modules['torch'] = None\nimport warp_psdr\nwarp_psdr.torch"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "pip install torch" in done.stderr


def test_gradients_are_those_of_render_backward(scene) -> None:
    torch = pytest.importorskip("torch")
    albedo = torch.tensor([0.3, 0.4, 0.5], dtype=torch.float64, requires_grad=True)
    sky = torch.tensor([1.0, 1.0, 2.0], requires_grad=True)
    image = psdr.torch.render(scene, {WALL: albedo, SKY: sky}, **OPTIONS)
    assert image.shape == (6, 8, 3)
    assert image.dtype == torch.float32
    weights = torch.from_numpy(np.random.default_rng(0).normal(size=(6, 8, 3)).astype(np.float32))
    (weights * image).sum().backward()

    params = psdr.traverse(scene)
    params.requires_grad(WALL, SKY)
    np.testing.assert_array_equal(params[WALL].numpy(), np.float32([0.3, 0.4, 0.5]))
    np.testing.assert_array_equal(image.detach().numpy(), psdr.render(scene, **OPTIONS).numpy())
    psdr.render_backward(scene, params, weights.numpy(), **OPTIONS)
    for name, tensor in ((WALL, albedo), (SKY, sky)):
        expected = params[name].grad.numpy()
        assert np.abs(expected).min() > 0.0
        assert tensor.grad.dtype == tensor.dtype
        np.testing.assert_allclose(tensor.grad.numpy(), expected, rtol=0, atol=ROUNDING * np.abs(expected).max())


def test_two_images_of_one_scene_do_not_mix(scene) -> None:
    torch = pytest.importorskip("torch")
    alone, first, second = (torch.full((3,), value, requires_grad=True) for value in (0.2, 0.2, 0.7))
    psdr.torch.render(scene, {WALL: alone}, **OPTIONS).square().sum().backward()
    images = [psdr.torch.render(scene, {WALL: tensor}, **OPTIONS) for tensor in (first, second)]
    sum(image.square().sum() for image in images).backward()
    np.testing.assert_array_equal(first.grad.numpy(), alone.grad.numpy())
    assert not np.array_equal(second.grad.numpy(), first.grad.numpy())
    # The scene still holds what it was last given.
    np.testing.assert_array_equal(psdr.traverse(scene)[WALL].numpy(), np.float32([0.7, 0.7, 0.7]))


def test_only_what_requires_a_gradient_gets_one(scene) -> None:
    torch = pytest.importorskip("torch")
    albedo, sky = torch.full((3,), 0.5), torch.ones(3, requires_grad=True)
    psdr.torch.render(scene, {WALL: albedo, SKY: sky}, **OPTIONS).sum().backward()
    assert albedo.grad is None
    assert sky.grad.abs().min() > 0.0
    assert not psdr.torch.render(scene, {WALL: albedo}, **OPTIONS).requires_grad


def test_mistakes_are_named(scene) -> None:
    torch = pytest.importorskip("torch")
    with pytest.raises(TypeError, match="expected a floating-point tensor"):
        psdr.torch.render(scene, {WALL: np.zeros(3)}, **OPTIONS)
    with pytest.raises(ValueError, match=r"got shape \(2,\)"):
        psdr.torch.render(scene, {WALL: torch.zeros(2)}, **OPTIONS)
    with pytest.raises(KeyError, match="no parameter 'wall'"):
        psdr.torch.render(scene, {"wall": torch.zeros(3)}, **OPTIONS)
    with pytest.raises(ValueError, match="leave one of them out"):
        psdr.torch.render(scene, {"a.to_world": torch.eye(4), "a.vertex_positions": torch.zeros(3, 3)}, **OPTIONS)
