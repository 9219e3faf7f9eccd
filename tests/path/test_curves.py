"""Images of curves: Mitsuba's, and a closed form."""

import numpy as np
import pytest

import warp_psdr as psdr

from .test_sdfgrid import DIFFUSE, ROUGH, T, assert_mitsubas, scene

TILES = {"type": "checkerboard", "to_uv": T.scale([4, 40, 1])}


def hair(radius: float = 0.08) -> tuple[np.ndarray, list[int]]:
    """Return control points (N, 4) and starts of curves that taper and bend."""
    rng = np.random.default_rng(1)
    points, starts = [], []
    for _curve in range(8):
        starts.append(7 * len(points))
        steps = np.concatenate([np.zeros((1, 3)), rng.normal([0.0, 0.0, 0.2], 0.07, (6, 3))])
        places = rng.uniform(-0.6, 0.6, 3) * [1, 1, 0] + np.cumsum(steps, axis=0)
        points.append(np.column_stack([places, np.linspace(radius, 0.25 * radius, 7)]))
    return np.concatenate(points).astype(np.float32), starts


def held(plugin: str, bsdf: dict, **more) -> dict:
    described = scene(np.ones((2, 2, 2)), T(), "smooth", bsdf, **more)
    points, starts = hair()
    described["body"] = {"type": plugin, "control_points": points, "curve_starts": starts, "bsdf": bsdf}
    return described


def in_file(described: dict, folder) -> dict:
    """Return the scene with its curves in a file, as Mitsuba takes them."""
    body, lines = dict(described["body"]), []
    starts = body.pop("curve_starts")
    for k, point in enumerate(body.pop("control_points")):
        lines += [""] * (k in starts) + [" ".join(f"{x:.9g}" for x in point)]
    (folder / "hair.txt").write_text("\n".join(lines) + "\n")
    return {**described, "body": {**body, "filename": str(folder / "hair.txt")}}


@pytest.mark.parametrize(
    ("plugin", "bsdf"),
    [
        ("bsplinecurve", {"type": "diffuse", "reflectance": TILES}),
        pytest.param("linearcurve", {"type": "diffuse", "reflectance": TILES}, marks=pytest.mark.slow),
        pytest.param("bsplinecurve", {**ROUGH, "alpha_u": 0.4, "alpha_v": 0.1}, marks=pytest.mark.slow),
        pytest.param("linearcurve", ROUGH, marks=pytest.mark.slow),
    ],
    ids=["b-splines", "cones", "anisotropic", "rough cones"],
)
def test_image_is_mitsubas(plugin: str, bsdf: dict, tmp_path) -> None:
    bsdf = {key: value for key, value in bsdf.items() if key != "alpha" or "alpha_u" not in bsdf}
    theirs = in_file(held(plugin, bsdf), tmp_path)
    assert_mitsubas(theirs, theirs)


@pytest.mark.slow_rows("bsplinecurve", "linearcurve")
@pytest.mark.parametrize("plugin", ["bsplinecurve", pytest.param("linearcurve", marks=pytest.mark.slow)])
def test_a_straight_tube_covers_its_shadow(plugin: str) -> None:
    """Seen from the side by parallel rays: 2 r L for a tube, and pi r^2 more with its two half spheres."""
    radius, count = 0.2, 8
    z = np.arange(count) / (count - 1.0)
    points = np.column_stack([np.zeros((count, 2)), z, np.full(count, radius)])
    film = {"type": "hdrfilm", "width": 64, "height": 64, "rfilter": {"type": "box"}}
    eye = T.look_at([0, -3, 0.5], [0, 0, 0.5], [0, 0, 1])
    black = {"type": "diffuse", "reflectance": 0.0}
    seen = psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "orthographic", "to_world": eye, "film": film},
            "sky": {"type": "constant"},
            "body": {"type": plugin, "control_points": points, "bsdf": black},
        }
    )
    image = psdr.render(seen, spp=256, integrator=psdr.PathIntegrator(max_depth=2)).numpy()
    length = (count - 3) / (count - 1.0) if plugin == "bsplinecurve" else 1.0
    expected = 2.0 * radius * length + (np.pi * radius**2 if plugin == "linearcurve" else 0.0)
    assert 4.0 * (1.0 - image.mean()) == pytest.approx(expected, rel=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("plugin", ["bsplinecurve", pytest.param("linearcurve", marks=pytest.mark.slow)])
def test_traced_vertices_lie_on_them(plugin: str) -> None:
    described = psdr.load_dict(held(plugin, DIFFUSE))
    seen = psdr.render_aov(described, "pp:position, ss:shape_index", spp=1)
    rows, columns = np.nonzero(seen["ss"].numpy().reshape(32, 32) == 2.0)
    assert rows.size > 10
    vertex = psdr.trace_sample(described, pixel=(int(columns[5]), int(rows[5])), sample=0, spp=1).vertices[0]
    assert vertex.shape == "body" and vertex.face == -1
    np.testing.assert_allclose(vertex.position, seen["pp"].numpy()[rows[5], columns[5]], atol=1e-4)
