"""Surfaces that are not there and lie exactly on others (``scene/shapes/interfaces.py``)."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.media import scenes
from warp_psdr.scene.shapes.interfaces import APART

T = psdr.Transform
IT = psdr.PathIntegrator(max_depth=4)
pytestmark = pytest.mark.filterwarnings("ignore::warp_psdr.SceneWarning")


def smoke(height, half=0.5, x=0.0, sigma_t=1.5, **more):
    """A cube of smoke whose bottom lies at a height."""
    pose = T.translate([x, 0.0, height + half]) @ T.scale(half)
    return {"type": "cube", "to_world": pose, "bsdf": scenes.NOTHING, "interior": scenes.medium(sigma_t, 0.8), **more}


def world(height=0.0, **more):
    """Smoke over a floor under a sky."""
    return psdr.load_dict(
        scenes.whole(
            sensor=scenes.camera([1.2, -3.2, 2.0], [0, 0, 0.4], 40.0, 16),
            floor=scenes.square(0.0, 3.0),
            smoke=smoke(height),
            sky=scenes.sky(1.0, 1.0, 1.0),
            **more,
        )
    )


def heights(scene, name="smoke"):
    """Height of a shape's lowest vertices, in ray offsets."""
    vertices = psdr.traverse(scene)[f"{name}.vertex_positions"].numpy()
    return vertices[:, 2].min() / scene.ray_epsilon


def test_vertices_move_inwards_once_and_follow_edits():
    scene = world()
    params = psdr.traverse(scene)
    assert heights(scene) == pytest.approx(APART, rel=0.01)
    vertices = params["smoke.vertex_positions"].numpy().copy()
    assert np.abs(np.abs(vertices[:, :2]) - 0.5).max() == 0.0 and vertices[:, 2].max() == 1.0
    assert any("'smoke' is not there ('null') and lies exactly on 'floor'" in note for note in scene.description.notes)
    params["smoke.vertex_positions"] = vertices  # and not a second time
    params.update()
    assert np.array_equal(params["smoke.vertex_positions"].numpy(), vertices)
    pose = params["smoke.to_world"].numpy().copy()
    pose[2, 3] += 0.1
    params["smoke.to_world"] = pose
    params.update()
    assert heights(scene) == pytest.approx(0.1 / scene.ray_epsilon + APART, rel=1e-4)  # as the edited vertices say
    floor = params["floor.vertex_positions"].numpy().copy()
    floor[:, 2] = 0.1
    params["floor.vertex_positions"] = floor  # the floor comes after it
    params.update()
    assert heights(scene) == pytest.approx(0.1 / scene.ray_epsilon + APART, rel=1e-4)
    floor[:, 2] += APART * scene.ray_epsilon
    params["floor.vertex_positions"] = floor  # it has risen onto the smoke, which goes on
    params.update()
    assert heights(scene) == pytest.approx(0.1 / scene.ray_epsilon + 2.0 * APART, rel=1e-4)
    state = scene.state()
    params["smoke.to_world"] = np.eye(4)
    params.update()
    scene.restore(state)
    assert np.array_equal(scene.state().values, state.values)


def test_glass_on_a_floor_is_an_image_as_if_it_were_lifted():
    """Without a gap, which of the two rays meet first is up to rounding: a tenth of the floor's light was missing."""

    def image(height, bsdf):
        block = {"type": "cube", "to_world": T.translate([0, 0, height + 0.5]) @ T.scale([0.7, 0.6, 0.5]), "bsdf": bsdf}
        floor = {**scenes.square(0.0, 3.0), "emitter": {"type": "area", "radiance": 1.0}}
        camera = scenes.camera([1.2, -3.2, 2.0], [0, 0, 0.4], 20.0, 16)
        scene = psdr.load_dict(scenes.whole(sensor=camera, floor=floor, block=block))
        return scene, psdr.render(scene, integrator=psdr.PathIntegrator(max_depth=8), spp=64).numpy()

    glass = {"type": "dielectric", "int_ior": 1.5}
    scene, standing = image(0.0, glass)
    assert heights(scene, "block") == pytest.approx(APART, rel=0.01)
    assert any("'block' is of glass ('dielectric') and lies exactly on 'floor'" in n for n in scene.description.notes)
    lifted = image(0.003, glass)[1]
    assert lifted.mean() > 0.3
    np.testing.assert_allclose(standing.mean((0, 1)), lifted.mean((0, 1)), rtol=0.005)
    stone = {"type": "diffuse", "reflectance": 0.5}
    assert heights(image(0.0, stone)[0], "block") == pytest.approx(0.0, abs=0.1)


