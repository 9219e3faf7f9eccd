"""Files made to exhaust memory or time, and names that lead out of a scene's folder, are refused with a message."""

import io
import json
import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.stability import corpus
from warp_psdr import image_io
from warp_psdr.arrays import read_array
from warp_psdr.cli import main
from warp_psdr.fit import checkpoint
from warp_psdr.fit.config import FitConfig
from warp_psdr.scene import describe_dict, describe_file, describe_string

HEAD = '<scene version="3.0.0"><sensor type="perspective"/>'
HUGE = 10**12


def scene(inner: str, **options):
    return describe_string(f"{HEAD}{inner}</scene>", **options)


def mesh(folder: Path, name: str, content: bytes):
    (folder / name).write_bytes(content)
    shape = {"type": Path(name).suffix[1:], "filename": name}
    return describe_dict({"type": "scene", "a": shape, "cam": {"type": "perspective"}}, base=folder)


# -- scene files ---------------------------------------------------------------------------------------------------


def test_parameters_made_of_parameters_do_not_grow_without_bound() -> None:
    doubled = "".join(f'<default name="p{i}" value="{f"$p{i - 1}" * 10}"/>' for i in range(1, 12))
    with pytest.raises(ValueError, match="attribute 'value' has more than 65536 letters"):
        scene(f'<default name="p0" value="0123456789"/>{doubled}')


def test_parameters_are_counted() -> None:
    with pytest.raises(ValueError, match="more than 1000 parameters"):
        scene("".join(f'<default name="p{i}" value="1"/>' for i in range(1001)))


def test_files_that_include_each_other_many_times_are_counted(tmp_path: Path) -> None:
    """Ten files, each with the next one eight times: 8^10 inclusions, none of them circular."""
    for i in range(10):
        inner = f'<include filename="{i + 1}.xml"/>' * 8 if i < 9 else ""
        (tmp_path / f"{i}.xml").write_text(f'<scene version="3.0.0">{inner}</scene>')
    with pytest.raises(ValueError, match="more than 1000 files are included"):
        describe_file(tmp_path / "0.xml")


def test_folders_to_look_in_are_counted(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="more than 100 <path> folders"):
        scene('<path value="."/>' * 101, base=tmp_path)


def test_elements_are_counted_before_they_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("warp_psdr.scene.files.xml._ELEMENTS_MAX", 100)
    with pytest.raises(ValueError, match="too many elements"):
        scene("<a/>" * 200)


def test_many_children_take_linear_time() -> None:
    """Each once looked for the first free name among all before it, in quadratic time."""
    with pytest.raises(ValueError, match="20000 bsdf plugins"):
        scene('<shape type="cube">' + '<bsdf type="diffuse"/>' * 20000 + "</shape>")


def test_chains_of_references_end() -> None:
    """Each of N references would follow up to N others."""
    aliases = "".join(f'<alias id="a{i}" as="a{i + 1}"/>' for i in range(100))
    with pytest.raises(ValueError, match="more than 64 references in a chain"):
        scene(f'<bsdf type="diffuse" id="a0"/>{aliases}<shape type="cube"><ref id="a100"/></shape>')


def test_remarks_are_counted() -> None:
    """Each is compared with all before it."""
    shape = '<shape type="cube"><float name="silhouette_sampling_weight" value="1"/></shape>\n'
    notes = scene(shape * 1100).notes
    assert len(notes) <= 1002 and "further remarks are left out" in notes


def test_names_of_a_megabyte_are_not_compared_nor_repeated() -> None:
    """The search for a similar name takes quadratic time, and a message is for reading."""
    long = "radius" * 200_000
    for inner in (
        f'<shape type="{long}"/>',
        f'<shape type="sphere"><float name="{long}" value="1"/></shape>',
        f'<shape type="sphere"><float name="radius" value="{long}"/></shape>',
        f'<shape type="cube"><ref id="{long}"/></shape>',
    ):
        with pytest.raises(ValueError) as caught:
            scene(inner)
        assert len(str(caught.value)) < 5000


