"""``render_aov``: what the camera sees first, against Mitsuba's interactions and its ``aov`` integrator."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.path.helpers import assert_same_mean

SIZE = 6
#: Of positions and derivatives in float32, relative to their largest value.
ROUNDING = 2e-5
TYPES = ["depth", "position", "uv", "geo_normal", "sh_normal", "dp_du", "dp_dv", "albedo", "prim_index", "shape_index"]
#: A bent sheet with texture coordinates and normals, and one without either.
SHEET = """v -1 -1 0\nv 1 -1 0.2\nv 1 1 0\nv -1 1 -0.3\nvt 0 0\nvt 1 0.1\nvt 0.9 1\nvt 0.1 0.8
vn 0.1 0 1\nvn -0.2 0.1 1\nvn 0 0.2 1\nvn 0.1 -0.1 1\nf 1/1/1 2/2/2 3/3/3\nf 1/1/1 3/3/3 4/4/4\n"""
PLAIN = "v -1 -1 0\nv 1 -1 0.2\nv 1 1 0\nv -1 1 -0.3\nf 1 2 3\nf 1 3 4\n"


#: A filter that is drawn from, next to the pixel's centre.
NARROW = '<rfilter type="tent"><float name="radius" value="1e-5"/></rfilter>'


def text_of(folder, rfilter=NARROW, integrator=""):
    (folder / "sheet.obj").write_text(SHEET)
    (folder / "plain.obj").write_text(PLAIN)

    def shape(kind, x, y, scale, more, bsdf):
        return f"""<shape type="{kind}">{more}<transform name="to_world"><scale value="{scale}"/>
            <rotate x="1" angle="20"/><translate x="{x}" y="{y}"/></transform>{bsdf}</shape>"""

    sheet, plain = (f'<string name="filename" value="{folder / name}.obj"/>' for name in ("sheet", "plain"))
    grey = '<bsdf type="diffuse"><rgb name="reflectance" value="0.2, 0.5, 0.8"/></bsdf>'
    metal = '<bsdf type="roughconductor"><float name="alpha" value="0.4"/></bsdf>'
    both = f'<bsdf type="twosided">{grey}</bsdf>'
    flip = '<boolean name="flip_normals" value="true"/>'
    return f"""<scene version="3.0.0">{integrator}
        <sensor type="perspective"><float name="fov" value="40"/><float name="near_clip" value="0.5"/>
            <transform name="to_world"><lookat origin="0.3, -0.2, 5" target="0, 0, 0" up="0, 1, 0"/></transform>
            <film type="hdrfilm"><integer name="width" value="{SIZE}"/><integer name="height" value="{SIZE}"/>{rfilter}
            </film></sensor>
        {shape("obj", -1, -1, 0.7, sheet, grey)}{shape("obj", 1, -1, 0.7, sheet + flip, both)}
        {shape("obj", -1, 1, 0.7, plain, metal)}{shape("rectangle", 1, 1, 0.7, flip, grey)}
        <emitter type="constant"/></scene>"""


def test_pixel_centres_are_mitsubas_interactions(tmp_path) -> None:
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    text = text_of(tmp_path)
    ours = psdr.render_aov(psdr.load_string(text, allow_outside=True), [*TYPES, "mask"], spp=1)
    scene = mitsuba.load_string(text, optimize=False)
    sensor, shapes = scene.sensors()[0], list(scene.shapes())
    seen = 0
    expected = {kind: np.zeros(ours[kind].numpy().shape) for kind in (*TYPES, "mask")}
    for y, x in np.ndindex(SIZE, SIZE):
        ray, _weight = sensor.sample_ray(0.0, 0.5, [(x + 0.5) / SIZE, (y + 0.5) / SIZE], [0.0, 0.0])
        si = scene.ray_intersect(ray, mitsuba.RayFlags.All, True)
        if si.is_valid():
            seen += 1
            values = {
                **{"depth": si.t, "position": si.p, "uv": si.uv, "geo_normal": si.n, "sh_normal": si.sh_frame.n},
                **{"dp_du": si.dp_du, "dp_dv": si.dp_dv, "albedo": si.bsdf().eval_diffuse_reflectance(si)},
                **{"prim_index": si.prim_index, "shape_index": shapes.index(si.shape), "mask": 1.0},
            }
            for kind, value in values.items():
                expected[kind][y, x] = np.array(value)
    assert 15 < seen < SIZE * SIZE and len(np.unique(expected["shape_index"])) == 4
    # A rectangle is one primitive there and two triangles here.
    whole = (expected["shape_index"] == 3) & (expected["mask"] == 1)
    expected["prim_index"][whole] = ours["prim_index"].numpy()[whole]
    for kind, value in expected.items():
        scale = max(np.abs(value).max(), 1.0)
        np.testing.assert_allclose(ours[kind].numpy(), value, atol=ROUNDING * scale, err_msg=kind)


def test_means_are_those_of_mitsubas_integrator(tmp_path) -> None:
    """Under a Gaussian that the border cuts; the scene's file names what is wanted."""
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    names = {"dd.y": "depth", "p": "position", "t": "uv", "g": "geo_normal", "n": "sh_normal", "a": "albedo"}
    listed = ",".join(f"{name}:{kind}" for name, kind in names.items())
    integrator = f'<integrator type="aov"><string name="aovs" value="{listed}"/></integrator>'
    text = text_of(tmp_path, '<rfilter type="gaussian"/>', integrator)
    ours, theirs = psdr.load_string(text, allow_outside=True), mitsuba.load_string(text, optimize=False)
    assert list(psdr.render_aov(ours, spp=1)) == list(names)

    def batch(seed: int) -> np.ndarray:
        found = psdr.render_aov(ours, spp=64, seed=seed)
        return np.concatenate([found[name].numpy().reshape(SIZE, SIZE, -1) for name in names], axis=-1)

    a = np.stack([batch(seed) for seed in range(8)]).astype(np.float64)
    b = np.stack([np.array(mitsuba.render(theirs, spp=256, seed=i)) for i in range(8)]).astype(np.float64)
    assert a.shape == b.shape
    # Absorbs a Gaussian that is a polynomial and quotients of sums; relative to 1 where values are about 0.
    assert_same_mean(1.0 + a, 1.0 + b, "channels", rounding=2e-3)


