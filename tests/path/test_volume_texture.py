"""Textures that are volumes, and scaled mesh attributes: Mitsuba's images, exact values, what may not be."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.peer import MITSUBA_ROUNDING, for_mitsuba
from warp_psdr.scene import describe_dict

from .helpers import assert_same_mean, batches, blocks

T = psdr.Transform
SIZE = 16
POSE = T.translate([-1.2, -1.4, -1.1]) @ T.rotate([0.2, 0.5, 0.8], 25) @ T.scale([2.2, 2.6, 2.1])
VOXELS = np.random.default_rng(0).uniform(0.1, 0.9, (4, 3, 5, 3)).astype(np.float32)
VOLUME = {"type": "volume", "volume": {"type": "gridvolume", "data": VOXELS, "to_world": POSE}}


def scene(reflectance, **more):
    """Return a cube before a sky, one of whose corners looks at the camera."""
    camera = {
        "type": "perspective",
        "fov": 45.0,
        "to_world": T.look_at((2, -3, 2), (0, 0, 0), (0, 0, 1)),
        "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}},
    }
    cube = {"type": "cube", "bsdf": {"type": "diffuse", "reflectance": reflectance}, **more}
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 0.8, 0.6]}}
    return {"type": "scene", "integrator": {"type": "path"}, "camera": camera, "cube": cube, "sky": sky}


@pytest.mark.slow
def test_images_equal_mitsubas():
    """Interpolated voxels of a turned grid, read beyond its box too."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    parts = scene(VOLUME)
    theirs = for_mitsuba(mi, parts)
    grid = theirs["cube"]["bsdf"]["reflectance"]["volume"]
    grid["grid"] = mi.VolumeGrid(VOXELS)
    del grid["data"]
    theirs = mi.load_dict(theirs)
    theirs = np.stack([np.array(mi.render(theirs, spp=64, seed=i)) for i in range(16)]).astype(np.float64)
    ours = batches(psdr.load_dict(parts), spp=64)
    assert_same_mean(blocks(ours, 2), blocks(theirs, 2), "volume", MITSUBA_ROUNDING)


def test_a_grid_is_read_at_the_point_of_the_scene_wherever_that_is():
    """Nearest voxels of a grid of one step along z, in a scene far from the origin; constants are constants."""
    far = T.translate([1000.0, 500.0, 0.0])
    step = np.zeros((2, 1, 1, 1), np.float32) + np.array([0.25, 0.75], np.float32)[:, None, None, None]
    box = {"to_world": far @ T.translate([-1, -1, -1]) @ T.scale(2), "filter_type": "nearest"}
    parts = scene({"type": "volume", "volume": {"type": "gridvolume", "data": step, **box}})
    parts["camera"]["to_world"] = far @ parts["camera"]["to_world"]
    parts["cube"]["to_world"] = far
    with pytest.warns(psdr.SceneWarning, match="far from the origin"):
        loaded = psdr.load_dict(parts)
    found = psdr.render_aov(loaded, ["albedo", "position"], spp=1)
    z, albedo = found["position"].numpy()[..., 2], found["albedo"].numpy()[..., 0]
    seen = albedo > 0.0
    assert seen.sum() > 50
    np.testing.assert_allclose(albedo[seen], np.where(z[seen] < 0.0, 0.25, 0.75), rtol=1e-6)


def test_a_constant_volume_is_a_constant():
    loaded = psdr.load_dict(scene({"type": "volume", "volume": {"type": "constvolume", "value": 0.4}}))
    names = [name for name in psdr.traverse(loaded) if "reflectance" in name]
    assert names == ["cube.bsdf.reflectance.volume.value.value"]


