"""Guards of lights without a surface: the poles of a map, the edge of a cone, and directions that are none."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.emitter.helpers import Light, envmap, light_frame_directions, pose, random_map
from tests.estimate.test_invalid import scene_dict
from warp_psdr.kernels import constants as c
from warp_psdr.kernels.path import make_path_step
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import path_from

#: Scenes that are noted to be at the edge of what floats hold are what is tested.
pytestmark = pytest.mark.filterwarnings("ignore::warp_psdr.SceneWarning")

SIZE = 12
#: Angle to a map's pole (radians) within which the azimuth has no derivative.
AT_POLE = 1e-6
#: Float32 roundings of a direction, of its angles and of a position within a cell.
ROUNDINGS = 1e-4


def looked_up(data: np.ndarray, v: np.ndarray, w: np.ndarray, scale: float) -> np.ndarray:
    """(n,) dot(w, radiance) of a map in directions (n, 3) of its own frame, any length, float64."""
    height, width = data.shape[:2]
    x = np.arctan2(v[:, 0], -v[:, 2]) / (2.0 * np.pi) * width - 0.5
    y = np.arctan2(np.hypot(v[:, 0], v[:, 2]), v[:, 1]) / np.pi * (height - 1)
    column, row = np.floor(x).astype(int), np.minimum(np.floor(y).astype(int), height - 2)
    s, t = (x - column)[:, None], (y - row)[:, None]
    a, b = column % width, (column + 1) % width
    top = (1.0 - s) * data[row, a] + s * data[row, b]
    bottom = (1.0 - s) * data[row + 1, a] + s * data[row + 1, b]
    return scale * (w * ((1.0 - t) * top + t * bottom)).sum(axis=1)


@pytest.mark.parametrize("role", ["reverse", "forward"])
def test_derivatives_beside_a_pole_are_right_and_those_at_it_bounded(role: str) -> None:
    """They grow as 1 / sin(theta), up to 1e6: rounding alone turns what is nearer, by any angle."""
    data, scale = random_map().astype(np.float64), 1.5
    light = envmap(data, rotation=np.eye(3), scale=scale)
    # Within the cells of all columns, and far enough from their borders for a difference.
    turns = 2.0 * np.pi * (np.arange(8) + 0.5 + np.linspace(0.2, 0.8, 8)) / 8
    radii = np.repeat([1e-3, 1e-4, 1e-5, 2e-6, 5e-7, 1e-7, 1e-8, 0.0], 8)
    around = np.tile(light_frame_directions(np.full(8, 0.5 * np.pi), turns), (8, 1))
    for pole in (1.0, -1.0):
        v = np.float32(radii[:, None] * around + [0.0, pole, 0.0])
        w = np.random.default_rng(1).normal(size=v.shape).astype(np.float32)
        found, _dot, target = light.vjp(role, np.zeros(len(light.values)), v, w, w)
        assert np.isfinite(found).all() and np.isfinite(target).all()
        step = 1e-3 * radii[:, None]
        steps = [step * e for e in np.eye(3)]
        x = v.astype(np.float64)
        with np.errstate(invalid="ignore"):
            difference = [(looked_up(data, x + h, w, scale) - looked_up(data, x - h, w, scale)) for h in steps]
            expected = np.stack(difference, axis=1) / (2.0 * step)
        outside = radii > AT_POLE
        size = np.linalg.norm(expected[outside], axis=1, keepdims=True)
        # Absorbs the difference's remainder, (1e-3)^2, too.
        assert (np.abs(found[outside] - expected[outside]) < ROUNDINGS * size).all()
        assert (size * radii[outside, None] > 0.01).sum() > 16
        largest = scale * np.abs(w).sum(axis=1).max() * data.max() * (8 / (2.0 * np.pi) / AT_POLE + 5 / np.pi)
        assert np.abs(found).max() < largest and not found[~outside].any()


def test_a_map_has_nothing_where_there_is_no_direction() -> None:
    """NaN, which counts as an invalid sample; an angle of the arctangent would be any texel, its integer no index."""
    light = envmap(random_map())
    v = np.array([[np.nan] * 3, [0.0, np.nan, 1.0], [np.inf, 0.0, 0.0], [-np.inf, np.inf, 1.0], [0.0, 0.0, 0.0]])
    radiance, pdf = light.evaluate(v)
    assert np.isnan(radiance).all() and np.isnan(pdf).all()
    ones = np.ones((5, 3))
    for role in ("reverse", "forward"):
        _x, dot, target = light.vjp(role, np.zeros(len(light.values)), v, ones, ones)
        assert (dot > 0.0).all() if role == "reverse" else np.isnan(dot).all()
        assert not target.any()
    # Nor does a light without a pose shine from one.
    for pose_of in (np.nan, 0.0):
        values = light.values.copy()
        values[light.where["to_world"]] = pose_of
        assert np.isnan(light.sample(ones, 0.3 * ones[:, :2], values).wi).all()


def test_a_cone_ends_at_its_angle() -> None:
    """Shares in [0, 1] with and without a falloff; where beam and cone coincide, or have passed each other, a step."""
    # Points at all angles to the axis, exactly at 45 degrees among them.
    degrees = np.concatenate([np.linspace(0.0, 180.0, 721), 45.0 + np.linspace(-1e-3, 1e-3, 41)])
    x = np.stack([np.sin(np.radians(degrees)), 0.0 * degrees, np.cos(np.radians(degrees))], axis=1)
    x = np.concatenate([x, [[1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], [0.0, 3.0, 3.0]]]).astype(np.float32)
    ones = np.ones_like(x)
    for beam in (20.0, 45.0, 60.0):
        light = Light(c.EMITTER_SPOT, radiance=[2.0], to_world=pose(np.eye(3)), angles=[45.0, beam])
        share = light.sample(x, ones[:, :2]).radiance[:, 0] * (x.astype(np.float64) ** 2).sum(axis=1) / 2.0
        # Absorbs roundings of the inverse square.
        assert share.min() == 0.0 and 1.0 - 1e-6 < share.max() < 1.0 + 1e-6
        inside, outside = degrees < min(beam, 45.0) - 1e-3, degrees > 45.0 + 1e-3
        assert (share[: len(degrees)][inside] > 1.0 - 1e-6).all() and not share[: len(degrees)][outside].any()
        for role in ("reverse", "forward"):
            tangent = np.ones(len(light.values)) if role == "forward" else np.zeros(len(light.values))
            found, dot, target = light.vjp(role, tangent, x, ones, ones)
            assert np.isfinite(found).all() and np.isfinite(dot).all() and np.isfinite(target).all()
            if beam < 45.0:
                continue
            step = np.abs(degrees - 45.0) > 1e-3
            same = Light(c.EMITTER_POINT, radiance=[2.0], position=[0.0, 0.0, 0.0])
            expected = same.vjp(role, np.zeros(len(same.values)), x, share[:, None] * ones, ones)[0]
            np.testing.assert_allclose(
                found[: len(degrees)][step], expected[: len(degrees)][step], rtol=1e-4, atol=1e-4
            )


FACING = psdr.Transform.look_at([0.0, 0.0, 3.0], [0.0, 0.0, 0.0], [0, 1, 0])
POINT = {"type": "point", "position": [0.0, 0.0, 1.5]}
SPOT = {"type": "spot", "to_world": FACING, "cutoff_angle": 80.0}
MAP = {"type": "envmap", "bitmap": np.ones((4, 8, 3), np.float32)}
#: A light, a parameter, and the number of it that is NaN.
LIGHTS = {
    "point": (POINT, "lamp.position", 0),
    "spot": (SPOT, "lamp.to_world", 3),
    "spot without an axis": (SPOT, "lamp.to_world", 2),
    "projector": ({"type": "projector", "to_world": FACING, "fov": 100.0, "scale": 20.0}, "lamp.to_world", 3),
    "sun": ({"type": "directional", "to_world": FACING}, "lamp.to_world", 2),
    "map": (MAP, "lamp.to_world", 0),
    "camera and map": (MAP, "sensor.to_world", 0),
    "camera and sky": ({"type": "constant"}, "sensor.to_world", 0),
    "camera without a direction": (POINT, "sensor.to_world", 0),
    "camera without a place": (POINT, "sensor.to_world", 3),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LIGHTS)
def test_what_has_no_pose_is_counted(name: str) -> None:
    """A pose that holds NaN makes samples invalid, not a light that is off, a black image or one of a single texel."""
    light, parameter, number = LIGHTS[name]
    description = {k: v for k, v in scene_dict().items() if k != "blocker"} | {"lamp": light}
    options = {"integrator": psdr.PathIntegrator(max_depth=2, boundary=None, sampler="independent"), "spp": 1}
    scene = psdr.load_dict(description)
    seen = (psdr.render(scene, **options).numpy() > 0.0).all(axis=2).sum()
    values = scene.values.numpy()
    values[scene.parameters[parameter].offset + number] = np.nan
    scene.values.assign(values)
    with pytest.warns(RuntimeWarning, match="image: "):
        image = psdr.render(scene, **options).numpy()
    assert not image.any()
    expected = SIZE**2 if parameter.startswith("sensor") else seen
    assert psdr.invalid_samples(scene)["image"] == expected > 0


@pytest.mark.slow
@pytest.mark.parametrize("sky", [{}, {"lamp": MAP}, {"lamp": {"type": "constant"}}], ids=["none", "map", "even"])
def test_rays_that_are_none_meet_nan(sky: dict) -> None:
    """Neither a surface nor the sky nor the dark: of rays from no place, and of those in no direction."""
    scene = psdr.load_dict({k: v for k, v in scene_dict().items() if k != "lamp"} | sky)
    path_step = make_path_step(psdr.plan(scene, integrator=psdr.PathIntegrator(max_depth=2)).config, False)

    @wp.kernel(module="unique", enable_backward=False)
    def met(scene: Scene, o: wp.array(dtype=wp.vec3), d: wp.array(dtype=wp.vec3), direct_out: wp.array(dtype=wp.vec3)):
        i = wp.tid()
        vertex, after = path_step(
            scene, sampler_at(i, 0, wp.uint32(1)), path_from(o[i], d[i], wp.static(c.FAR), 0), 2, 100
        )
        direct_out[i] = vertex.direct
        if vertex.face >= 0 or after.alive == 1:
            direct_out[i] = wp.vec3(1.0, 1.0, 1.0)

    o = np.zeros((6, 3), np.float32) + np.float32([0.1, 0.1, 1.0])
    d = np.zeros((6, 3), np.float32) + np.float32([0.0, 0.0, 1.0])
    o[1], o[2, 1], d[3], d[4, 0], d[5, 2] = np.nan, np.inf, np.nan, np.nan, -np.inf
    direct = wp.zeros(6, dtype=wp.vec3)
    wp.launch(met, 6, [scene.data(), wp.array(o, dtype=wp.vec3), wp.array(d, dtype=wp.vec3)], [direct])
    assert (direct.numpy()[0] == float(bool(sky))).all() and np.isnan(direct.numpy()[1:]).all()
