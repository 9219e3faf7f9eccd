"""Volumes in scene files: arrays, .vol files, names, boxes, and what is wrong."""

import struct
from pathlib import Path

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.scene import describe_dict

#: Of a sensor that stands in the medium, and of small grids in a large cube.
pytestmark = pytest.mark.filterwarnings(
    "ignore:'sensor' names no medium", "ignore:.* is not 0 at the border of its box"
)
SKY = {"type": "constant"}
CUBE = {"type": "cube", "bsdf": {"type": "null"}}
GRIDS = Path(__file__).parent / "grids"
VALUES = np.arange(24, dtype=np.float32).reshape(2, 3, 4, 1)


def whole(kind="heterogeneous", **medium):
    cube = {**CUBE, "interior": {"type": kind, **medium}}
    return {"type": "scene", "sensor": {"type": "perspective"}, "sky": SKY, "cube": cube}


def inside(kind="heterogeneous", **medium):
    return describe_dict(whole(kind, **medium)).shapes[0].interior


def given(**volume):
    return {"type": "gridvolume", **volume}


def header(version=3, encoding=1, size=(4, 3, 2), channels=1, box=(0, 0, 0, 1, 1, 2)):
    return b"VOL" + struct.pack("<Biiiii6f", version, encoding, *size, channels, *box)


@pytest.fixture
def vol(tmp_path):
    def write(content=None, name="a.vol"):
        file = tmp_path / name
        file.write_bytes(header() + VALUES.astype("<f4").tobytes() if content is None else content)
        return str(file)

    return write


def load(name, **more):
    scene = whole(sigma_t=given(filename=name, **more))
    return describe_dict(scene, allow_outside=True).shapes[0].interior.sigma_t


def test_arrays():
    found = inside(sigma_t=given(data=VALUES[..., 0]), albedo=given(data=np.full((1, 2, 3, 3), 0.5)))
    assert found.grids and found.sigma_t.value.shape == (2, 3, 4, 1) and found.albedo.value.shape == (1, 2, 3, 3)
    assert found.sigma_t.filter == "trilinear" and found.sigma_t.wrap == "clamp"
    np.testing.assert_array_equal(found.sigma_t.to_world, np.eye(4))
    found = inside(sigma_t=given(data=VALUES, filter_type="nearest", wrap_mode="mirror", raw=True, max_value=23.0))
    assert found.sigma_t.filter == "nearest" and found.sigma_t.wrap == "mirror"
    pose = psdr.Transform.translate([1, 2, 3])
    found = inside(sigma_t={"type": "constvolume", "value": 2.0, "to_world": pose})
    np.testing.assert_array_equal(found.sigma_t.to_world, pose.matrix)
    assert inside(albedo=0.5).sigma_t.value.tolist() == [1.0]


def test_files(vol):
    found = load(vol())
    np.testing.assert_array_equal(found.value, VALUES)
    np.testing.assert_array_equal(found.to_world, np.eye(4))
    found = load(vol(), use_grid_bbox=True, to_world=psdr.Transform.scale(3.0))
    np.testing.assert_array_equal(found.to_world, np.diag([3.0, 3.0, 6.0, 1.0]))


def test_mitsuba_writes_the_same_files_and_lists_the_same_names(tmp_path):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    file = str(tmp_path / "mitsuba.vol")
    mi.VolumeGrid(VALUES).write(file)
    np.testing.assert_array_equal(load(file).value, VALUES)
    scene = whole(sigma_t=given(filename=file), albedo=0.5, phase={"type": "hg"})
    theirs = {name for name in mi.traverse(mi.load_dict(scene)).keys() if "medium" in name}
    ours = psdr.traverse(psdr.load_dict(scene))
    # Where a grid is has no parameter there.
    assert theirs == {name for name in ours if "medium" in name and not name.endswith("sigma_t.to_world")}
    assert ours["cube.interior_medium.sigma_t.data"].shape == (2, 3, 4, 1)
    values = inside(sigma_t=given(grid=mi.VolumeGrid(VALUES))).sigma_t.value
    np.testing.assert_array_equal(values.reshape(VALUES.shape), VALUES)


def test_sparse_grids_become_dense():
    """Written by ``wp.Volume.save_to_nvdb``: 5 x 4 x 3 values from voxel (9, 2, 3) on, half a unit apart."""
    found = load(str(GRIDS / "floats.nvdb"))
    z, y, x = np.meshgrid(np.arange(3), np.arange(4), np.arange(5), indexing="ij")
    np.testing.assert_array_equal(found.value[..., 0], 1 + x + 10 * y + 100 * z)
    np.testing.assert_array_equal(found.to_world, np.eye(4))
    box = load(str(GRIDS / "floats.nvdb"), use_grid_bbox=True).to_world
    np.testing.assert_allclose(box @ (0, 0, 0, 1), (1 + 4.25, 2 + 0.75, 3 + 1.25, 1))
    np.testing.assert_allclose(box @ (1, 1, 1, 1), (1 + 6.75, 2 + 2.75, 3 + 2.75, 1))
    colours = describe_dict(
        whole(albedo=given(filename=str(GRIDS / "vectors.nvdb"), use_grid_bbox=True)), allow_outside=True
    )
    albedo = colours.shapes[0].interior.albedo
    np.testing.assert_array_equal(albedo.value[0, 0], np.float32([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]))
    np.testing.assert_allclose(albedo.to_world @ (0, 0, 0, 1), (1, 3, 5, 1))