FILM = '<sensor type="perspective" id="b"><film type="hdrfilm">{}</film></sensor>'
INTEGER = '<integer name="{}" value="{}"/>'


@pytest.mark.parametrize(
    ("inner", "message"),
    [
        (FILM.format(INTEGER.format("width", 65536) + INTEGER.format("height", 65536)), "at most 268435456 altogether"),
        (FILM.format(INTEGER.format("width", "9" * 400)), "got inf"),
        (FILM.format('<rfilter type="box"><float name="radius" value="1e9"/></rfilter>'), "at most 64 pixels"),
        (FILM.format('<rfilter type="gaussian"><float name="stddev" value="1e9"/></rfilter>'), "at most 16 pixels"),
        ('<shape type="sphere"><integer name="resolution" value="1000000000"/></shape>', "at most 2048"),
        ('<shape type="sphere"><float name="radius" value="1e300"/></shape>', "got 1e\\+300"),
        ('<shape type="sphere"><point name="center" value="1e39 0 0"/></shape>', "three finite numbers"),
        (
            '<shape type="cube"><transform name="to_world"><matrix value="1e200 0 0 0 1 0 0 0 1"/></transform></shape>',
            "32-bit",
        ),
        ('<emitter type="point"><rgb name="intensity" value="1e39"/></emitter>', "not finite, as 32-bit floats"),
        ('<integrator type="path"><integer name="max_depth" value="3000000000"/></integrator>', "at most 2147483647"),
        (f'<shape type="obj"><string name="filename" value="{"a" * 300}.obj"/></shape>', "no such file"),
    ],
)
def test_gigantic_numbers_and_names_are_refused(inner: str, message: str) -> None:
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        scene(inner)


# -- meshes --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("element", ["vertex 4", "face 2"])
@pytest.mark.parametrize("kind", ["ascii", "binary"])
def test_meshes_that_declare_more_than_they_hold(kind: str, element: str, tmp_path: Path) -> None:
    content = corpus.ascii_ply() if kind == "ascii" else corpus.binary_ply()
    name = element.split()[0]
    with pytest.raises(ValueError, match=r"damaged|ends early"):
        mesh(tmp_path, "a.ply", content.replace(f"element {element}".encode(), f"element {name} {HUGE}".encode()))


def test_polygon_of_billions_of_corners(tmp_path: Path) -> None:
    text = corpus.binary_ply().replace(b"list uchar int", b"list uint int")
    at = text.index(b"end_header\n") + 11 + 4 * 27
    with pytest.raises(ValueError, match="damaged"):
        mesh(tmp_path, "a.ply", text[:at] + struct.pack("<I", 2**32 - 1) + text[at + 1 :])


def test_stl_of_billions_of_triangles(tmp_path: Path) -> None:
    data = corpus.binary_stl()
    with pytest.raises(ValueError, match=r"damaged|empty"):
        mesh(tmp_path, "a.stl", data[:80] + struct.pack("<I", 2**32 - 1) + data[84:])


def changed(**changes) -> bytes:
    """Return the square as glTF with other entries; a function changes one."""
    tree = json.loads(corpus.gltf(binary=False))
    for name, change in changes.items():
        tree[name] = change(tree[name]) if callable(change) else change
    return json.dumps(tree).encode()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (changed(accessors=lambda a: [{**a[0], "count": HUGE}, a[1]]), "more than 536870912 numbers"),
        (changed(accessors=lambda a: [{"count": 9, "type": "VEC3", "componentType": 5126}, a[1]]), "no buffer view"),
        (changed(accessors=lambda a: [{**a[0], "count": -4}, a[1]]), "has -4 items"),
        (changed(nodes=[{"mesh": 0, "children": [1]}, {"mesh": 0, "children": [0]}]), "damaged|empty"),
        (changed(buffers=[{"byteLength": 60, "uri": "../../etc/passwd"}]), "leaves the scene's folder"),
        (changed(buffers=[{"byteLength": 60, "uri": "/etc/passwd"}]), "leaves the scene's folder"),
        (b"[" * 100_000, "damaged"),
    ],
)
def test_gltf_that_asks_for_too_much(content: bytes, message: str, tmp_path: Path) -> None:
    corpus.write_beside(tmp_path, corpus.files(tmp_path))
    with pytest.raises(ValueError, match=message):
        mesh(tmp_path, "a.gltf", content)


