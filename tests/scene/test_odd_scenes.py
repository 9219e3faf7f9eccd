"""Scenes at the edge of what makes sense: every pass returns finite numbers, and zeros only where they are right."""

import numpy as np
import pytest

import warp_psdr as psdr

#: Odd scenes are noted on load.
pytestmark = pytest.mark.filterwarnings("ignore::warp_psdr.SceneWarning")
LOOK = psdr.Transform.look_at
SKY = {"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 0.7, 0.9]}}
POINT = {"type": "point", "position": [0.5, 2.0, 3.0], "intensity": 5.0}
TRIANGLE = {
    "type": "mesh",
    "vertices": np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], np.float32),
    "faces": np.array([[0, 1, 2]]),
}
FLOOR = {"type": "rectangle", "to_world": psdr.Transform.translate((0, 0, -1.5)) @ psdr.Transform.scale(4)}
GLASS = {"type": "dielectric"}
MIRROR = {"type": "conductor", "material": "Au"}
GRADIENT_SKY = {"type": "envmap", "bitmap": np.linspace(0.0, 4.0, 96, dtype=np.float32).reshape(4, 8, 3)}


def ball(**more) -> dict:
    return {"type": "sphere", "resolution": 16} | more


def lamp(radiance: float = 4.0, **more) -> dict:
    return {"emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}}} | more


def rough(distribution: str, alpha: float) -> dict:
    return {"type": "roughconductor", "distribution": distribution, "alpha": alpha, "material": "Cu"}


#: name: (objects, whether anything is seen)
SCENES = {
    "mirrors only": ({"a": ball(bsdf=MIRROR), "b": FLOOR | {"bsdf": MIRROR}, "sky": GRADIENT_SKY}, True),
    "glass only": ({"a": ball(bsdf=GLASS), "b": TRIANGLE | {"bsdf": GLASS}, "sky": SKY}, True),
    "mirrors and a point light": ({"a": ball(bsdf=MIRROR), "lamp": POINT}, False),
    "mirrors and an area light": ({"a": FLOOR | {"bsdf": MIRROR}, "lamp": ball(**lamp())}, True),
    "no lights": ({"a": ball(), "b": FLOOR}, False),
    "no lights, all materials": (
        {"a": ball(bsdf=GLASS), "b": FLOOR | {"bsdf": rough("ggx", 0.2)}, "c": TRIANGLE | {"bsdf": MIRROR}},
        False,
    ),
    "constant environment alone": ({"sky": SKY}, True),
    "environment map alone": ({"sky": GRADIENT_SKY}, True),
    "black environment": (
        {"a": ball(), "sky": {"type": "envmap", "bitmap": np.zeros((2, 2, 3), np.float32)}},
        False,
    ),
    "unused materials": ({"a": ball(), "spare": rough("beckmann", 0.1), "other": GLASS, "sky": SKY}, True),
    "a single triangle": ({"a": TRIANGLE, "lamp": POINT}, True),
    "a single triangle that shines": ({"a": TRIANGLE | lamp()}, True),
    "an area light with smooth normals": ({"a": ball(**lamp()), "b": FLOOR}, True),
    "an area light with flipped normals": ({"a": ball(flip_normals=True, **lamp()), "b": FLOOR}, False),
    "a light of zero radiance": ({"a": ball(**lamp(0.0)), "b": FLOOR}, False),
    "lights of zero and of some radiance": ({"a": ball(**lamp(0.0)), "b": FLOOR, "lamp": POINT}, True),
    "a light that lies in a surface": ({"a": FLOOR | lamp(), "b": FLOOR | {"id": "other"}}, True),
    "a point light in a surface": ({"a": FLOOR, "lamp": POINT | {"position": [0.0, 0.0, -1.5]}}, None),
    "a point light on a vertex": ({"a": TRIANGLE, "lamp": POINT | {"position": [-1.0, -1.0, 0.0]}}, None),
    "black surfaces": ({"a": ball(bsdf={"type": "diffuse", "reflectance": 0.0}), "lamp": POINT}, False),
    "white surfaces": ({"a": FLOOR | {"bsdf": {"type": "diffuse", "reflectance": 1.0}}, "b": ball(), "sky": SKY}, True),
    "almost smooth metal": ({"a": ball(bsdf=rough("ggx", 1e-3)), "b": FLOOR | {"bsdf": rough("beckmann", 1e-3)},
                             "lamp": POINT, "sky": GRADIENT_SKY}, True),
    "matched glass": ({"a": ball(bsdf=GLASS | {"int_ior": 1.0, "ext_ior": 1.0}), "b": FLOOR, "sky": SKY}, True),
    "a speck far away": ({"a": ball(to_world=psdr.Transform.scale(1e-5)), "b": FLOOR, "sky": SKY}, True),
    "a vast scene": ({"a": ball(to_world=psdr.Transform.scale(1e6) @ psdr.Transform.translate((0, 0, -2))),
                      "lamp": POINT, "sky": SKY}, True),
}  # fmt: skip


def load(objects: dict, origin=(0.1, 0.2, 4.0), **camera):
    camera = {
        "type": "perspective",
        "to_world": LOOK(origin, (0, 0, 0)),
        "film": {"type": "hdrfilm", "width": 12, "height": 9, "rfilter": {"type": "box"}},
    } | camera
    return psdr.load_dict({"type": "scene", "camera": camera, **objects})


def all_passes(scene, **options) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the image and the gradients of everything, after checks that all passes are finite and agree."""
    integrator = psdr.PathIntegrator(max_depth=5, boundary=None, **options)
    params = psdr.traverse(scene)
    params.requires_grad("*")
    image = psdr.render(scene, integrator=integrator, spp=8).numpy()
    assert np.isfinite(image).all() and (image >= 0.0).all()
    rng = np.random.default_rng(0)
    adjoint = rng.standard_normal((9, 12, 3)).astype(np.float32)
    psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=8)
    gradients = {name: params[name].grad.numpy().astype(np.float64) for name in params}
    assert [name for name, g in gradients.items() if not np.isfinite(g).all()] == []
    tangents = {name: rng.standard_normal(g.shape).astype(np.float32) for name, g in gradients.items()}
    forward = psdr.render_forward(scene, params, tangents, integrator=integrator, spp=8).numpy().astype(np.float64)
    assert np.isfinite(forward).all()
    # <J v, w> = <v, J' w>, up to float32 rounding of sums whose terms are as large as the scale says.
    products = [g * tangents[name] for name, g in gradients.items()]
    scale = sum(np.abs(p).sum() for p in products) + np.abs(forward * adjoint).sum()
    assert abs((forward * adjoint).sum() - sum(p.sum() for p in products)) <= 1e-3 * scale
    return image, gradients


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_every_pass_is_finite(name: str) -> None:
    objects, seen = SCENES[name]
    image, _ = all_passes(load(objects))
    assert seen is None or np.any(image > 0.0) == seen


@pytest.mark.slow
@pytest.mark.parametrize(
    "inside", ["diffuse", *(pytest.param(n, marks=pytest.mark.slow) for n in ("glass", "shining"))]
)
def test_a_camera_inside_a_mesh(inside: str) -> None:
    shape = {
        "diffuse": ball(bsdf={"type": "twosided", "a": {"type": "diffuse"}}),
        "glass": ball(bsdf=GLASS),
        "shining": ball(flip_normals=True, **lamp(2.0)),
    }[inside]
    lights = {"lamp": POINT | {"position": [0.3, 0.4, 0.2]}, "sky": GRADIENT_SKY}
    image, _ = all_passes(load({"a": shape} | lights, origin=(0.05, 0.1, 0.5)))
    assert np.all(image.sum(axis=2) > 0.0)


@pytest.mark.slow
def test_a_camera_on_a_surface_and_one_behind_everything() -> None:
    all_passes(load({"a": FLOOR, "sky": SKY}, to_world=LOOK((0, 0, -1.5), (0, 0, 3))))
    image, _ = all_passes(load({"a": FLOOR, "lamp": POINT}, to_world=LOOK((0, 0, 9), (0, 0, 20))))
    assert not image.any()


@pytest.mark.slow
def test_a_light_of_zero_radiance_has_its_derivative() -> None:
    _, dark = all_passes(load({"a": ball(**lamp(0.0)), "b": FLOOR}))
    _, bright = all_passes(load({"a": ball(**lamp(3.0)), "b": FLOOR}))
    name = "a.emitter.radiance.value"
    assert np.all(dark[name] != 0.0)
    # The image is linear in the radiance, and paths and random numbers are the same.
    np.testing.assert_allclose(dark[name], bright[name], rtol=1e-4)


@pytest.mark.slow
def test_a_black_surface_has_its_derivative() -> None:
    black = {"a": FLOOR | {"bsdf": {"type": "diffuse", "reflectance": 0.0}}, "lamp": POINT}
    _, gradients = all_passes(load(black))
    assert np.any(gradients["a.bsdf.reflectance.value"] != 0.0)


def test_an_unused_material_is_not_compiled_in() -> None:
    plain = psdr.plan(load({"a": ball(), "sky": SKY})).config
    assert psdr.plan(load({"a": ball(), "spare": GLASS, "sky": SKY})).config == plain


@pytest.mark.slow
@pytest.mark.parametrize("depth", [1, 2])
def test_shallow_paths(depth: int) -> None:
    objects = {"a": ball(bsdf=GLASS), "b": FLOOR, "c": TRIANGLE | lamp(), "sky": GRADIENT_SKY}
    integrator = psdr.PathIntegrator(max_depth=depth, boundary=None)
    scene = load(objects)
    params = psdr.traverse(scene)
    params.requires_grad("*")
    psdr.render_backward(scene, params, np.ones((9, 12, 3)), integrator=integrator, spp=4)
    assert all(np.isfinite(params[name].grad.numpy()).all() for name in params)
    assert np.any(params["c.emitter.radiance.value"].grad.numpy() != 0.0)


def test_no_light_path_is_joined_where_nothing_scatters_it_to_the_camera() -> None:
    """A point light that meets mirrors alone: there was no kernel that its paths could end in."""
    camera = {"type": "perspective", "to_world": LOOK((0, 0, 5), (0, 0, 0), (0, 1, 0))}
    scene = psdr.load_dict({"type": "scene", "camera": camera, "a": ball(bsdf=MIRROR), "lamp": POINT})
    assert psdr.plan(scene, integrator=psdr.PathIntegrator(max_depth=4)).light is None
    with pytest.raises(ValueError, match="caustics=True: light tracing finds no surface that scatters light"):
        psdr.plan(scene, integrator=psdr.PathIntegrator(max_depth=4, caustics=True))
