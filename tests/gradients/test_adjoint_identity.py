"""<Jv, w> = <v, J'w>: forward and reverse mode are transposes of each other, for every parameter of rich scenes."""

import functools

import numpy as np
import pytest

import warp_psdr as psdr

from . import measure, scenes

SIZE, SPP, DEPTH = 16, 16, 5
#: Both sides are float32 sums of the same terms in another order. Relative to the product of the norms, which bounds
#: what cancels: sums of some 10^4 terms lose up to 10^2 of float32's 6e-8 each.
ROUNDING = 2e-5


def room(bsdf, *more):
    """A floor, a textured wall, a ball of the given material, and every kind of light."""
    t = psdr.Transform
    checker = {"type": "bitmap", "bitmap": scenes.noise(5, 7, 3, seed=8), "to_uv": t.rotate([0, 0, 1], 20)}
    turn = t.translate([0, 3, 0]) @ t.rotate([1, 0, 0], 90)
    glow = {"type": "bitmap", "bitmap": scenes.noise(3, 4, 3, high=5.0, seed=9)}
    scene = {
        "type": "scene",
        "sensor": scenes.camera([0, 1, 5], [0, 0, 0], rfilter="gaussian", size=SIZE),
        "floor": {
            "type": "rectangle",
            "to_world": t.translate([0, -1, 0]) @ t.rotate([1, 0, 0], -90) @ t.scale(4),
            "bsdf": {"type": "twosided", "nested": {"type": "diffuse", "reflectance": checker}},
        },
        "light": {
            "type": "rectangle",
            "to_world": turn,
            "bsdf": {"type": "diffuse", "reflectance": 0.4},
            "emitter": {"type": "area", "radiance": glow},
        },
        "env": scenes.environment(),
        "point": {"type": "point", "position": [1, 2, 2], "intensity": scenes.rgb(3, 2, 1)},
        "spot": {
            "type": "spot",
            "to_world": t.look_at([-2, 2, 2], [0, 0, 0], [0, 1, 0]),
            "intensity": scenes.rgb(6, 2, 1),
        },
        "sun": {"type": "directional", "direction": [0.3, -1, -0.2], "irradiance": scenes.rgb(0.5, 0.2, 0.1)},
        "ball": {"type": "sphere", "resolution": 12, "bsdf": bsdf},
    }
    for i, shape in enumerate(more):
        scene[f"more{i}"] = shape
    return scene


def small(type_, x, bsdf, **options):
    return {
        "type": type_,
        "to_world": psdr.Transform.translate([x, 0, 0.3]) @ psdr.Transform.scale(0.35),
        "bsdf": bsdf,
        **options,
    }


def ticket():
    """A mesh with a vertex attribute for its colour, another one for its light, and computed normals."""
    scene = scenes.ball(False, subdivisions=1, bsdf={"type": "diffuse"})
    scene["vertices"] = 0.4 * scene["vertices"] + np.array([-1.5, 0.2, 0.0], np.float32)
    scene["vertex_paint"] = scenes.noise(len(scene["vertices"]), 3, seed=10)
    scene["vertex_glow"] = scenes.noise(len(scene["vertices"]), 3, seed=11)
    scene["bsdf"]["reflectance"] = {"type": "mesh_attribute", "name": "vertex_paint"}
    scene["emitter"] = {"type": "area", "radiance": {"type": "mesh_attribute", "name": "vertex_glow"}}
    return scene


ROOMS = {
    "glass and mirror": lambda: room(
        {"type": "dielectric", "int_ior": 1.4}, small("cube", 1.6, {"type": "conductor", "material": "Au"})
    ),
    "rough": lambda: room({"type": "roughconductor", "material": "Cu", "alpha": 0.2, "distribution": "ggx"}, ticket()),
    "anisotropic": lambda: room(
        {"type": "roughconductor", "material": "Al", "alpha_u": 0.3, "alpha_v": 0.1},
        small("disk", 1.6, {"type": "diffuse"}, face_normals=True),
    ),
}
INTEGRATOR = psdr.PathIntegrator(max_depth=DEPTH, boundary=None, rr_depth=3)
#: A scene of the table, whose gradient is by the table's kernel; and the depth there.
OF_THE_TABLE, TABLE_DEPTH = "plane", 3


