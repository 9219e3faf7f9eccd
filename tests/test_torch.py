"""PyTorch: the same image and the same gradients as without it, in PyTorch's graph."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.networks import Net, fitted
from tests.networks import sphere as ball

WALL, SKY = "wall.bsdf.reflectance.value", "sky.radiance.value"
POSE, VERTICES = "wall.to_world", "wall.vertex_positions"
OPTIONS = {"spp": 8, "seed": 3}
KEYS = ("weight", "bias")
#: Rounding of float32 sums over the pixels, relative to the largest entry.
ROUNDING = 1e-5


def wall_and_sky(torch, wall) -> dict:
    """Return what a scene takes of both, which are differentiated together, as in ``test_render_arguments.py``."""
    return {WALL: wall, SKY: torch.tensor([1.0, 1.5, 2.0], requires_grad=True)}


@pytest.fixture
def scene():
    camera = {"type": "perspective", "fov": 40, "to_world": psdr.Transform.look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])}
    film = {"type": "hdrfilm", "width": 8, "height": 6, "rfilter": {"type": "box"}}
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.8]}}
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 1.5, 2.0]}}
    return psdr.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "camera": {**camera, "film": film},
            "wall": {"type": "rectangle", "bsdf": bsdf},
            "sky": sky,
        }
    )


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
    psdr.torch.render(scene, wall_and_sky(torch, alone), **OPTIONS).square().sum().backward()
    images = [psdr.torch.render(scene, wall_and_sky(torch, tensor), **OPTIONS) for tensor in (first, second)]
    sum(image.square().sum() for image in images).backward()
    np.testing.assert_array_equal(first.grad.numpy(), alone.grad.numpy())
    assert not np.array_equal(second.grad.numpy(), first.grad.numpy())
    # The scene still holds what it was last given.
    np.testing.assert_array_equal(psdr.traverse(scene)[WALL].numpy(), np.float32([0.7, 0.7, 0.7]))


@pytest.mark.parametrize("asked", [WALL, *(pytest.param(n, marks=pytest.mark.slow) for n in (POSE, VERTICES))])
def test_gradients_are_those_of_the_values_that_were_rendered(scene, asked) -> None:
    """A posed shape's vertices are values of their own: an edit between the image and its gradient does not count."""
    torch = pytest.importorskip("torch")
    params = psdr.traverse(scene)
    tensor = torch.tensor(params[asked].numpy(), requires_grad=True)
    gradients = []
    for edited in (False, True):
        given = wall_and_sky(torch, tensor) if asked == WALL else {asked: tensor}
        image = psdr.torch.render(scene, given, **OPTIONS)
        if edited:
            params[VERTICES] = 0.3 * params[VERTICES].numpy() + np.float32([0.2, 0.1, 0.0])
            params.update()
        shown = psdr.render(scene, **OPTIONS).numpy()
        (gradient,) = torch.autograd.grad(image.square().sum(), tensor)
        gradients.append(gradient.numpy())
        np.testing.assert_array_equal(psdr.render(scene, **OPTIONS).numpy(), shown)
    assert np.abs(gradients[0]).max() > 0.0
    np.testing.assert_array_equal(*gradients)


@pytest.mark.slow
def test_far_scenes_keep_the_digits_of_double_precision() -> None:
    torch = pytest.importorskip("torch")
    place = np.array([1.0e6, 0.0, 0.0])
    pose = psdr.Transform.look_at(list(place + np.array([0.0, 0.0, 3.0])), list(place), [0, 1, 0])
    nodes = {
        "camera": {"type": "perspective", "to_world": pose, "film": {"type": "hdrfilm", "width": 8, "height": 6}},
        "wall": {"type": "rectangle", "to_world": psdr.Transform.translate(list(place))},
        "sky": {"type": "constant"},
    }
    with pytest.warns(psdr.SceneWarning, match="far from the origin"):
        far = psdr.load_dict({"type": "scene", **nodes})
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) + place
    camera = far.values.numpy().copy()
    moved = corners + np.array([1.0e-3, 0.0, 0.0])
    tensor = torch.tensor(moved, requires_grad=True)
    image = psdr.torch.render(far, {VERTICES: tensor}, **OPTIONS)
    held = far.values.numpy().copy()
    psdr.torch.render(far, {VERTICES: torch.tensor(corners)}, **OPTIONS)
    p = far.parameters[VERTICES]
    np.testing.assert_allclose(held[p.offset : p.offset + p.size].reshape(-1, 3), moved - far.origin, atol=1e-6)
    image.sum().backward()
    assert tensor.grad.dtype == torch.float64
    assert tensor.grad.abs().max() > 0.0
    np.testing.assert_array_equal(far.values.numpy(), camera)


def test_an_error_in_backward_leaves_the_scene_as_it_was(scene) -> None:
    torch = pytest.importorskip("torch")
    first, second = (torch.full((3,), value, requires_grad=True) for value in (0.2, 0.7))
    image = psdr.torch.render(scene, {WALL: first}, **OPTIONS)
    psdr.torch.render(scene, {WALL: second}, **OPTIONS)
    with pytest.raises(ValueError, match="NaN or infinite"):
        image.backward(torch.full_like(image, float("nan")))
    np.testing.assert_array_equal(psdr.traverse(scene)[WALL].numpy(), np.float32([0.7, 0.7, 0.7]))


