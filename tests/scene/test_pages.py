"""Large arrays of a scene on the CPU: held once, and edited on either side without a change of the other."""

import copy
import gc
import os
import pickle
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.media import test_grids
from tests.scene import test_sdfgrid
from tests.scene.test_volumes import header
from warp_psdr.scene import edits, pages
from warp_psdr.scene.files.volume_files import read_vol
from warp_psdr.scene.media.super_grid import super_grid
from warp_psdr.topology import unchanged

#: Nodes along an axis of a grid that is large.
N = 96
MAPS = Path("/proc/self/maps")
DATA, GRID = test_grids.DATA, "body.grid"
AWAY = psdr.Transform.translate([4096.0, 0.0, 0.0])

pytestmark = [
    pytest.mark.filterwarnings("ignore::warp_psdr.SceneWarning"),
    pytest.mark.filterwarnings("ignore:.* is not 0 at the border of its box"),
]


def density(n: int) -> np.ndarray:
    return np.random.default_rng(1).random((n, n, n, 1), np.float32)


def smoke(n: int, **more) -> dict:
    found = test_grids.slab()
    found["slab"]["interior"]["sigma_t"] = {**found["slab"]["interior"]["sigma_t"], "data": density(n), **more}
    return found


def ball(n: int) -> dict:
    at = np.linspace(-0.5, 0.5, n, dtype=np.float32)
    z, y, x = np.meshgrid(at, at, at, indexing="ij", sparse=True)
    return test_sdfgrid.described(grid=np.sqrt(x * x + y * y + z * z) - np.float32(0.3))


def far(n: int) -> dict:
    found = smoke(n)
    for part in (found["sensor"], found["slab"], found["slab"]["interior"]["sigma_t"]):
        part["to_world"] = AWAY @ part["to_world"]
    return found


def file(n: int, folder: Path) -> dict:
    name = folder / "smoke.vol"
    name.write_bytes(header(size=(n, n, n)) + density(n).tobytes())
    found = smoke(n, filename=str(name))
    del found["slab"]["interior"]["sigma_t"]["data"]
    return found


def load(description: dict) -> psdr.Scene:
    return psdr.load_dict(description, device="cpu")


def described(scene: psdr.Scene) -> np.ndarray:
    """Return the grid that a scene's description holds."""
    shape = scene.description.shapes[0]
    return shape.interior.sigma_t.value if shape.geometry is None else shape.geometry.values


def places(least: int = 2 * N**3) -> list[int]:
    """Return the addresses of all arrays that are alive and have at least so many bytes, half of a large grid's."""
    gc.collect()
    found, seen, left = set(), set(), gc.get_objects()
    while left:
        for held in gc.get_referents(left.pop()):
            if isinstance(held, np.ndarray) and held.nbytes >= least:
                found.add(held.__array_interface__["data"][0])
            elif type(held) is wp.array and held.ptr and held.size * 4 >= least:
                found.add(held.ptr)
            elif isinstance(held, tuple | list | dict) and not gc.is_tracked(held) and id(held) not in seen:
                seen.add(id(held))
                left.append(held)
    return sorted(found)


def inode(place: int) -> int:
    """Return the number of the file that memory is mapped from; 0: from none."""
    for line in MAPS.read_text().splitlines():
        ends, _rights, _offset, _device, number = line.split()[:5]
        first, last = (int(end, 16) for end in ends.split("-"))
        if first <= place < last:
            return int(number)
    raise AssertionError(f"{place:x} is not mapped")


@pytest.fixture(scope="module")
def before() -> list[int]:
    """Large arrays that are not of these tests."""
    return places()


@pytest.mark.skipif(not MAPS.exists(), reason="only Linux tells what memory is mapped from")
@pytest.mark.parametrize("make", [smoke, ball, far, file])
def test_a_large_grid_is_held_once(make, before: list[int], tmp_path) -> None:
    scene = load(make(N, tmp_path) if make is file else make(N))
    params = psdr.traverse(scene)
    psdr.render(scene, spp=1)
    assert params[DATA if make is not ball else GRID].size == N**3
    held = [place for place in places() if place not in before]
    files = {inode(place) for place in held}
    assert len(held) >= 2 and len(files) == 1 and 0 not in files
    assert inode(described(scene).__array_interface__["data"][0]) in files


