"""Samples of boundary terms are drawn again: they name their edge, their segment and the vertices of their paths."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.estimate.test_invalid import FLOOR, SIZE, SPP, broken, integrator, scene_dict

from . import scenes

NAME = "blocker.to_world"
SLIDE = np.zeros((4, 4), np.float32)
SLIDE[0, 3] = 1.0


def options(boundary, depth: int = 2) -> dict:
    return {"integrator": integrator(boundary=boundary, max_depth=depth), "spp": SPP, "seed": 5}


@pytest.mark.slow
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["flat_creases", "through_mirrors"])
def test_invalid_samples_of_every_kind_are_counted(kind) -> None:
    """A reflectance that is not finite: of a flat-shaded ball, or of a mirror in which one is seen."""
    mirror = {"type": "conductor", "specular_reflectance": {"type": "rgb", "value": [0.9, 0.9, 0.9]}}
    shape = scenes.ball((0.0, 0.0, 0.8), 0.5, scenes.diffuse(0.5), subdivisions=3)
    nodes = {"sensor": scenes.camera(), "sky": scenes.sky(), "ball": shape}
    if kind == "through_mirrors":
        nodes["floor"] = scenes.floor(bsdf=mirror)
    scene = psdr.load_dict({"type": "scene", **nodes})
    params = psdr.traverse(scene)
    name = "ball.bsdf.reflectance.value" if kind == "flat_creases" else "floor.bsdf.specular_reflectance.value"
    first = scene.parameters[name].offset
    scene.values.numpy()[first : first + 3] = np.nan
    slide = np.zeros(params["ball.vertex_positions"].numpy().shape, np.float32)
    slide[:, 0] = 1.0
    how = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": SPP, "seed": 1}
    with pytest.warns(RuntimeWarning, match=f"{kind}: [1-9]"):
        psdr.render_forward(scene, params, {"ball.vertex_positions": slide}, **how)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "mode"),
    [
        ("secondary", "reverse"),
        pytest.param("primary", "reverse", marks=pytest.mark.slow),
        pytest.param("secondary", "forward", marks=pytest.mark.slow),
        pytest.param("primary", "forward", marks=pytest.mark.slow),
        pytest.param("edge_sampling", "reverse", marks=pytest.mark.slow),
    ],
)
def test_the_first_invalid_sample_leads_to_the_texel_that_made_it(kind: str, mode: str) -> None:
    scene = broken(lookup="bilinear")
    params = psdr.traverse(scene)
    how = options(psdr.boundary.EdgeSampling() if kind == "edge_sampling" else psdr.boundary.PathSpace())
    with pytest.warns(RuntimeWarning, match=rf"seed=5, kind='{kind}', params=params"):
        if mode == "reverse":
            params.requires_grad(NAME)
            psdr.render_backward(scene, params, np.ones((SIZE, SIZE, 3)), **how)
            named = {}
        else:
            named = {"tangents": {NAME: SLIDE}}
            psdr.render_forward(scene, params, *named.values(), **how)
    count = scene.invalid.counts[kind]
    number = count.first[0]
    trace = psdr.trace_sample(scene, sample=number, kind=kind, params=params, **named, **how)
    assert trace.dropped > 0 and trace.sample == number
    edge = next(place for place in trace.places if place.what == "edge")
    assert edge.shape in ("blocker", "lamp") and len(edge.edge) == 2
    if edge.shape == "blocker":  # the square of half a side 0.3 around (0.4, 0, 0.7)
        assert abs(edge.position[2] - 0.7) < 1e-6
        assert np.isclose(np.abs(edge.position[:2] - [0.4, 0.0]).max(), 0.3, atol=1e-6)
    else:
        assert kind == "edge_sampling"
    # The floor's texel in column 2 and row 1, with what bilinear interpolation makes of it.
    guilty = [p for p in trace.places if np.isnan(p.values).any() or p.what == "x_1"]
    assert guilty and all(p.shape == "floor" for p in guilty if p.what != "edge")
    assert any(-0.25 < p.position[0] < 0.75 and -0.75 < p.position[1] < 0.75 for p in guilty)
    assert f"{edge.shape} (diffuse)" in str(trace) and "floor (diffuse)" in str(trace)
    # In the sound scene the same sample takes the same way, without the damage.
    sound = psdr.load_dict(scene_dict(lookup="bilinear"))
    sane = psdr.traverse(sound)
    sane.requires_grad(NAME)
    again = psdr.trace_sample(sound, sample=number, kind=kind, params=sane, **named, **how)
    same = next(place for place in again.places if place.what == "edge")
    assert again.dropped == 0 and same.edge == edge.edge
    np.testing.assert_array_equal(same.position, edge.position)


@pytest.mark.slow
def test_a_segment_runs_from_the_floor_past_the_edge_to_the_light() -> None:
    scene = psdr.load_dict(scene_dict(lookup="bilinear"))
    params = psdr.traverse(scene)
    params.requires_grad(NAME)
    found = [
        psdr.trace_sample(scene, sample=i, kind="secondary", params=params, **options(psdr.boundary.PathSpace()))
        for i in range(0, 600, 20)
    ]
    whole = [t for t in found if len(t.places) >= 3]
    assert len(whole) > 3 and any(not t.places for t in found)
    for trace in whole:
        edge, first, second = trace.places[:3]
        assert (first.what, second.what) == ("x_1", "x_2") and trace.dropped == 0
        assert first.shape == "floor" and second.shape in ("lamp", "blocker", "floor")
        way = second.position - first.position
        np.testing.assert_allclose(way / np.linalg.norm(way), edge.direction, atol=2e-4)
        beside = np.cross(edge.position - first.position, edge.direction)
        assert np.linalg.norm(beside) < 2e-4


def ball(**more) -> dict:
    """Return a coarse ball with interpolated normals, sunk into the floor."""
    shape = {"type": "sphere", "center": [0.3, 0.1, 0.2], "radius": 0.3}
    return scene_dict(lookup="bilinear") | {"blocker": shape | more}


MIRROR = {"type": "conductor", "material": "none"}
POINT = {"lamp": {"type": "point", "position": [0.1, 0.2, 2.0], "intensity": 3.0}}
EDGES = psdr.boundary.EdgeSampling()
#: term, scene, method, what its first place is, which places others of it have.
TERMS = [
    ("primary", ball(), psdr.boundary.PathSpace(), "edge", {"path"}),
    ("flat_creases", ball(face_normals=True), psdr.boundary.PathSpace(), "edge", {"path"}),
    ("creases", ball(), psdr.boundary.PathSpace(), "edge", {"path"}),
    ("terminator", ball(), psdr.boundary.PathSpace(), "point", {"path"}),
    ("intersection_curve", ball(), psdr.boundary.PathSpace(), "edge", {"x_1", "x_2"}),
    ("indirect_terminator", ball(), psdr.boundary.PathSpace(), "x_1", {"x_2", "path"}),
    ("geometric_horizon", ball(), psdr.boundary.PathSpace(), "x_1", {"x_2"}),
    ("through_mirrors", ball(center=[0.3, 0.1, 0.4], bsdf=MIRROR), psdr.boundary.PathSpace(), "edge", {"path"}),
    ("edge_sampling", ball(), EDGES, "path", {"edge"}),
    ("hard_shadows", scene_dict(lookup="bilinear") | POINT, EDGES, "edge", {"x_1", "x_2"}),
]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "scene", "method", "first", "others"), TERMS, ids=[row[0] for row in TERMS])
def test_every_term_names_its_places(kind: str, scene: dict, method, first: str, others: set[str]) -> None:
    loaded = psdr.load_dict(scene)
    params = psdr.traverse(loaded)
    params.requires_grad(NAME)
    how = options(method, 3)
    numbers = (
        range(0, 285, 3) if kind in ("geometric_horizon", "creases", "flat_creases") else range(0, 1100, 11)
    )  # fewer samples than others have
    found = [psdr.trace_sample(loaded, sample=i, kind=kind, params=params, **how) for i in numbers]
    met = [t.places for t in found if t.places]
    assert met and all(places[0].what in {first, "path"} for places in met)
    assert others <= {p.what for places in met for p in places}
    assert all(np.isfinite(p.position).all() for places in met for p in places if p.shape)


def test_what_cannot_be_traced_is_refused() -> None:
    scene = psdr.load_dict(scene_dict(lookup="bilinear"))
    params = psdr.traverse(scene)
    params.requires_grad(FLOOR)
    how = options(psdr.boundary.PathSpace())
    with pytest.raises(ValueError, match="takes the params"):
        psdr.trace_sample(scene, sample=0, kind="secondary")
    with pytest.raises(ValueError, match="no boundary term"):
        psdr.trace_sample(scene, sample=0, kind="secondary", params=params, **how)
    with pytest.raises(ValueError, match="expected one of"):
        psdr.trace_sample(scene, sample=0, kind="guiding", params=params, **how)
    with pytest.raises(ValueError, match="takes the pixel"):
        psdr.trace_sample(scene, sample=0)
    params.requires_grad_only(NAME)
    with pytest.raises(ValueError, match=r"which boundary\.PathSpace does not estimate"):
        psdr.trace_sample(scene, sample=0, kind="through_mirrors", params=params, **how)
    with pytest.raises(ValueError, match="sample: got 1000000"):
        psdr.trace_sample(scene, sample=1000000, kind="secondary", params=params, **how)
