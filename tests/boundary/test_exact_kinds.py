"""Derivatives of exact disks and cylinders, all terms together: silhouettes, rims, and what lies inside."""

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .scenes import T, diffuse, floor, load, register
from .test_exact_sphere import LIGHTS, ROTATION, SHEAR, VIEW, entry, radius, scene_shape

TWO_SIDED = {"type": "twosided", "bsdf": diffuse(0.7, 0.5, 0.3), "other": diffuse(0.3, 0.6, 0.5)}
#: Both are above the floor; the camera looks into the cylinder's upper end.
POSES = {
    "disk": T.translate([0.1, 0.0, 0.7]).rotate([1, 1, 0], 30.0).scale([0.6, 0.45, 0.5]),
    "cylinder": T.translate([0.1, 0.0, 0.45]).rotate([1, -1, 0], 25.0).scale([0.4, 0.3, 0.6]),
}


def room(kind: str, light: str, **more):
    shape = {"type": kind, "exact": True, "to_world": POSES[kind], "bsdf": TWO_SIDED, **more}
    return lambda: {"sensor": VIEW, "floor": floor(half=2.0), "shape": shape, **LIGHTS[light]()}


def together():
    """A ball beside a disk, under a cylinder: three kinds in one scene, each seen by the others."""
    tube = T.translate([0.35, 0.3, 0.7]).rotate([0, 1, 0], 60.0).scale([0.15, 0.15, 0.5])
    return {
        "sensor": VIEW,
        "floor": floor(half=2.0),
        "ball": {"type": "sphere", "exact": True, "center": [0.5, -0.3, 0.3], "radius": 0.25, "bsdf": diffuse(0.5)},
        "plate": {
            "type": "disk",
            "exact": True,
            "to_world": T.translate([-0.4, 0.0, 0.5]).rotate([0, 1, 0], 50.0).scale(0.35),
            "bsdf": TWO_SIDED,
        },
        "tube": {"type": "cylinder", "exact": True, "to_world": tube, "bsdf": TWO_SIDED},
        **LIGHTS["lamp"](),
    }


NAME = "shape.to_world"
register({f"exact {kind}, {light}": room(kind, light) for kind in POSES for light in LIGHTS})
register({f"fine {kind}, lamp": room(kind, "lamp", exact=False, resolution=320) for kind in POSES})
register({"exact, three kinds": together})
MOTIONS = {"radius": radius, "x": entry(0, 3), "z": entry(2, 3), "rotation": ROTATION, "shear": SHEAR}
#: What turns or shears a shape under a sky or a sun changes little of the image.
FAINT = ("rotation", "shear")

CASES = [
    *(
        Case(f"exact {kind}, {light}", NAME, tangent, 0.01, what, 2, spp, 4 * spp)
        for kind in POSES
        for light in LIGHTS
        for what, tangent in MOTIONS.items()
        for spp in [4096 if light in ("sky", "sun") and what in FAINT else 1024]
    ),
    *(
        Case(f"exact {kind}, lamp", name, tangent, 0.01, what, 2, 1024, 4096)
        for kind in POSES
        for name, tangent, what in (
            ("floor.to_world", entry(2, 3), "the floor moves"),
            ("light.vertex_positions", lambda v: 0.0 * v + [1.0, 0.0, 0.0], "the lamp moves"),
            ("sensor.to_world", entry(0, 3), "the camera moves"),
        )
    ),
    Case("exact, three kinds", "plate.to_world", entry(0, 3), 0.01, "the disk moves", 3, 1024, 4096),
    Case("exact, three kinds", "plate.to_world", entry(0, 3), 0.01, "the disk moves", 2, 1024, 4096),
    Case("exact, three kinds", "tube.to_world", radius, 0.01, "the cylinder grows", 3, 1024, 4096),
]


@pytest.mark.slow_rows("exact, three kinds, the disk moves, depth 2-forward")
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_matches_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


def overlap(radius: float, apart: float) -> float:
    """Area that two circles share."""
    return 2.0 * radius**2 * np.arccos(apart / (2.0 * radius)) - 0.5 * apart * np.sqrt(4.0 * radius**2 - apart**2)


def cylinder_area(radius: float, length: float, angle: float) -> float:
    """Area of the image of an open cylinder, its axis at an angle to the parallel rays: its outline less the light that
    passes both ends."""
    through = overlap(radius, length * np.tan(angle))
    return 2.0 * radius * length * np.sin(angle) + np.cos(angle) * (np.pi * radius**2 - through)