def test_names_are_those_of_mitsuba_and_the_pose_is_followed():
    loaded = psdr.load_dict(scene(VOLUME))
    params = psdr.traverse(loaded)
    data, pose = (f"cube.bsdf.reflectance.volume.{name}" for name in ("data", "to_world"))
    assert [name for name in params if "reflectance" in name] == [data, pose]
    (held,) = loaded.builder.volume_poses
    params[pose] = T.translate([0.5, 0.0, 0.0]).matrix
    params.update()
    inverse = loaded.values.numpy()[held.inverse : held.inverse + 12].reshape(3, 4)
    np.testing.assert_array_equal(inverse, [[1, 0, 0, -0.5], [0, 1, 0, 0], [0, 0, 1, 0]])
    params[pose] = np.diag([1.0, 0.0, 1.0, 1.0])
    with pytest.raises(ValueError, match=r"volume.to_world: .*no inverse.*restore"):
        params.update()


def test_nearest_voxels_may_not_slide():
    grid = {**VOLUME["volume"], "filter_type": "nearest"}
    loaded = psdr.load_dict(scene({"type": "volume", "volume": grid}))
    params = psdr.traverse(loaded)
    for name in ("cube.bsdf.reflectance.volume.to_world", "cube.to_world", "camera.to_world"):
        params.requires_grad_only(name)
        with pytest.raises(ValueError, match="trilinear"):
            psdr.plan(loaded, params)


@pytest.mark.slow
def test_a_scale_is_a_factor_and_a_parameter():
    """Twice the attribute is the image of its double, on surfaces and lights, and beside a checkerboard."""
    parts = scene({"type": "mesh_attribute", "name": "face_tint"})["cube"]
    cube = {"type": "mesh", "vertices": np.eye(3), "faces": [[0, 1, 2]], "bsdf": parts["bsdf"]}
    tint = np.array([[0.1, 0.2, 0.3]])

    def image(tint, **scale):
        half = {
            "type": "checkerboard",
            "color0": 0.3,
            "color1": {"type": "mesh_attribute", "name": "face_tint", **scale},
        }
        lit = {"type": "area", "radiance": {"type": "mesh_attribute", "name": "face_tint", **scale}}
        shape = {**cube, "face_tint": tint, "bsdf": {"type": "diffuse", "reflectance": half}, "emitter": lit}
        loaded = psdr.load_dict({**scene(0.5), "cube": shape})
        integrator = psdr.PathIntegrator(max_depth=2)
        return loaded, psdr.render(loaded, integrator=integrator, spp=4).numpy()

    loaded, doubled = image(tint, scale=2.0)
    np.testing.assert_allclose(doubled, image(2.0 * tint)[1], rtol=1e-5)
    names = [name for name in psdr.traverse(loaded) if name.endswith("scale")]
    assert names == ["cube.bsdf.reflectance.color1.scale", "cube.emitter.radiance.scale"]


@pytest.mark.parametrize(
    ("reflectance", "words"),
    [
        ({"type": "volume"}, "there is no volume.*'gridvolume'"),
        ({"type": "volume", "volume": {"type": "gridvolume", "data": np.full((2, 2, 2), -1.0)}}, "'volume'"),
        (
            {"type": "volume", "volume": {"type": "gridvolume", "data": VOXELS, "to_world": T.scale([1, 0, 1])}},
            "invert|inverse",
        ),
        ({"type": "volume", "volume": {"type": "checkerboard"}}, "unsupported volume|is no volume"),
    ],
)
def test_what_cannot_be_is_named(reflectance, words):
    with pytest.raises(ValueError, match=words):
        describe_dict(scene(reflectance))


def test_where_volumes_cannot_be_is_named():
    with pytest.raises(ValueError, match=r"radiance.*a 'volume'.*bitmaps"):
        describe_dict(scene(0.5, emitter={"type": "area", "radiance": VOLUME}))
    with pytest.raises(ValueError, match=r"a volume of 3 channels.*one number"):
        describe_dict({**scene(0.5), "cube": {"type": "cube", "bsdf": {"type": "roughconductor", "alpha": VOLUME}}})
    with pytest.raises(ValueError, match="times its scale"):
        tint = {"type": "mesh_attribute", "name": "face_tint", "scale": 2.0}
        mesh = {"type": "mesh", "vertices": np.eye(3), "faces": [[0, 1, 2]], "face_tint": [[0.9]]}
        describe_dict({**scene(0.5), "cube": {**mesh, "bsdf": {"type": "diffuse", "reflectance": tint}}})
