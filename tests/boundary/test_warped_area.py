"""Rays that move with the edges of meshes: closed forms, finite differences, and the explicit boundary term."""

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import REMAINDER, Case, assert_transposes, derivatives, differences, rows, slope
from .scenes import T, ball, box, camera, diffuse, floor, load, mesh, panel, register, room, rough, sky, under
from .test_table import ALONG, BOX, FLOOR, OCCLUDER, PANEL, RECEIVER, SHAPE, apart, moved, scaled

METHOD = psdr.boundary.WarpedArea()
OWN_PATHS = psdr.boundary.PathWarpedArea()
BIASED = psdr.boundary.WarpedArea(debias=False)


def black_square() -> dict:
    """A square of the half size 0.5 at the distance 2, before a sky of radiance 1."""
    corners = 0.5 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    view = camera((0.0, 0.0, 2.0), (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0), fov=45.0)
    return {"sensor": view, "sky": sky(), "shape": mesh(corners, [[0, 1, 2], [0, 2, 3]], diffuse(0.0))}


register(
    {
        "warped square": black_square,
        "warped room": lambda: room(height=0.3),
        "warped gloss": lambda: under(panel((0.5, -0.3, 2.2), 0.35)) | {"floor": floor(bsdf=rough(0.3))},
    }
)


@pytest.mark.slow
def test_area_on_the_film() -> None:
    """Sum of the image: pixels less (2 a f / z)^2, f in pixels; by the size, the distance, and along the film."""
    scene, params = load("warped square")
    params.requires_grad_only(SHAPE)
    how = psdr.PathIntegrator(max_depth=2, boundary=METHOD)
    found = []
    for seed in range(8):
        params.zero_grad()
        psdr.render_backward(scene, params, np.full((16, 16, 3), 1.0 / 3.0), integrator=how, spp=512, seed=seed)
        g = params[SHAPE].grad.numpy().astype(np.float64)
        found.append([(g * params[SHAPE].numpy()).sum(), g[:, 2].sum(), g[:, 0].sum()])
    mean, error = np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / np.sqrt(8.0)
    area = (0.5 * 8.0 / np.tan(np.radians(22.5))) ** 2
    expected = np.array([-2.0 * area, -area, 0.0])
    assert (error < 0.03 * area).all()
    assert (np.abs(mean - expected) < 4.0 * error + 1e-3 * area).all()


CASES = [
    Case("soft", PANEL, scaled, 0.04, "light scales", spp=40, slow=False),
    Case("soft", OCCLUDER, ALONG, 0.01, "occluder moves", spp=384, difference_spp=4096),
    Case("soft", OCCLUDER, moved(0.0, 0.0, 1.0), 0.01, "occluder rises", spp=128, difference_spp=8192),
    Case("soft", FLOOR, moved(0.0, 0.0, 1.0), 0.02, RECEIVER, spp=256, difference_spp=8192),
    Case("soft", PANEL, ALONG, 0.02, "light moves", spp=384, difference_spp=4096),
    Case("soft", (OCCLUDER, PANEL, FLOOR), apart, 0.01, "all move", spp=128, difference_spp=4096),
    Case("split", SHAPE, ALONG, 0.01, "moves", spp=128, difference_spp=4096),
    Case("silhouette box", SHAPE, ALONG, 0.01, "moves", spp=128, difference_spp=4096),
    Case("silhouette gaussian", SHAPE, scaled, 0.01, "scales", spp=128, difference_spp=4096),
    Case("warped room", BOX, moved(1.0, -0.5, 0.0), 0.005, "a box moves", depth=3, spp=384, difference_spp=8192),
]
#: Three standard errors: two percent, as of explicit terms, would take up to a hundred times the samples.
WIDE, OF_THE_LIGHT = 0.2, 0.04


def assert_near(found: np.ndarray, expected: np.ndarray, noise: float) -> None:
    """Fail unless the slope is 1 within its own error, three of which fit into ``noise``."""
    value, error = slope(found, expected)
    assert 3.0 * error < noise, f"too noisy to tell: slope {value:.4f} +- {error:.4f}"
    assert abs(value - 1.0) < 3.0 * error + REMAINDER, f"slope {value:.4f} +- {error:.4f}"
    print(f"slope {value:.4f} +- {error:.4f}")


@pytest.mark.parametrize("case", rows(CASES))
def test_matches_finite_differences(case: Case) -> None:
    found = derivatives(case, "reverse", METHOD)
    assert_near(found, differences(case)[2], WIDE if case.slow else OF_THE_LIGHT)


def test_along_paths_of_its_own() -> None:
    """Beside the interior term of vertices on their triangles: the light grows, in the same numbers."""
    assert_near(derivatives(CASES[0], "reverse", OWN_PATHS), differences(CASES[0])[2], OF_THE_LIGHT)


