"""The files that a glTF file names are found as all others of a scene are, whatever trimesh's reader would do."""

import base64
import json
from pathlib import Path

import numpy as np
import pytest

from tests.stability import corpus
from warp_psdr.scene import describe_dict
from warp_psdr.scene.files.gltf_files import Buffers
from warp_psdr.scene.files.mesh_files import read_mesh

BUFFER = corpus.CORNERS.tobytes() + corpus.FACES.astype(np.uint16).tobytes()


def written(folder: Path, *uris: str, name: str = "model.gltf") -> Path:
    """Write a square whose buffers, of one content, have these URIs."""
    tree = json.loads(corpus.gltf(binary=False))
    tree["buffers"] = [{"byteLength": len(BUFFER), "uri": uri} for uri in uris]
    folder.mkdir(exist_ok=True)
    (folder / name).write_text(json.dumps(tree))
    return folder / name


def vertices(folder: Path, name: str = "model.gltf") -> np.ndarray:
    scene = {"type": "scene", "a": {"type": "gltf", "filename": name}, "cam": {"type": "perspective"}}
    return describe_dict(scene, base=folder).shapes[0].vertices


def test_buffers_are_found_beside_the_file_of_the_mesh(tmp_path):
    written(tmp_path / "models", "my%20buffer.bin")
    (tmp_path / "models" / "my buffer.bin").write_bytes(BUFFER)
    assert vertices(tmp_path, "models/model.gltf").shape == (8, 3)


@pytest.mark.parametrize("how", ["..", "%2e%2e", "absolute", "link"])
def test_buffers_outside_of_the_scene_s_folder_are_refused(how, tmp_path):
    secret = tmp_path / "secret"
    secret.mkdir()
    (secret / "buffer.bin").write_bytes(BUFFER)
    uris = {"absolute": str(secret / "buffer.bin"), "link": "buffer.bin"}
    file = written(tmp_path / "scene", uris.get(how, f"{how}/secret/buffer.bin"))
    if how == "link":
        (file.parent / "buffer.bin").symlink_to(secret / "buffer.bin")
    with pytest.raises(ValueError, match=r"file '.*model.gltf': '.*buffer.bin' leaves the scene's folder"):
        vertices(file.parent)


def test_what_trimesh_is_given_comes_from_the_guarded_look_up(tmp_path):
    (tmp_path / "one.bin").write_bytes(BUFFER)
    asked = []

    def find(name: str) -> Path:
        asked.append(name)
        return tmp_path / "one.bin"

    buffers = Buffers(find)
    assert buffers["../a%20b.bin"] == BUFFER and buffers["/etc/b.bin"] == BUFFER
    assert asked == ["../a b.bin", "/etc/b.bin"]
    assert buffers["../a%20b.bin"] is buffers["/etc/b.bin"]  # one file, read once


def test_buffers_in_the_file_itself(tmp_path):
    written(tmp_path, "data:application/octet-stream;base64," + base64.b64encode(BUFFER).decode())
    assert vertices(tmp_path).shape == (8, 3)
    written(tmp_path, "data:text/plain,abc")
    with pytest.raises(ValueError, match="a buffer's data URI is not in base64"):
        vertices(tmp_path)


def test_readers_without_a_scene_stay_in_the_folder_of_the_mesh(tmp_path):
    (tmp_path / "buffer.bin").write_bytes(BUFFER)
    file = written(tmp_path / "models", "../buffer.bin")
    with pytest.raises(ValueError, match=r"'\.\./buffer.bin' leaves the scene's folder"):
        read_mesh("gltf", file, "here", print)
    assert len(read_mesh("gltf", file, "here", print, find=lambda name: tmp_path / "buffer.bin").vertices) == 8


def test_a_missing_buffer_is_named(tmp_path):
    written(tmp_path, "gone.bin")
    with pytest.raises(FileNotFoundError, match=r"file '.*model.gltf': no such file: 'gone.bin'"):
        vertices(tmp_path)