def integrator_of(name):
    return measure.integrator(TABLE_DEPTH) if name == OF_THE_TABLE else INTEGRATOR


@functools.cache
def gradients(name):
    """Scene, parameters, adjoint, and the gradient of every parameter."""
    scene, params = scenes.load(name) if name == OF_THE_TABLE else loaded(name)
    params.requires_grad_only("*")
    size = scenes.SIZE if name == OF_THE_TABLE else SIZE
    w = np.random.default_rng(0).normal(size=(size, size, 3)).astype(np.float32)
    psdr.render_backward(scene, params, w, integrator=integrator_of(name), spp=SPP)
    return scene, params, w, {n: params[n].grad.numpy().astype(np.float64) for n in params}


def loaded(name):
    scene = psdr.load_dict(ROOMS[name]())
    return scene, psdr.traverse(scene)


@pytest.mark.slow
@pytest.mark.parametrize("name", [OF_THE_TABLE, *ROOMS])
def test_forward_and_reverse_mode_are_adjoint(name):
    scene, params, w, grads = gradients(name)
    silent = []
    for n, gradient in grads.items():
        v = np.random.default_rng(len(n)).normal(size=gradient.shape).astype(np.float32)
        tangents = dict.fromkeys(params, 0.0) | {n: v}
        image = psdr.render_forward(scene, params, tangents, integrator=integrator_of(name), spp=SPP)
        image = image.numpy().astype(np.float64)
        left, right = (image * w).sum(), (gradient * v).sum()
        bound = ROUNDING * max(np.linalg.norm(image) * np.linalg.norm(w), np.linalg.norm(gradient) * np.linalg.norm(v))
        assert np.isfinite(left) and abs(left - right) <= bound, (n, left, right, bound)
        if not gradient.any():
            silent.append(n)
            assert not image.any()
    # Texture coordinates of shapes without a bitmap do not reach the image; everything else has to.
    assert not [n for n in silent if not n.endswith("vertex_texcoords")], silent


def gradient_alone(name, parameter):
    """Return the gradient of a parameter by kernels that compile nothing else, which is what it is among all."""
    _scene, _params, w, grads = gradients(name)
    scene, params = loaded(name)
    params.requires_grad(parameter)
    psdr.render_backward(scene, params, w, integrator=INTEGRATOR, spp=SPP)
    gradient = params[parameter].grad.numpy()
    assert np.linalg.norm(gradient - grads[parameter]) <= ROUNDING * np.linalg.norm(grads[parameter]), parameter
    return gradient


@pytest.mark.slow
@pytest.mark.parametrize("parameter", ["vertex_positions", "reflectance.data"])
@pytest.mark.parametrize("name", ["rough", pytest.param("glass and mirror", marks=pytest.mark.slow)])
def test_what_is_not_traced_for_one_shape_does_not_matter(name, parameter):
    """A gradient that one shape alone needs leaves out light that the shape cannot turn: it equals the whole one's."""
    scene, params, _w, _grads = gradients(name)
    one = next(n for n in params if n.endswith(parameter) and not n.startswith("light"))
    plan = psdr.plan(scene, names=[one], integrator=INTEGRATOR)
    assert plan.shapes is not None and len(plan.shapes) == 1
    assert gradient_alone(name, one).any()


@pytest.mark.slow
def test_texture_coordinates_of_a_light_alone():
    assert gradient_alone("rough", "light.vertex_texcoords").any()


@pytest.mark.slow
@pytest.mark.parametrize("name", ROOMS)
def test_every_parameter_alone(name):
    """One of every kind, and all that move or bend something."""
    seen = set()
    for parameter in gradients(name)[3]:
        kind = parameter.split(".")[-1]
        if kind not in seen or kind.startswith(("vertex", "to_")):
            seen.add(kind)
            gradient_alone(name, parameter)