@pytest.mark.slow
def test_without_debiasing_it_is_biased() -> None:
    """By some tens of a percent where the receiver moves along its normal; the plan says so."""
    case = Case("soft", FLOOR, moved(0.0, 0.0, 1.0), 0.02, RECEIVER, spp=128, difference_spp=8192)
    found, wanted = derivatives(case, "reverse", BIASED), differences(case)[2]
    error = found.std(ddof=1) / np.sqrt(len(found)) / abs(wanted.mean())
    assert abs(found.mean() / wanted.mean() - 1.0) > 0.01 + 4.0 * error
    scene, _params = load("soft")
    said = str(psdr.plan(scene, names=[OCCLUDER], integrator=psdr.PathIntegrator(max_depth=2, boundary=BIASED)))
    assert "biased, debias=False" in said


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "method"),
    [
        ("soft", METHOD),
        ("sky", METHOD),
        ("warped gloss", METHOD),
        ("warped room", METHOD),
        ("soft", OWN_PATHS),
        ("warped gloss", OWN_PATHS),
        ("warped room", OWN_PATHS),
    ],
    ids=lambda v: v if isinstance(v, str) else type(v).__name__,
)
def test_agrees_with_the_explicit_term(name: str, method) -> None:
    """All vertices and materials at once: z-test over independent batches of random projections of the gradient."""
    scene, params = load(name)
    what = BOX if name == "warped room" else OCCLUDER
    depth = 3 if name == "warped room" else 2
    base = params[what].numpy().astype(np.float64)
    tangents = [ALONG(base), moved(0.0, 0.0, 1.0)(base), scaled(base), np.random.default_rng(1).normal(size=base.shape)]
    y, x = np.mgrid[:16, :16] / 16.0
    adjoint = ((np.sin(3.0 * x + 1.0) * np.cos(4.0 * y) + 0.7)[..., None] * [1.0, 0.6, 0.3]).astype(np.float32)

    def sums(boundary, spp: int) -> np.ndarray:
        params.requires_grad_only(what)
        how = psdr.PathIntegrator(max_depth=depth, boundary=boundary)
        found = []
        for seed in range(8):
            params.zero_grad()
            psdr.render_backward(scene, params, adjoint, integrator=how, spp=spp, seed=seed)
            g = params[what].grad.numpy().astype(np.float64)
            found.append([(g * t).sum() for t in tangents])
        return np.array(found)

    explicit, moving = sums("auto", 1024), sums(method, 128)
    error = np.sqrt((explicit.var(axis=0, ddof=1) + moving.var(axis=0, ddof=1)) / 8.0)
    assert (np.abs((moving - explicit).mean(axis=0)) < 4.0 * error).all()
    assert error.min() < 0.15 * np.abs(explicit.mean(axis=0)).max()


@pytest.mark.slow
@pytest.mark.parametrize("method", [METHOD, OWN_PATHS], ids=lambda v: type(v).__name__)
def test_forward_and_reverse_mode_are_transposes(method) -> None:
    scene, params = load("soft")
    options = {"integrator": psdr.PathIntegrator(max_depth=2, boundary=method), "spp": 4, "seed": 3}
    assert_transposes(scene, params, [OCCLUDER, PANEL, "floor.bsdf.reflectance.value"], options)


def point() -> dict:
    return {"type": "point", "position": [0.6, -0.4, 3.0], "intensity": 20.0}


def textured() -> dict:
    light = panel((0.5, -0.3, 2.2), 0.35)
    image = np.linspace(0.5, 1.0, 27, dtype=np.float32).reshape(3, 3, 3)
    light["emitter"]["radiance"] = {"type": "bitmap", "bitmap": image, "raw": True}
    return light


STEPS = {"type": "diffuse", "reflectance": {"type": "checkerboard"}}
REFUSED = {
    "a point light": ({"light": point()}, {}, "whose shadows are hard"),
    "a mirror": ({"floor": floor(bsdf={"type": "conductor"})}, {}, "smooth mirror"),
    "a mask": (
        {"floor": floor(bsdf={"type": "mask", "opacity": 0.5, "bsdf": diffuse(0.5)})},
        {"names": [OCCLUDER]}, "mask",
    ),
    "an exact sphere": ({"other": {"type": "sphere", "exact": True, "to_world": T.translate([0, 0, 9])}}, {}, "exact"),
    "interpolated normals": ({"occluder": ball((0.1, 0.1, 0.9), 0.4, diffuse(0.5), smooth=True)}, {}, "interpolated"),
    "steps": ({"floor": floor(bsdf=STEPS)}, {}, "steps"),
    "a light with a texture": ({"light": textured()}, {}, "texture"),
    "a curve of intersection": ({"other": box((0.5, 0.1, 0.9), (0.3, 0.1, 0.1), diffuse(0.5))}, {}, "run through"),
    "a contact": (
        {"occluder": box((0.0, 0.0, 0.3), (0.3, 0.3, 0.3), diffuse(0.5))}, {}, "touch",
    ),
    "the camera moves": ({}, {"names": [OCCLUDER, "sensor.to_world"]}, "camera moves"),
    "own paths, a point light": ({"light": point()}, {"boundary": OWN_PATHS}, "whose shadows are hard"),
    "another interior": ({}, {"interior": psdr.interior.Radiative()}, "interior.Replay"),
    "no end of paths": ({}, {"max_depth": -1}, "max_depth"),
    "parallel rays": (
        {"sensor": {k: v for k, v in {**camera(), "type": "orthographic"}.items() if k != "fov"}}, {}, "'perspective'",
    ),
}  # fmt: skip


def assert_refused(what: str, method: psdr.boundary.Method) -> None:
    """Fail unless a gradient of ``REFUSED`` is refused to a method with its reason."""
    changes, options, said = REFUSED[what]
    options = dict(options)
    scene = psdr.load_dict({"type": "scene", **under(panel((0.5, -0.3, 2.2), 0.35)), **changes})
    names = options.pop("names", [OCCLUDER])
    integrator = psdr.PathIntegrator(**{"max_depth": 2, "boundary": method, **options})
    with pytest.raises(ValueError, match=said):
        psdr.plan(scene, names=names, integrator=integrator)


@pytest.mark.parametrize("what", REFUSED)
def test_what_is_refused(what: str) -> None:
    assert_refused(what, METHOD)


@pytest.mark.parametrize(
    "options", [{"rays": 1}, {"rays": 12}, {"kappa": 1.0}, {"debias": 1}, {"spp_secondary": 4}], ids=str
)
def test_options_out_of_range(options: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        psdr.boundary.WarpedArea(**options)
