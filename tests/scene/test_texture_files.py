"""Bitmaps of every image format hold the texels that Mitsuba reads."""

import numpy as np
import pytest

from warp_psdr.image_io import write_image
from warp_psdr.scene import describe_dict

IMAGE = np.random.default_rng(0).random((3, 9, 3)).astype(np.float32)


def load(file):
    texture = {"type": "bitmap", "filename": str(file)}
    return describe_dict({"type": "scene", "x": {"type": "cube", "bsdf": {"type": "diffuse", "reflectance": texture}}})


@pytest.mark.parametrize("suffix", [".bmp", ".tga", ".png", ".hdr", ".rgbe", ".pfm", ".exr"])
def test_texels_equal_mitsubas(tmp_path, suffix):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    file = tmp_path / f"a{suffix}"
    write_image(file, IMAGE)
    ours = load(file).shapes[0].bsdf.textures["reflectance"].value
    theirs = mi.load_dict({"type": "bitmap", "filename": str(file), "filter_type": "nearest", "format": "variant"})
    at, found = mi.SurfaceInteraction3f(), np.zeros_like(IMAGE)
    for row, column in np.ndindex(3, 9):
        at.uv = ((column + 0.5) / 9, (row + 0.5) / 3)
        found[row, column] = np.array(theirs.eval(at))
    np.testing.assert_allclose(ours, found, atol=1e-6)


@pytest.mark.parametrize("suffix", [".bmp", ".tga", ".hdr", ".pfm"])
def test_damaged_images_are_named_with_their_place(tmp_path, suffix):
    file = tmp_path / f"a{suffix}"
    write_image(file, IMAGE)
    file.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(ValueError, match=rf"\['reflectance'\].*a\{suffix}' is no readable .*export it again"):
        load(file)
    file.write_bytes(b"\x89 no image")
    with pytest.raises(ValueError, match="is no readable"):
        load(file)