def test_equal_bits_for_any_number_of_workers(tmp_path) -> None:
    scene = psdr.load_string(text_of(tmp_path, '<rfilter type="tent"/>'), allow_outside=True)
    try:
        found = []
        for workers in (1, 3):
            psdr.set_workers(workers)
            found.append(psdr.render_aov(scene, TYPES, spp=4, seed=2))
    finally:
        psdr.set_workers(None)
    for kind in TYPES:
        np.testing.assert_array_equal(found[0][kind].numpy(), found[1][kind].numpy(), err_msg=kind)


def test_far_from_the_origin_positions_are_the_worlds() -> None:
    far = 1e4
    pose = psdr.Transform.look_at((far, 0, 3), (far, 0, 0), (0, 1, 0))
    film = {"type": "hdrfilm", "width": 3, "height": 3, "rfilter": {"type": "box", "radius": 1e-4}}
    sensor = {"type": "orthographic", "to_world": pose, "film": film}
    plate = {"type": "rectangle", "to_world": psdr.Transform.translate((far, 0, 1))}
    with pytest.warns(psdr.SceneWarning, match="far from the origin"):
        scene = psdr.load_dict({"type": "scene", "sensor": sensor, "plate": plate})
    position = psdr.render_aov(scene, "position", spp=1)["position"].numpy()
    np.testing.assert_allclose(position[1, 1], [far, 0.0, 1.0], rtol=1e-6, atol=1e-3)


def sky(**integrator):
    film = {"type": "hdrfilm", "width": 2, "height": 2}
    more = {"i": integrator} if integrator else {}
    sensor = {"type": "perspective", "film": film}
    return psdr.load_dict({"type": "scene", "sensor": sensor, "sky": {"type": "constant"}, **more})


@pytest.mark.slow
def test_a_file_that_asks_for_channels_alone_has_no_image() -> None:
    alone = sky(type="aov", aovs="d:depth")
    with pytest.raises(ValueError, match=r"psdr\.render_aov\(scene\)"):
        psdr.render(alone, spp=1)
    assert psdr.render(alone, integrator="path", spp=1).numpy().max() == 1.0
    nested = sky(type="aov", aovs="d:depth", inner={"type": "path", "max_depth": 1})
    assert psdr.render(nested, spp=1).numpy().max() == 1.0
    assert psdr.render_aov(nested, spp=1)["d"].numpy().max() == 0.0


@pytest.mark.parametrize(
    ("aovs", "message"),
    [
        (None, r"aovs: got none.*\['depth', 'sh_normal'\]"),
        ("d:dept", "the type 'dept' is not supported.*did you mean 'depth'"),
        ("d:duv_dx", "no ray differentials.*supported: albedo"),
        ("d:depth,n", "got 'n'.*'dd.y:depth,nn:sh_normal'"),
        ("d:depth,d:uv", "'d' occurs twice"),
        (["normals"], "the type 'normals' is not supported"),
    ],
)
def test_what_cannot_be_computed_is_named(aovs, message) -> None:
    with pytest.raises(ValueError, match=message):
        psdr.render_aov(sky(), aovs, spp=1)