def test_gltf_that_repeats_a_mesh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("warp_psdr.scene.files.gltf_files._NUMBERS_MAX", 1000)
    corpus.write_beside(tmp_path, corpus.files(tmp_path))
    assert mesh(tmp_path, "a.gltf", changed(nodes=[{"mesh": 0}] * 10)).shapes
    with pytest.raises(ValueError, match="more than 1000 numbers, repetitions included"):
        mesh(tmp_path, "a.gltf", changed(nodes=[{"mesh": 0}] * 100))


def test_meshes_and_images_of_a_scene_are_counted_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("warp_psdr.scene.context._NUMBERS_MAX", 100)
    corpus.write_beside(tmp_path, corpus.files(tmp_path))
    shape = '<shape type="obj"><string name="filename" value="a.obj"/></shape>'
    assert scene(shape, base=tmp_path).shapes
    with pytest.raises(ValueError, match="the scene holds more than 100 values by here"):
        scene(shape * 8, base=tmp_path)


# -- images --------------------------------------------------------------------------------------------------------


def png(width: int, height: int) -> bytes:
    """Return a PNG with a right checksum that declares a size and holds nothing."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(b"\0" * 100)) + chunk(b"IEND", b"")


def jpeg(width: int, height: int) -> bytes:
    data = bytearray(corpus.picture("JPEG", "RGB"))
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", height, width)
    return bytes(data)


def exr(window: tuple[int, int, int, int], flags: int = 0, folder: Path | None = None) -> bytes:
    import OpenEXR

    assert folder is not None
    data = bytearray(corpus.exr(folder, OpenEXR.ZIP_COMPRESSION))
    data[4:8] = struct.pack("<I", 2 | flags)
    for name in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
        at = data.index(name) + len(name) + 4
        data[at : at + 16] = struct.pack("<4i", *window)
    return bytes(data)


@pytest.mark.parametrize(
    ("name", "make", "message"),
    [
        ("a.png", lambda folder: png(60000, 60000), "values|bomb"),
        ("a.png", lambda folder: png(13000, 13000), "export it again"),
        ("a.jpg", lambda folder: jpeg(65535, 65535), "values|bomb"),
        ("a.exr", lambda folder: exr((0, 0, 2**31 - 1, 10), folder=folder), "at most 536870912 are read"),
        ("a.exr", lambda folder: exr((-(2**31), 0, 2**31 - 1, 0), folder=folder), "at most 536870912 are read"),
        ("a.exr", lambda folder: exr((0, 0, 10, 10**8), folder=folder), "declares 100000001 rows"),
        ("a.exr", lambda folder: exr((5, 5, 0, 0), folder=folder), "declares -4 x -4 pixels"),
        ("a.exr", lambda folder: exr((0, 0, 8, 5), 0x800, folder), "deep images are not supported"),
        ("a.hdr", lambda folder: b"#?RADIANCE\n\n-Y 9999999 +X 9999999\n", "no readable HDR or PFM"),
        ("a.png", lambda folder: tiff(), "no readable PNG, JPEG"),
    ],
)
def test_images_that_declare_more_than_they_hold(name: str, make, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(make(tmp_path))
    with pytest.raises(ValueError, match=message) as caught:
        image_io.read_image(tmp_path / name)
    assert name in str(caught.value)


def tiff() -> bytes:
    """Return an image whose reader the suffix does not ask for."""
    stream = io.BytesIO()
    Image.new("RGB", (3, 3)).save(stream, "TIFF")
    return stream.getvalue()


# -- arrays and configurations -------------------------------------------------------------------------------------


def test_archives_and_pickles_are_no_arrays(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", a=np.zeros(3))
    os.replace(tmp_path / "a.npz", tmp_path / "a.npy")
    with pytest.raises(ValueError, match=r"a\.npy is no array of numbers"):
        read_array(tmp_path / "a.npy")
    np.save(tmp_path / "b.npy", np.array([{"a": 1}]), allow_pickle=True)
    with pytest.raises(ValueError, match=r"b\.npy is no array of numbers .*object"):
        read_array(tmp_path / "b.npy")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a.a" + ".a" * 600_000 + " = 1", "at most 1048576"),
        ("scene = " + "[" * 100_000, "malformed"),
        ("iterations = " + "9" * 5000, "malformed"),
    ],
)
def test_configurations_that_exhaust_their_reader(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "fit.toml").write_text(text)
    with pytest.raises(ValueError, match=rf"fit\.toml.*{message}"):
        FitConfig.from_file(tmp_path / "fit.toml")


@pytest.mark.parametrize("field", ["iterations", "spp", "seed", "checkpoint_every"])
def test_counts_beyond_the_device_are_refused(field: str) -> None:
    values = {"scene": "a.xml", "targets": ["a.exr"], "output": "o", "parameters": {"a": {"lr": 1}}}
    with pytest.raises(ValueError, match=rf"{field}: got \d+, expected at most"):
        FitConfig.from_mapping(values | {field: 2**32})
    with pytest.raises(ValueError, match="expected a finite number"):
        FitConfig.from_mapping(values | {"lr_half_life": 10**400})


@pytest.mark.parametrize(
    ("read", "suffix"),
    [
        (read_array, ".npy"),
        (image_io.read_image, ".exr"),
        (checkpoint.load, ".npz"),
        (FitConfig.from_file, ".toml"),
        (describe_file, ".xml"),
    ],
)
def test_names_that_no_file_can_have_are_those_of_none(read, suffix: str) -> None:
    for name in ("a" * 300, "a/" * 3000 + "b", "\0"):
        with pytest.raises(FileNotFoundError):
            read(name + suffix)


# -- names of files ------------------------------------------------------------------------------------------------

SHAPE = '<shape type="obj"><string name="filename" value="{}"/></shape>'


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A folder of projects: ours, with a scene, and somebody else's, with a mesh."""
    for name in ("ours/meshes", "theirs"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "theirs" / "a.obj").write_text(corpus.OBJ)
    (tmp_path / "theirs" / "part.xml").write_text('<scene version="3.0.0"/>')
    (tmp_path / "ours" / "meshes" / "b.obj").write_text(corpus.OBJ)
    (tmp_path / "ours" / "file_link.obj").symlink_to(tmp_path / "theirs" / "a.obj")
    (tmp_path / "ours" / "folder_link").symlink_to(tmp_path / "theirs")
    (tmp_path / "ours" / "link_inside.obj").symlink_to("meshes/b.obj")
    (tmp_path / "ours" / "circle.obj").symlink_to("circle.obj")
    return tmp_path


