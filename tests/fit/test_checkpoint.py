"""Checkpoints: what is saved is loaded, a crash at any point leaves the last one whole, foreign files are named."""

import io
import os
import pickle
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from warp_psdr.files import write_atomic
from warp_psdr.fit import checkpoint

ARRAYS = {
    "wall.reflectance.value": np.array([0.1, 0.2, 0.3], dtype=np.float32),
    "map/../data": np.arange(24, dtype=np.float32).reshape(2, 4, 3),
    "adam/steps": np.array(7, dtype=np.int64),
    "empty": np.zeros((0, 3), dtype=np.float32),
}
VALUES = {"step": 7, "losses": [0.5, 0.25], "config": {"scene": "größe.xml", "half_life": None}}


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "checkpoint.npz"
    checkpoint.save(path, ARRAYS, VALUES)
    return path


def test_round_trip_is_exact(saved: Path) -> None:
    arrays, values = checkpoint.load(saved)
    assert values == VALUES
    assert set(arrays) == set(ARRAYS)
    for name, array in ARRAYS.items():
        assert arrays[name].dtype == array.dtype
        np.testing.assert_array_equal(arrays[name], array)
    assert [entry.name for entry in saved.parent.iterdir()] == ["checkpoint.npz"]


def test_equal_contents_are_equal_bytes(saved: Path, tmp_path: Path) -> None:
    checkpoint.save(tmp_path / "again.npz", ARRAYS, VALUES)
    assert (tmp_path / "again.npz").read_bytes() == saved.read_bytes()


def test_numpy_reads_the_arrays(saved: Path) -> None:
    with np.load(saved, allow_pickle=False) as archive:
        np.testing.assert_array_equal(archive["wall.reflectance.value"], ARRAYS["wall.reflectance.value"])


def test_every_truncation_is_refused(saved: Path) -> None:
    whole = saved.read_bytes()
    for length in range(0, len(whole), 37):
        saved.write_bytes(whole[:length])
        with pytest.raises(ValueError, match="truncated or damaged"):
            checkpoint.load(saved)


def test_every_damaged_byte_of_the_data_is_refused_or_harmless(saved: Path) -> None:
    # A byte may lie in a field that nothing reads (a date); then all that was saved must come back.
    whole = saved.read_bytes()
    refused = 0
    for position in range(0, len(whole), 11):
        damaged = bytearray(whole)
        damaged[position] ^= 0x55
        saved.write_bytes(damaged)
        try:
            arrays, values = checkpoint.load(saved)
        except ValueError:
            refused += 1
            continue
        assert values == VALUES
        assert sorted(array.tobytes() for array in arrays.values()) == sorted(a.tobytes() for a in ARRAYS.values())
    assert refused > len(whole) / 11 / 2


def npz(entries: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", compression) as archive:
        for name, data in entries.items():
            archive.writestr(name, data)
    return stream.getvalue()


def npy(array: np.ndarray, allow_pickle: bool = False) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array, allow_pickle=allow_pickle)
    return stream.getvalue()


def header(text: str) -> bytes:
    return npy(np.frombuffer(text.encode(), dtype=np.uint8))


class Bomb:
    def __reduce__(self):
        return (os.mkdir, ("exploded",))


#: An array of 10^15 numbers that claims its size and brings no data.
HUGE = npy(np.zeros(0, np.float32)).replace(b"(0,), }", b"(1000000000000000,), }").replace(b" " * 15 + b"\n", b"\n")
HEADER = '{"format": "warp_psdr checkpoint", "version": 1, "values": {}}'


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "no checkpoint of warp_psdr"),
        (b"not a zip file at all", "no checkpoint of warp_psdr"),
        (pickle.dumps(Bomb()), "no checkpoint of warp_psdr"),
        (npz({"a.npy": npy(np.zeros(3))}), "lacks '__header__'"),
        (npz({"__header__.npy": header("{}")}), "lacks 'format'"),
        (npz({"__header__.npy": header("[1, 2]")}), "no checkpoint"),
        (npz({"__header__.npy": header("{broken")}), "no checkpoint"),
        (npz({"__header__.npy": header(HEADER.replace("1", "2"))}), "got version 2"),
        (npz({"__header__.npy": header(HEADER.replace("warp_psdr", "other"))}), "its format is 'other checkpoint'"),
        (npz({"__header__.npy": header(HEADER.replace("{}", "3"))}), "no checkpoint"),
        (npz({"__header__.npy": header(HEADER)}, zipfile.ZIP_DEFLATED), "it is compressed"),
        (npz({"__header__.npy": header(HEADER), "a.npy": b"short"}), "no checkpoint"),
        (npz({"__header__.npy": header(HEADER), "a.npy": HUGE}), "longer or shorter"),
        (npz({"__header__.npy": header(HEADER), "a.npy": npy(np.zeros(3)) + b"more"}), "longer or shorter"),
        (npz({"__header__.npy": header(HEADER), "a.npy": npy(np.array([Bomb()]), True)}), "no checkpoint"),
    ],
)
def test_foreign_files_are_refused(content: bytes, message: str, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("foreign.npz").write_bytes(content)
    with pytest.raises(ValueError, match=message):
        checkpoint.load("foreign.npz")
    assert not Path("exploded").exists()


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"checkpoint .*none\.npz does not exist"):
        checkpoint.load(tmp_path / "none.npz")


@pytest.mark.parametrize(
    ("arrays", "values", "error"),
    [
        ({"a": np.array([object()])}, {}, TypeError),
        ({"a": np.array(["text"])}, {}, TypeError),
        ({"__header__": np.zeros(1)}, {}, ValueError),
        ({}, {"a": object()}, TypeError),
    ],
)
def test_what_cannot_be_saved_leaves_the_last_checkpoint(saved: Path, arrays, values, error) -> None:
    before = saved.read_bytes()
    with pytest.raises(error):
        checkpoint.save(saved, arrays, values)
    assert saved.read_bytes() == before


def test_failure_while_writing_leaves_the_last_checkpoint(saved: Path) -> None:
    before = saved.read_bytes()

    def write(file) -> None:
        file.write(b"half of it")
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        write_atomic(saved, write)
    assert saved.read_bytes() == before
    assert [entry.name for entry in saved.parent.iterdir()] == ["checkpoint.npz"]


def test_killed_while_writing_leaves_the_last_checkpoint(saved: Path) -> None:
    code = (
        "import os, signal, sys\n"
        "from warp_psdr.files import write_atomic\n"
        "def write(file):\n"
        "    file.write(b'x' * 100000); file.flush(); os.kill(os.getpid(), signal.SIGKILL)\n"
        "write_atomic(sys.argv[1], write)\n"
    )
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run([sys.executable, "-c", code, str(saved)], cwd=root, capture_output=True, check=False)
    assert done.returncode == -9, done.stderr.decode()
    assert checkpoint.load(saved)[1] == VALUES
    assert len(list(saved.parent.iterdir())) == 2  # and the unfinished one, which the next write replaces
    checkpoint.save(saved, ARRAYS, VALUES)
    assert [entry.name for entry in saved.parent.iterdir()] == ["checkpoint.npz"]
