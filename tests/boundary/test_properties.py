"""Images of what the camera sees first (``psdr.AovIntegrator``): closed forms, finite differences, losses on a tape."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr

T = psdr.Transform
PROPERTIES = ("mask", "depth", "position", "sh_normal")
WIDTH, HEIGHT = 24, 20
#: Largest error of a slope, and how many standard errors have to fit into it, as elsewhere.
SLOPE_TOLERANCE, STANDARD_ERRORS = 0.02, 3.0
BATCHES = 8
#: Float32 sums in another order, over the sum of magnitudes.
SUMMATION = 1e-4


def film(width: int = WIDTH, height: int = HEIGHT) -> dict:
    return {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}


# -- closed forms ------------------------------------------------------------------------------------------------------

#: Half the width of what the parallel camera sees, the plate's half extents, and its distance from the near clip plane.
SEEN, PLATE, DISTANCE = 2.0, (0.9, 0.6), 4.0
SIZE = 16
PIXEL = 2.0 * SEEN / SIZE


@pytest.fixture(scope="module")
def plate():
    camera = {
        "type": "orthographic", "near_clip": 1.0, "film": film(SIZE, SIZE),
        "to_world": T.look_at((0, 0, 5), (0, 0, 0), (0, 1, 0)) @ T.scale((SEEN, SEEN, 1.0)),
    }  # fmt: skip
    shape = {"type": "rectangle", "to_world": T.scale((*PLATE, 1.0))}
    return psdr.load_dict({"type": "scene", "camera": camera, "plate": shape, "sky": {"type": "constant"}})


@pytest.mark.parametrize(
    ("aov", "expected"),
    [
        ("mask", np.array([1.0, 1.0, 1.0])),
        ("depth", np.full(3, DISTANCE)),
        pytest.param("position", None, marks=pytest.mark.slow),
    ],
)
def test_a_plate_that_slides_uncovers_what_its_edge_shows(plate, aov: str, expected: np.ndarray | None) -> None:
    """Along x: on one half of the film what is there where the edge passes, at its speed, and less on the other."""
    params = psdr.traverse(plate)
    slide = np.zeros((4, 4))
    slide[0, 3] = 1.0
    integrator = psdr.AovIntegrator(aov=aov)
    image = psdr.render_forward(plate, params, {"plate.to_world": slide}, integrator=integrator, spp=256).numpy()
    columns = PIXEL**2 * image.astype(np.float64).sum(axis=0)  # an integral over the plane
    left, right = columns[: SIZE // 2].sum(axis=0), columns[SIZE // 2 :].sum(axis=0)
    if aov == "position":
        # d/dt of x over the halves of [-w + t, w + t] is w at either end; the points themselves do not move the image.
        expected = np.array([PLATE[0], 0.0, 0.0])
        left = -left
    side = 1.0 if plate_is_right(image) else -1.0
    height = 2.0 * PLATE[1]
    np.testing.assert_allclose(side * right, height * expected, atol=0.01 * height * np.abs(expected).max())
    np.testing.assert_allclose(-side * left, height * expected, atol=0.01 * height * np.abs(expected).max())


def plate_is_right(image: np.ndarray) -> bool:
    """Whether the film's right half is that of positive x: where the plate comes in."""
    return bool(np.abs(image[:, SIZE // 2 :]).sum() > 0.0 and image[:, SIZE // 2 :].sum() > 0.0)


def test_depth_follows_what_recedes(plate) -> None:
    """Along the parallel rays nothing but the interior changes: one unit a unit, on what is seen of the plate."""
    params = psdr.traverse(plate)
    recede = np.zeros((4, 4))
    recede[2, 3] = -1.0
    integrator = psdr.AovIntegrator(aov="depth")
    image = psdr.render_forward(plate, params, {"plate.to_world": recede}, integrator=integrator, spp=256).numpy()
    mask = psdr.render_aov(plate, ["mask"], spp=256)["mask"].numpy()
    np.testing.assert_allclose(image[..., 0], mask, atol=0.05)
    assert abs(PIXEL**2 * image[..., 0].sum() - 4.0 * PLATE[0] * PLATE[1]) < 0.01


def test_losses_of_masks_and_depths_are_recorded(plate) -> None:
    """``render_aov`` on a tape: the gradient of a weighted loss, against its closed form and ``render_backward``."""
    params = psdr.traverse(plate)
    params.requires_grad_only("plate.to_world")
    weights = np.zeros((SIZE, SIZE), np.float32)
    weights[:, : SIZE // 2] = 1.0
    target = np.zeros((SIZE, SIZE), np.float32)
    with wp.Tape() as tape:
        found = psdr.render_aov(plate, ["mask", "depth"], params=params, spp=256, seed=1)
        of_mask = psdr.losses.l2(found["mask"], target, weights=weights)
        of_depth = psdr.losses.l2(found["depth"], target, weights=weights)
        loss = psdr.losses.total(of_mask, (0.5, of_depth))
    assert found["mask"].dtype == found["depth"].dtype == wp.float32 and found["mask"].shape == (SIZE, SIZE)
    params.zero_grad()
    tape.backward(loss)
    recorded = params["plate.to_world"].grad.numpy().copy()
    params.zero_grad()
    for name, share in (("mask", 1.0), ("depth", 0.5)):
        adjoint = np.zeros((SIZE, SIZE, 3), np.float32)
        adjoint[..., 0] = share * 2.0 * weights * found[name].numpy() / weights.sum()
        options = {"integrator": psdr.AovIntegrator(aov=name), "spp": 256, "seed": 1}
        psdr.render_backward(plate, params, adjoint, **options)
    np.testing.assert_allclose(recorded, params["plate.to_world"].grad.numpy(), rtol=1e-5, atol=1e-5)
    # The square of the mask on a half of area A / 2 changes by h x / (A / 2) where its outer edge slides by x.
    covered = 2.0 * SEEN * SEEN
    expected = 2.0 * PLATE[1] / covered * (1.0 + 0.5 * DISTANCE**2)
    # Pixels that the edge cuts are squared: 2 m dm in place of d(m^2) summed, within one column of pixels.
    assert abs(abs(recorded[0, 3]) - expected) < 0.25 * expected


# -- against finite differences ----------------------------------------------------------------------------------------


def solids(kind: str) -> dict:
    """A ball and a box: both of triangles, the ball exact, or of glass and a mask beside what radiance would refuse."""
    ball = {"type": "sphere", "to_world": T.translate((0.3, 0.1, 0.5)) @ T.scale((1.0, 0.8, 0.6))}
    return {
        "type": "scene",
        "camera": {
            "type": "perspective", "near_clip": 0.5, "film": film(),
            "to_world": T.look_at((0, 1, 5), (0, 0, 0), (0, 1, 0)),
        },
        "ball": {**ball, "exact": True} if kind == "exact" else {**ball, "resolution": 24},
        "box": {
            "type": "cube",
            "to_world": T.translate((-0.9, -0.2, -0.6)) @ T.rotate((0.3, 1.0, 0.1), 35) @ T.scale(0.6),
        },
        "lamp": {"type": "point", "position": [0, 3, 3]},
    } | (TOGETHER if kind == "together" else {})  # fmt: skip


#: Textures with steps before the camera, and lights whose edges have no estimator, are not in these images.
TOGETHER = {
    "floor": {
        "type": "rectangle",
        "to_world": T.translate((0, -1, 0)) @ T.rotate((1, 0, 0), -90) @ T.scale(3),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "checkerboard"}},
    },
    "pane": {
        "type": "sphere", "resolution": 24, "to_world": T.translate((1.1, 0.8, -0.3)) @ T.scale(0.4),
        "bsdf": {"type": "dielectric"},
    },
    "leaf": {
        "type": "rectangle", "to_world": T.translate((-1.0, 0.8, 0.5)) @ T.scale(0.3),
        "bsdf": {"type": "mask", "opacity": 0.5, "of": {"type": "diffuse"}},
    },
    "sky": {"type": "envmap", "bitmap": np.linspace(0.1, 1.0, 96, dtype=np.float32).reshape(4, 8, 3)},
}  # fmt: skip


def tangent_of(name: str, value: np.ndarray) -> np.ndarray:
    if name == "camera.to_world":
        turn = np.array([[0, -0.1, 0.05, 0.2], [0.1, 0, -0.07, 0.1], [-0.05, 0.07, 0, -0.3], [0, 0, 0, 0]])
        return value @ turn
    tangent = np.zeros((4, 4))
    tangent[:3] = 0.4 * np.random.default_rng(0).normal(size=(3, 4))
    return tangent


CASES = [(aov, name, kind) for aov in PROPERTIES for name in ("ball.to_world", "box.to_world", "camera.to_world")
         for kind in ("mesh", "exact", "together") if (kind, aov) != ("exact", "sh_normal")]  # fmt: skip
FAST = {("depth", "box.to_world", "together"), ("sh_normal", "box.to_world", "mesh")}
ROWS = [
    pytest.param(*case, id="-".join(case),
                 marks=() if case in FAST else pytest.mark.slow)
    for case in CASES
]  # fmt: skip


@pytest.mark.parametrize(("aov", "name", "kind"), ROWS)
def test_slope_against_finite_differences(aov: str, name: str, kind: str) -> None:
    scene = psdr.load_dict(solids(kind))
    params = psdr.traverse(scene)
    integrator, step = psdr.AovIntegrator(aov=aov), 8e-3
    base = params[name].numpy().reshape(4, 4).copy()
    tangent = tangent_of(name, base)

    def difference(seed: int) -> np.ndarray:
        images = []
        for sign in (1.0, -1.0):
            params[name] = base + sign * step * tangent
            images.append(psdr.render(scene, integrator=integrator, spp=2048, seed=seed).numpy().astype(np.float64))
        params[name] = base
        return (images[0] - images[1]) / (2.0 * step)

    weights = np.mean([difference(900 + seed) for seed in range(BATCHES)], axis=0)
    params.requires_grad_only(name)
    ratios = []
    for seed in range(BATCHES):
        options = {"integrator": integrator, "spp": 256, "seed": seed}
        image = psdr.render_forward(scene, params, {name: tangent}, **options).numpy().astype(np.float64)
        params.zero_grad()
        psdr.render_backward(scene, params, weights.astype(np.float32), **options)
        pulled = (params[name].grad.numpy().reshape(4, 4) * tangent).sum()
        assert abs(pulled - (weights * image).sum()) < SUMMATION * np.abs(weights * image).sum()
        ratios.append([(weights * image).sum(), (weights * difference(seed)).sum()])
    sums = np.array(ratios)
    slope = sums[:, 0].sum() / sums[:, 1].sum()
    error = np.std(sums[:, 0] - slope * sums[:, 1], ddof=1) * np.sqrt(BATCHES) / abs(sums[:, 1].sum())
    assert STANDARD_ERRORS * error < SLOPE_TOLERANCE, f"{slope:.4f} +- {error:.4f}: too noisy"
    assert abs(slope - 1.0) < SLOPE_TOLERANCE, f"{slope:.4f} +- {error:.4f}"


# -- what there is none of ---------------------------------------------------------------------------------------------


def test_what_has_no_derivative_is_named() -> None:
    with pytest.raises(ValueError, match="aov: got 'albedo', expected one of 'mask'"):
        psdr.AovIntegrator(aov="albedo")
    with pytest.raises(ValueError, match=r"expected psdr\.boundary\.PathSpace\(\)"):
        psdr.AovIntegrator(aov="mask", boundary=psdr.boundary.WarpedArea())
    scene = psdr.load_dict(solids("exact"))
    params = psdr.traverse(scene)
    for aov, name, words in (
        ("sh_normal", "box.to_world", "normals are those of meshes.*leave out 'exact'"),
        ("depth", "camera.x_fov", "near clip plane along the rays.*take 'position'"),
    ):
        params.requires_grad_only(name)
        with pytest.raises(ValueError, match=words):
            psdr.plan(scene, params, integrator=psdr.AovIntegrator(aov=aov))
        with wp.Tape(), pytest.raises(ValueError, match=words):
            psdr.render_aov(scene, [aov], params=params, spp=1)
    fog = {"type": "homogeneous", "sigma_t": 0.5}
    away = T.translate((0.0, 0.0, -9.0))
    cloud = {"type": "cube", "bsdf": {"type": "null"}, "interior": fog, "to_world": away}
    foggy = psdr.load_dict({**solids("mesh"), "cloud": cloud, "meter": {"type": "radiancemeter", "film": film(1, 1)}})
    params_of_fog = psdr.traverse(foggy)
    params_of_fog.requires_grad_only("cloud.to_world")
    with pytest.raises(ValueError, match=r"cloud\.to_world moves a surface that is not there"):
        psdr.plan(foggy, params_of_fog, integrator=psdr.AovIntegrator(aov="mask"))
    with pytest.raises(ValueError, match="got a 'radiancemeter', expected a 'perspective'"):
        psdr.plan(foggy, sensor="meter", integrator=psdr.AovIntegrator(aov="mask"))
    with wp.Tape(), pytest.raises(ValueError, match="'albedo' has no derivatives; on a tape take 'mask'"):
        psdr.render_aov(scene, ["albedo"], params=params, spp=1)