def load(tree: Path, inner: str, **options):
    file = tree / "ours" / "scene.xml"
    file.write_text(f"{HEAD}{inner}</scene>")
    return describe_file(file, **options)


OUTSIDE = {
    "parent": SHAPE.format("../theirs/a.obj"),
    "parent in the middle": SHAPE.format("meshes/../../theirs/a.obj"),
    "absolute": SHAPE.format("TREE/theirs/a.obj"),
    "absolute with parents": SHAPE.format("TREE/ours/../theirs/a.obj"),
    "link to a file": SHAPE.format("file_link.obj"),
    "link to a folder": SHAPE.format("folder_link/a.obj"),
    "search path": '<path value="../theirs"/>' + SHAPE.format("a.obj"),
    "absolute search path": '<path value="TREE/theirs"/>' + SHAPE.format("a.obj"),
    "linked search path": '<path value="folder_link"/>' + SHAPE.format("a.obj"),
    "include": '<include filename="../theirs/part.xml"/>' + SHAPE.format("meshes/b.obj"),
    "parameter": '<default name="x" value=".."/>' + SHAPE.format("$x/theirs/a.obj"),
}


@pytest.mark.parametrize("inner", OUTSIDE.values(), ids=OUTSIDE.keys())
def test_files_outside_of_the_folder_are_refused_unless_allowed(inner: str, tree: Path) -> None:
    inner = inner.replace("TREE", str(tree))
    with pytest.raises(ValueError, match=r"scene\.xml:1 .* leaves the scene's folder .*allow_outside"):
        load(tree, inner)
    with pytest.raises(ValueError, match="leaves the scene's folder"):
        load(tree, inner, allow_outside=tree / "ours" / "meshes")
    for allowed in (True, tree, str(tree / "theirs"), [tree / "theirs"], ["/"]):
        assert load(tree, inner, allow_outside=allowed).shapes