def test_values_written_in_place_are_followed(scene) -> None:
    torch = pytest.importorskip("torch")
    corners = psdr.traverse(scene)[VERTICES]
    corners.assign(0.3 * corners.numpy())
    image = psdr.torch.render(scene, {WALL: torch.full((3,), 0.5)}, **OPTIONS)
    psdr.traverse(scene).update(VERTICES)
    np.testing.assert_array_equal(image.numpy(), psdr.render(scene, **OPTIONS).numpy())


# By torch itself, as it loads its forward mode: a DeprecationWarning up to release 2.13, a FutureWarning from 2.14 on.
@pytest.mark.filterwarnings("ignore:.torch.jit.script. is (deprecated|not supported in Python 3):DeprecationWarning")
@pytest.mark.filterwarnings("ignore:.torch.jit.script. is (deprecated|not supported in Python 3):FutureWarning")
def test_forward_mode_is_render_forward(scene) -> None:
    torch = pytest.importorskip("torch")
    fwd = torch.autograd.forward_ad
    with fwd.dual_level():
        directions = {WALL: [1.0, 0.0, 2.0], SKY: [0.0, 1.0, 0.5]}
        duals = {n: fwd.make_dual(torch.full((3,), 0.5), torch.tensor(d)) for n, d in directions.items()}
        tangent = fwd.unpack_dual(psdr.torch.render(scene, duals, **OPTIONS)).tangent
    expected = psdr.render_forward(scene, psdr.traverse(scene), directions, **OPTIONS).numpy()
    assert np.abs(expected).max() > 0.0
    np.testing.assert_array_equal(tangent.numpy(), expected)


def test_second_derivatives_are_refused(scene) -> None:
    torch = pytest.importorskip("torch")
    albedo = torch.full((3,), 0.5, requires_grad=True)
    image = psdr.torch.render(scene, {WALL: albedo}, **OPTIONS)
    with pytest.raises(RuntimeError, match="no second derivatives"):
        torch.autograd.grad(image.square().sum(), albedo, create_graph=True)


def test_tensors_of_any_floating_type_may_change_in_place_afterwards(scene) -> None:
    torch = pytest.importorskip("torch")
    albedo = torch.full((3,), 0.5, dtype=torch.bfloat16, requires_grad=True)
    image = psdr.torch.render(scene, wall_and_sky(torch, albedo), **OPTIONS)
    with torch.no_grad():
        albedo.zero_()
    image.sum().backward()
    assert albedo.grad.dtype == torch.bfloat16
    assert albedo.grad.float().min() > 0.0


@pytest.mark.slow
def test_only_an_image_is_wanted_without_grad(scene) -> None:
    """What cannot be differentiated can be rendered."""
    torch = pytest.importorskip("torch")
    pose = torch.eye(4, requires_grad=True)
    options = {**OPTIONS, "integrator": psdr.PathIntegrator(max_depth=20, boundary=psdr.boundary.EdgeSampling())}
    mirror = psdr.load_dict(
        {
            "type": "scene",
            "camera": {"type": "perspective", "to_world": psdr.Transform.look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])},
            "wall": {"type": "cube", "bsdf": {"type": "conductor"}},
            "sky": {"type": "constant"},
        }
    )
    with pytest.raises(ValueError, match=r"EdgeSampling.*cannot estimate"):
        psdr.torch.render(mirror, {POSE: pose}, **options)
    with torch.no_grad():
        assert not psdr.torch.render(mirror, {POSE: pose}, **options).requires_grad


@pytest.mark.slow
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
        psdr.torch.render(scene, {POSE: torch.eye(4), VERTICES: torch.zeros(4, 3)}, **OPTIONS)
    with pytest.raises(KeyError, match=r"did you mean 'wall\.vertex_positions'"):
        psdr.torch.render(scene, {"wal.vertex_positions": torch.zeros(4, 3)}, **OPTIONS)
    with pytest.raises(ValueError, match="spp_grad"):
        psdr.torch.render(scene, {WALL: torch.zeros(3, requires_grad=True)}, spp_grad=0, **OPTIONS)
    with pytest.raises(TypeError, match="integrator"):
        psdr.torch.render(scene, {WALL: torch.zeros(3, requires_grad=True)}, integrator=3, **OPTIONS)
    with pytest.raises(TypeError, match="expected tensors by name"):
        psdr.torch.render(scene, [torch.zeros(3)], **OPTIONS)