@pytest.mark.parametrize("name", ["magic", "cut", "empty", "ints"])
def test_bad_sparse_grids_are_refused(vol, name):
    content = (GRIDS / "floats.nvdb").read_bytes()
    if name == "ints":
        with pytest.raises(ValueError, match="grid of type 'int32'; write one of: Vec3f, float"):
            load(str(GRIDS / "ints.nvdb"))
        return
    bad = {"magic": b"VOL" + content[3:], "cut": content[: len(content) // 2], "empty": b""}[name]
    with pytest.raises(ValueError, match="is not read as NanoVDB"):
        load(vol(bad, f"{name}.nvdb"))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"VOX" + header()[3:], "is no .vol file"),
        (header()[:20], "is no .vol file"),
        (header(version=2), "version 2.*write version 3"),
        (header(encoding=3) + bytes(24), "uint8.*write little-endian float32"),
        (b"VOL\x03" + struct.pack(">i", 1) + header()[8:], "another byte order"),
        (header() + VALUES.tobytes()[:-4], "has 140 bytes, and 4 x 3 x 2 voxels of 1 channels take 144"),
        (header() + VALUES.tobytes() + b"1234", "has 148 bytes"),
        (header(size=(1000, 1000, 1000)), "declares 1000 x 1000 x 1000 voxels.*at most"),
        (header(size=(2**31 - 1, 2**31 - 1, 2**31 - 1)), "at most"),
        (header(size=(-1, 1, 1)), "give 1 or more"),
        (header(box=(0, 0, 0, 1, -1, 1)) + VALUES.tobytes(), "the box"),
        (header(box=(0, 0, 0, 1, float("nan"), 1)) + VALUES.tobytes(), "the box"),
        (header(size=(2, 3, 2), channels=2) + VALUES.tobytes(), r"\(2, 3, 2, 2\).*give numbers"),
        (header() + np.full(24, np.nan, "<f4").tobytes(), "holds NaN or infinity"),
        (header() + np.full(24, -1.0, "<f4").tobytes(), "values out of range.*at least 0"),
    ],
)
def test_bad_files_are_refused(vol, content, words):
    with pytest.raises(ValueError, match=words):
        load(vol(content))


@pytest.mark.parametrize(
    ("medium", "words"),
    [
        ({"sigma_t": given()}, "there are no values.*give one of"),
        ({"sigma_t": given(data=VALUES, filename="a.vol")}, "got filename and data"),
        ({"sigma_t": given(data=VALUES[0, :, :, 0])}, r"got the shape \(3, 4\).*give numbers \(Z, Y, X\)"),
        ({"sigma_t": given(data=np.ones((2, 2, 2, 2)))}, "give numbers"),
        ({"sigma_t": given(data=np.ones((2, 2, 2, 6)))}, "give numbers"),
        ({"sigma_t": given(data=np.ones((0, 2, 2)))}, "give numbers"),
        ({"sigma_t": given(data="smoke")}, "got no array|got the shape"),
        ({"sigma_t": given(data=-VALUES)}, "values out of range"),
        ({"sigma_t": given(data=VALUES, max_value=22.0)}, "values up to 23, where tracking would be wrong"),
        ({"sigma_t": given(data=VALUES, filter_type="bilinear")}, "give one of: trilinear, nearest"),
        ({"sigma_t": given(data=VALUES, wrap_mode="border")}, "give one of: clamp, repeat, mirror"),
        ({"sigma_t": given(data=VALUES, to_world=np.diag([1.0, 0.0, 1.0, 1.0]))}, "singular"),
        ({"sigma_t": given(data=VALUES, other=1)}, "no parameter 'other'"),
        ({"sigma_t": given(filename="none.nvdb")}, "none.nvdb"),
        ({"sigma_t": given(filename="smoke.VDB")}, "is a .vdb file.*nanovdb_convert"),
        ({"sigma_t": given(filename="none.vol")}, "none.vol"),
        ({"albedo": given(data=VALUES)}, "between 0 and 1"),
        ({"kind": "homogeneous", "sigma_t": given(data=VALUES)}, "a grid in a 'homogeneous' medium.*'heterogeneous'"),
    ],
)
def test_what_is_wrong_is_named(medium, words):
    with pytest.raises((ValueError, FileNotFoundError), match=words):
        inside(**medium)


def test_edits_stay_in_range():
    scene = psdr.load_dict(whole(sigma_t=given(data=VALUES)))
    params, name = psdr.traverse(scene), "cube.interior_medium.sigma_t.data"
    values = VALUES.copy()
    values[0, 0, :2] = -0.5
    params[name].assign(values.reshape(params[name].shape))  # in place, which the next update looks at
    with pytest.raises(ValueError, match=r"sigma_t.data is -0.5 in 2 of 24 places after an edit; write finite values"):
        params.update()
    params[name] = VALUES
    params.update()
    assert params.bounds(name) == (0.0, np.inf)


def test_a_scene_far_away_keeps_its_grids():
    """Matrices are relative to the scene's origin."""
    far = psdr.Transform.translate([1e5, 0, 0])
    scene = whole(sigma_t=given(data=VALUES, to_world=far))
    scene["cube"]["to_world"] = far
    with pytest.warns(psdr.SceneWarning, match="far from the origin"):
        loaded = psdr.load_dict(scene)
    record = loaded.builder.textures[loaded.builder.media[0].sigma_t]
    found = loaded.values.numpy()[record.to_uv : record.to_uv + 12].reshape(3, 4)
    assert loaded.origin[0] > 9e4 and abs(found[0, 3] - (loaded.origin[0] - 1e5)) < 1e-3