@pytest.mark.parametrize(
    "name", ["meshes/b.obj", "meshes/../meshes/b.obj", "TREE/ours/meshes/b.obj", "link_inside.obj"]
)
def test_files_inside_of_the_folder_are_read(name: str, tree: Path) -> None:
    assert load(tree, SHAPE.format(name.replace("TREE", str(tree)))).shapes


def test_links_in_a_circle_and_to_nowhere(tree: Path) -> None:
    (tree / "ours" / "nowhere.obj").symlink_to("nothing.obj")
    for name in ("circle.obj", "nowhere.obj"):
        with pytest.raises((ValueError, FileNotFoundError), match=name):
            load(tree, SHAPE.format(name))


def test_a_scene_reached_by_a_link_reads_what_lies_beside_it(tree: Path) -> None:
    load(tree, SHAPE.format("meshes/b.obj"))
    (tree / "link.xml").symlink_to(tree / "ours" / "scene.xml")
    assert describe_file(tree / "link.xml").shapes


def test_the_command_line_allows_folders(tree: Path, capsys: pytest.CaptureFixture) -> None:
    file = tree / "ours" / "scene.xml"
    file.write_text(f"{HEAD}{SHAPE.format('../theirs/a.obj')}</scene>")
    assert main(["plan", str(file)]) == 2
    assert "--allow-outside" in capsys.readouterr().err
    assert main(["plan", str(file), "--allow-outside", str(tree / "theirs")]) == 0


def test_configurations_allow_folders_from_their_own(tree: Path) -> None:
    values = {"scene": "a.xml", "targets": ["a.exr"], "output": "o", "parameters": {"a": {"lr": 1}}}
    config = FitConfig.from_mapping(values | {"allow_outside": ["../theirs"]}, folder=tree / "ours")
    assert load(tree, SHAPE.format("../theirs/a.obj"), allow_outside=config.allow_outside).shapes


def test_dictionaries_are_the_programs_own(tree: Path) -> None:
    plugins = {
        "type": "scene",
        "cam": {"type": "perspective"},
        "a": {"type": "obj", "filename": f"{tree}/theirs/a.obj"},
    }
    assert describe_dict(plugins).shapes
    with pytest.raises(ValueError, match="leaves the scene's folder"):
        describe_dict(plugins, base=tree / "ours")


def test_allow_outside_of_a_wrong_type(tree: Path) -> None:
    with pytest.raises(TypeError, match="allow_outside: got 3"):
        load(tree, "", allow_outside=3)