@pytest.mark.slow
def test_an_optimiser_of_torch_moves_a_network() -> None:
    """A module's weights are what a ``neuralsdf`` is, their gradients those of ``render_backward``, to the bit."""
    torch = pytest.importorskip("torch")
    held = fitted(ball, (24,))
    module = torch.nn.Sequential(torch.nn.Linear(3, 24), torch.nn.Softplus(beta=10.0), torch.nn.Linear(24, 1))
    linear = [module[0], module[2]]
    with torch.no_grad():
        for layer, (weight, bias) in zip(linear, held.layers, strict=True):
            layer.weight.copy_(torch.from_numpy(weight))
            layer.bias.copy_(torch.from_numpy(bias))
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    view = psdr.Transform.look_at([0.5, 0.5, 2.5], [0.5, 0.5, 0.5], [0, 1, 0])
    scene = psdr.load_dict(
        {
            "type": "scene",
            "camera": {"type": "perspective", "fov": 40, "to_world": view, "film": film},
            "body": held.plugin(bsdf={"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}),
            "sky": {"type": "constant"},
        }
    )
    tensors = {f"body.layer{n}.{key}": getattr(layer, key) for n, layer in enumerate(linear) for key in KEYS}
    options = {"spp": 16, "seed": 2, "integrator": psdr.PathIntegrator(max_depth=1)}
    optimiser = torch.optim.SGD(module.parameters(), lr=1e-3)
    losses = []
    for _step in range(3):
        optimiser.zero_grad()
        loss = psdr.torch.render(scene, tensors, **options).square().mean()  # a larger black shape has a smaller one
        loss.backward()
        losses.append(loss.item())
        optimiser.step()

    params = psdr.traverse(scene)
    params.requires_grad(*tensors)
    image = psdr.render(scene, **options).numpy()
    psdr.render_backward(scene, params, 2.0 / image.size * image, **options)
    for name, tensor in tensors.items():
        assert tensor.grad.abs().max() > 0.0
        np.testing.assert_array_equal(tensor.grad.numpy(), params[name].grad.numpy())
    assert losses[2] < losses[1] < losses[0]
    x = np.random.default_rng(1).random((50, 3))
    now = Net([(layer.weight.detach().numpy(), layer.bias.detach().numpy()) for layer in linear], 0, False, 10.0)
    expected = module(torch.from_numpy(x.astype(np.float32))).detach().numpy()[:, 0]
    np.testing.assert_allclose(now.phi(x), expected, atol=1e-5)


def test_several_cameras_have_the_sum_of_their_gradients() -> None:
    """Side by side on the film of a batch, and in a stack."""
    torch = pytest.importorskip("torch")
    film = {"type": "hdrfilm", "width": 8, "height": 6, "rfilter": {"type": "box"}}
    eyes = {"a": [0, 0, 3], "b": [1, 0, 2]}
    cameras = {
        name: {"type": "perspective", "film": film, "to_world": psdr.Transform.look_at(eye, [0, 0, 0], [0, 1, 0])}
        for name, eye in eyes.items()
    }
    rig = {"type": "batch", "film": {**film, "width": 16}, **cameras}
    node = {"integrator": {"type": "path", "max_depth": 2}, "rig": rig, "wall": {"type": "rectangle"}}
    both = psdr.load_dict({"type": "scene", **node, "sky": {"type": "constant"}})
    weights = torch.from_numpy(np.random.default_rng(0).normal(size=(2, 6, 8, 3)).astype(np.float32))

    def gradient(sensor, factors):
        albedo = torch.tensor([0.5], requires_grad=True)
        image = psdr.torch.render(both, {WALL: albedo}, sensor=sensor, **OPTIONS)
        (factors * image).sum().backward()
        return image.detach(), albedo.grad

    images, alone = zip(*(gradient(f"rig.{name}", weights[i]) for i, name in enumerate(eyes)), strict=True)
    stack, of_stack = gradient(["rig.a", "rig.b"], weights)
    beside, of_batch = gradient("rig", torch.cat(tuple(weights), dim=1))
    assert stack.shape == (2, 6, 8, 3) and beside.shape == (6, 16, 3)
    assert torch.equal(stack, torch.stack(images)) and torch.equal(beside, torch.cat(images, dim=1))
    assert all(torch.any(g != 0.0) for g in alone)
    torch.testing.assert_close(of_stack, sum(alone))
    torch.testing.assert_close(of_batch, sum(alone))


@pytest.mark.filterwarnings("ignore:The .grad attribute")  # PyTorch's own, of the tensors where a graph breaks
def test_torch_compile_leaves_the_call_alone(scene) -> None:
    """Its graphs break there, without tracing into Warp: no warning, and a seed more compiles nothing anew."""
    torch = pytest.importorskip("torch")

    def loss(raw, seed):
        image = psdr.torch.render(scene, wall_and_sky(torch, torch.sigmoid(raw)), spp=8, seed=seed)
        return (2.0 * image).square().mean()

    compiled = torch.compile(loss, backend="aot_eager")
    for seed in range(3):
        found = []
        for function in (loss, compiled):
            raw = torch.tensor([0.1, 0.2, 0.3], requires_grad=True)
            value = function(raw, seed)
            value.backward()
            found += [value.detach(), raw.grad]
        torch.testing.assert_close(found[2:], found[:2])
        assert found[1].abs().min() > 0.0