@pytest.mark.slow
def test_areas_on_the_film() -> None:
    """Orthographic: a cylinder that is seen through by radius, length and angle, and two disks one behind the other."""
    radius, length, angle, apart = 0.4, 0.4, 0.9, 0.6
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    view = T.look_at([0, -5, 0], [0, 0, 0], [0, 0, 1]).scale([2.0, 2.0, 1.0])
    axis = np.array([0.0, np.cos(angle), np.sin(angle)])
    tube = {"type": "cylinder", "exact": True, "p0": [-1.0, 0.0, 0.0], "p1": [-1.0, *(length * axis[1:])]}
    tube |= {"radius": radius, "bsdf": diffuse(0.0)}
    plates = {
        name: {
            "type": "disk",
            "exact": True,
            "to_world": T.translate(center).rotate([1, 0, 0], 90.0).scale(0.5),
            "bsdf": diffuse(0.0),
        }
        for name, center in (("front", [0.7, -1.0, 0.2]), ("back", [0.7 + apart, 0.5, 0.2]))
    }
    scene = psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "orthographic", "to_world": view, "film": film},
            "sky": {"type": "constant", "radiance": 1.0},
            "tube": tube,
            **plates,
        }
    )
    params = psdr.traverse(scene)
    params.requires_grad("tube.to_world", "front.to_world", "back.to_world")
    found = []
    for seed in range(8):
        params.zero_grad()
        options = {"spp": 1024, "seed": seed, "integrator": psdr.PathIntegrator(max_depth=1)}
        psdr.render_backward(scene, params, np.full((16, 16, 3), -((4.0 / 16.0) ** 2) / 3.0, np.float32), **options)
        g = {
            n: params[f"{n}.to_world"].grad.numpy().reshape(4, 4).astype(np.float64) for n in ("tube", "front", "back")
        }
        pose = params["tube.to_world"].numpy().reshape(4, 4).astype(np.float64)
        turn = np.zeros((4, 4))
        # The axis away from the view: (0, -sin, cos).
        turn[:3, :3] = np.array([[0, 0, 0], [0, 0, -1], [0, 1, 0]]) @ pose[:3, :3]
        found.append(
            [
                (g["tube"][:, :2] * pose[:, :2]).sum() / radius,
                (g["tube"][:, 2] * pose[:, 2]).sum() / length,
                (g["tube"] * turn).sum(),
                *g["tube"][:3, 3],
                g["front"][0, 3],
                g["back"][0, 3],
                g["front"][1, 3],
                sum((g[n][:3, :3] * params[f"{n}.to_world"].numpy().reshape(4, 4)[:3, :3]).sum() for n in plates) / 0.5,
            ]
        )
    mean, error = np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / np.sqrt(8.0)
    at, step = np.array([radius, length, angle]), 1e-6
    of_tube = [(cylinder_area(*(at + step * e)) - cylinder_area(*(at - step * e))) / (2.0 * step) for e in np.eye(3)]
    slides = np.sqrt(1.0 - apart**2)
    grows = 2.0 * np.pi - (overlap(0.5 + step, apart) - overlap(0.5 - step, apart)) / (2.0 * step)
    expected = [*of_tube, 0.0, 0.0, 0.0, -slides, slides, 0.0, grows]
    assert (error < 4e-3).all()
    # Absorbs the distance at which rays pass a rim, and float32.
    assert (np.abs(mean - expected) < 4.0 * error + 3e-4).all(), (mean, error, expected)


def light_below_disk(radius: float, height: float, level: float) -> float:
    """Mean radiance of the white floor at z = ``level`` that a camera at .3 sees in the square [-1, 1]^2 (.3 - z).

    A black horizontal disk hides a share of the uniform sky, seen from beside its axis.
    """
    t, w = np.polynomial.legendre.leggauss(24)
    beside = (t[:, None] ** 2 + t**2) * (0.3 - level) ** 2
    far = beside + (height - level) ** 2
    root = np.sqrt((far + radius**2) ** 2 - 4.0 * radius**2 * beside)
    return float((0.25 * w[:, None] * w * (0.5 + 0.5 * (far - radius**2) / root)).sum())