@pytest.mark.parametrize("make", [smoke, ball])
@pytest.mark.parametrize("memory", [True, False], ids=["memory", "file"])
def test_pages_have_the_bits_of_copies(make, memory: bool, monkeypatch) -> None:
    name = DATA if make is smoke else GRID
    results = []
    for least in (1 << 40, 0):
        monkeypatch.setattr(pages, "LEAST", least)
        if not memory:
            monkeypatch.delattr(os, "memfd_create", raising=False)
        given = make(16)
        scene = load(given)
        params = psdr.traverse(scene)
        original = described(scene).copy()
        images = [psdr.render(scene, spp=4).numpy()]
        params[name] = params[name].numpy() * np.float32(0.5) + np.float32(0.01)
        images.append(psdr.render(scene, spp=4).numpy())
        np.testing.assert_array_equal(described(scene), original)
        again = psdr.Scene(scene.description, "cpu")
        images.append(psdr.render(again, spp=4).numpy())
        np.testing.assert_array_equal(images[0], images[2])
        results += [[*images, scene.values.numpy().copy()]]
    for one, other in zip(*results, strict=True):
        assert one.tobytes() == other.tobytes()


@pytest.fixture
def shared(monkeypatch) -> psdr.Scene:
    """A scene whose description shares all its grids."""
    monkeypatch.setattr(pages, "LEAST", 0)
    return load(smoke(8))


def test_edits_of_either_side_leave_the_other(shared) -> None:
    original = described(shared).copy()
    params = psdr.traverse(shared)
    params[DATA].fill_(2.0)  # in place, which nothing but the checksum tells
    shared.settle()
    np.testing.assert_array_equal(described(shared), original)
    described(shared)[0] = 7.0
    np.testing.assert_array_equal(params[DATA].numpy(), 2.0)
    np.testing.assert_array_equal(described(shared)[1:], original[1:])


def test_arrays_that_were_given_stay() -> None:
    given = smoke(N)
    data = given["slab"]["interior"]["sigma_t"]["data"]
    params = psdr.traverse(load(given))
    params[DATA].fill_(2.0)
    np.testing.assert_array_equal(data, density(N))


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda scene: pickle.loads(pickle.dumps(scene))])
def test_copies_have_the_values_and_the_description(shared, copied) -> None:
    original = described(shared).copy()
    params = psdr.traverse(shared)
    params[DATA] = 0.5 * original
    other = copied(shared)
    assert other.values.numpy().tobytes() == shared.values.numpy().tobytes()
    np.testing.assert_array_equal(described(other), original)
    psdr.traverse(other)[DATA].fill_(3.0)
    np.testing.assert_array_equal(described(other), original)
    np.testing.assert_array_equal(described(shared), original)
    np.testing.assert_array_equal(params[DATA].numpy(), 0.5 * original)


def test_a_state_is_restored_in_parts(shared, monkeypatch) -> None:
    monkeypatch.setattr(edits, "PART", 100)
    params, before = psdr.traverse(shared), shared.state()
    params[DATA] = 0.5 * described(shared)
    params.update()
    assert shared.values.numpy().tobytes() != before.values.tobytes()
    shared.restore(before)
    assert shared.values.numpy().tobytes() == before.values.tobytes()


def test_checksums_of_parts_are_those_of_the_whole(monkeypatch) -> None:
    monkeypatch.setattr(edits, "PART", 100)
    values = density(8)[..., 0]
    assert edits.checksum(wp.array(values, dtype=wp.float32, device="cpu")) == zlib.crc32(values)
    vectors = wp.array(values[:, :, :3].reshape(-1, 3), dtype=wp.vec3, device="cpu")
    assert edits.checksum(vectors) == zlib.crc32(vectors.numpy())


def test_what_is_kept_of_many_values_follows_them(shared, monkeypatch) -> None:
    monkeypatch.setattr(unchanged, "MOST", 0)
    found = unchanged.kept(shared, "key", object)
    assert unchanged.kept(shared, "key", object) is found
    psdr.traverse(shared)[DATA].fill_(3.0)
    assert unchanged.kept(shared, "key", object) is not found


def test_majorants_and_files_take_no_copies(tmp_path) -> None:
    values = density(N)
    file(N, tmp_path)
    for work, most in ((lambda: super_grid(values, "clamp"), 0.5), (lambda: read_vol(tmp_path / "smoke.vol"), 1.1)):
        tracemalloc.start()
        work()
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < most * values.nbytes