def test_what_lies_inside_of_another_one_is_moved_further():
    """Nested interfaces on one floor, and two beside each other, which share a face."""
    scene = world(outer=smoke(0.0, 0.9), beside=smoke(0.0, 0.4, x=1.3))
    assert heights(scene, "outer") == pytest.approx(APART, rel=0.01)
    assert heights(scene, "smoke") == pytest.approx(2.0 * APART, rel=0.01)
    vertices = psdr.traverse(scene)
    gap = (
        vertices["beside.vertex_positions"].numpy()[:, 0].min() - vertices["outer.vertex_positions"].numpy()[:, 0].max()
    )
    assert gap == pytest.approx(APART * scene.ray_epsilon, rel=0.02)


@pytest.mark.parametrize(
    "pose",
    [T.translate([0, 0, 1e-3]), T.translate([6.5, 0, 0]), T.rotate([0, 1, 0], 1.0)],
    ids=["above", "beyond its end", "tilted"],
)
def test_what_lies_on_nothing_stays(pose):
    other = {**smoke(0.0, 0.45), "to_world": pose @ smoke(0.0, 0.45)["to_world"]}
    alone = psdr.load_dict(scenes.whole(sensor=scenes.camera([1, 1, 1], [0, 0, 0]), other=other))
    mine, theirs = (psdr.traverse(s)["other.vertex_positions"].numpy() for s in (world(other=other), alone))
    assert np.array_equal(mine, theirs)


def images(scene, seeds):
    return np.array([psdr.render(scene, integrator=IT, spp=256, seed=s).numpy().mean() for s in seeds])


def test_no_light_comes_through_the_floor():
    """The image is that of smoke a thousandth above the floor; by chance it was 2 % brighter."""
    lying, above = images(world(), range(6)), images(world(1e-3), range(10, 16))
    noise = np.sqrt((lying.var(ddof=1) + above.var(ddof=1)) / len(lying))
    assert abs(lying.mean() - above.mean()) < 4.0 * noise < 4e-3 * above.mean()


@pytest.mark.slow
def test_a_floor_that_shines_through_smoke_and_its_derivative():
    """Seen at an angle t through a slab of the height 1 it has exp(-sigma / cos t), by a camera that turns, too."""
    sigma, t = 1.5, np.deg2rad(35.0)
    place = np.array([0.0, -2.0 * np.sin(t), 0.5 + 2.0 * np.cos(t)])
    floor = scenes.square(0.0, 3.0, scenes.BLACK, emitter={"type": "area", "radiance": 1.0})
    scene = psdr.load_dict(
        scenes.whole(
            sensor=scenes.camera(place.tolist(), [0, 0, 0.5], 0.5, 1),
            floor=floor,
            smoke=smoke(0.0, sigma_t=sigma)
            | {"to_world": T.translate([0, 0, 0.5]) @ T.scale([1.5, 1.5, 0.5]), "interior": scenes.medium(sigma, 0.0)},
        )
    )
    params = psdr.traverse(scene)
    pose = params["sensor.to_world"].numpy().astype(np.float64)
    tangent = np.zeros((4, 4))
    tangent[:3, :3] = np.cross([1.0, 0.0, 0.0], pose[:3, :3], axisb=0, axisc=0)  # the view turns about x, up
    options = {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 1 << 15}
    seeds = range(8)
    image = np.array([psdr.render(scene, seed=k, **options).numpy().mean() for k in seeds])
    slope = np.array(
        [
            psdr.render_forward(scene, params, {"sensor.to_world": tangent}, seed=k, **options).numpy().mean()
            for k in seeds
        ]
    )
    expected = np.exp(-sigma / np.cos(t))
    for found, value in ((image, expected), (slope, -sigma * np.tan(t) / np.cos(t) * expected)):
        noise = found.std(ddof=1) / np.sqrt(len(found))
        assert noise < 5e-3 * abs(value) and abs(found.mean() - value) < 4.0 * noise + 1e-3 * abs(value), (found, value)