@pytest.mark.slow
def test_irradiance_below_a_black_disk() -> None:
    """By radius and height of the disk, and by the height of the floor that receives the light."""
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    view = T.look_at([0, 0, 0.3], [0, 0, 0], [0, 1, 0])
    plate = {"type": "disk", "exact": True, "to_world": T.translate([0, 0, 1.2]).scale(0.5), "bsdf": diffuse(0.0)}
    scene = psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 90.0, "to_world": view, "film": film},
            "floor": floor(half=0.4, bsdf=diffuse(1.0, 1.0, 1.0)),
            "sky": {"type": "constant", "radiance": 1.0},
            "plate": plate,
        }
    )
    params = psdr.traverse(scene)
    params.requires_grad("plate.to_world", "floor.to_world")
    found = []
    for seed in range(8):
        params.zero_grad()
        options = {"spp": 4096, "seed": seed, "integrator": psdr.PathIntegrator(max_depth=2)}
        psdr.render_backward(scene, params, np.ones((8, 8, 3)) / 192.0, **options)
        by_plate = params["plate.to_world"].grad.numpy().reshape(4, 4)
        by_floor = params["floor.to_world"].grad.numpy().reshape(4, 4)
        found.append([np.trace(by_plate[:2, :2]), by_plate[2, 3], by_floor[2, 3]])
    mean, error = np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / np.sqrt(8.0)
    at, step = np.array([0.5, 1.2, 0.0]), 1e-5
    exact = [
        (light_below_disk(*(at + step * e)) - light_below_disk(*(at - step * e))) / (2.0 * step) for e in np.eye(3)
    ]
    assert (error < 0.01 * np.abs(exact)).all(), error / np.abs(exact)
    assert (np.abs(mean - exact) < 4.0 * error).all(), (mean, error, exact)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["exact, three kinds"])
def test_reverse_mode_is_the_transpose(name: str) -> None:
    scene, params = load(name)
    options = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": 4, "seed": 1}
    assert_transposes(scene, params, ["plate.to_world", "tube.to_world", "ball.to_world", "floor.to_world"], options)


@pytest.mark.slow
@pytest.mark.parametrize("kind", POSES)
def test_is_the_fine_tessellations(kind: str) -> None:
    """By every number of the pose, and the same floor and lamp."""
    names = (NAME, "floor.to_world", "light.vertex_positions")
    found = {}
    for form in ("exact", "fine"):
        scene, params = load(f"{form} {kind}, lamp")
        params.requires_grad_only(*names)
        batches = []
        for seed in range(8):
            params.zero_grad()
            options = {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 512, "seed": seed}
            psdr.render_backward(scene, params, np.ones((*scene_shape(scene), 3)), **options)
            batches.append(np.concatenate([params[n].grad.numpy().ravel() for n in names]))
        found[form] = np.array(batches, np.float64)
    a, b = found["exact"], found["fine"]
    gap, error = a.mean(axis=0) - b.mean(axis=0), np.sqrt((a.var(axis=0, ddof=1) + b.var(axis=0, ddof=1)) / 8.0)
    scale = np.abs(b.mean(axis=0)).max()
    assert (np.abs(gap) < 5.0 * error + 0.01 * scale).all(), gap / scale
    assert (error < 0.02 * scale).all()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["primary_silhouette", "secondary_silhouette"])
@pytest.mark.parametrize("shape", POSES)
def test_samples_are_drawn_again(shape: str, kind: str) -> None:
    """Points that samples are traced to lie on the outlines of the shape."""
    scene, params = load(f"exact {shape}, lamp")
    params.requires_grad_only(NAME)
    options = {"kind": kind, "params": params, "integrator": psdr.PathIntegrator(max_depth=2), "spp": 16}
    traces = [psdr.trace_sample(scene, sample=n, **options) for n in range(0, 4096, 32)]
    places = [place for trace in traces for place in trace.places if place.what == "point"]
    assert len(places) > 8
    local = np.array([(np.linalg.inv(POSES[shape].matrix) @ np.append(p.position, 1.0))[:3] for p in places])
    np.testing.assert_allclose(np.linalg.norm(local[:, :2], axis=1), 1.0, atol=1e-5)
    if shape == "disk":
        np.testing.assert_allclose(local[:, 2], 0.0, atol=1e-5)


@pytest.mark.parametrize(
    ("kind", "change", "problem"),
    [
        ("cylinder", {"to_world": T.translate([0, 0, 3e-5]).scale(0.5)}, "'floor' touches 'shape'"),
        ("disk", {"to_world": T.translate([0, 0, 1e-6])}, "'floor' touches 'shape'"),
    ],
)
def test_what_has_no_terms_is_refused(kind: str, change: dict, problem: str) -> None:
    scene = psdr.load_dict({"type": "scene", **room(kind, "lamp", **change)()})
    params = psdr.traverse(scene)
    params.requires_grad(NAME)
    with pytest.raises(ValueError, match=problem):
        psdr.plan(scene, params, integrator=psdr.PathIntegrator(max_depth=2))
