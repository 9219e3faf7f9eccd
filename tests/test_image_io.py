"""Reading and writing images."""

import numpy as np
import pytest
from PIL import Image

from warp_psdr.image_io import linear_to_srgb, read_image, srgb_to_linear, write_image


def picture(channels, seed=0):
    return np.random.default_rng(seed).random((5, 7, channels)).astype(np.float32)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_exr_round_trip_is_exact(tmp_path, channels):
    image = 1e4 * picture(channels) - 1.0
    write_image(tmp_path / "a.exr", image)
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), image)


def test_exr_half_keeps_eleven_bits_and_clips_to_its_range(tmp_path):
    image = picture(3)
    image[0, 0] = 1e9
    write_image(tmp_path / "a.exr", image, half=True)
    back = read_image(tmp_path / "a.exr")
    assert back[0, 0, 0] == 65504.0
    np.testing.assert_allclose(back[1:], image[1:], rtol=2.0**-11)


def test_exr_keeps_nan_and_infinity(tmp_path):
    image = picture(3)
    image[1, 2], image[2, 3] = np.nan, np.inf
    write_image(tmp_path / "a.exr", image)
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), image)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_png_round_trip_within_half_a_step(tmp_path, channels):
    image = picture(channels)
    write_image(tmp_path / "a.png", image)
    back = read_image(tmp_path / "a.png")
    color = min(channels, 3)
    # 8 bits of sRGB: half a step.
    step = 0.5001 / 255.0
    np.testing.assert_allclose(linear_to_srgb(back[..., :color]), linear_to_srgb(image[..., :color]), atol=step)
    np.testing.assert_allclose(back[..., color:], image[..., color:], atol=step)


def test_png_writes_nan_as_black_and_clips(tmp_path):
    image = np.array([[[np.nan, np.inf, -3.0]]], dtype=np.float32)
    write_image(tmp_path / "a.png", image)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png")[0, 0], [0.0, 1.0, 0.0])


def test_jpeg_is_decoded_and_raw_is_not(tmp_path):
    Image.new("RGB", (8, 8), (128, 128, 128)).save(tmp_path / "a.jpg")
    # JPEG of one colour: within one step.
    np.testing.assert_allclose(read_image(tmp_path / "a.jpg"), srgb_to_linear(128.0 / 255.0), atol=4e-3)
    np.testing.assert_allclose(read_image(tmp_path / "a.jpg", raw=True), 128.0 / 255.0, atol=4e-3)


def test_srgb_curve_at_known_values():
    np.testing.assert_allclose(srgb_to_linear([0.0, 0.04045, 0.5, 1.0]), [0.0, 0.0031308, 0.2140411, 1.0], rtol=2e-5)
    values = np.linspace(0.0, 1.0, 101)
    np.testing.assert_allclose(linear_to_srgb(srgb_to_linear(values)), values, atol=1e-6)


def test_sixteen_bit_grey_and_palette(tmp_path):
    Image.fromarray(np.full((2, 2), 65535, dtype=np.uint16)).save(tmp_path / "grey.png")
    assert read_image(tmp_path / "grey.png").shape == (2, 2, 1)
    assert read_image(tmp_path / "grey.png").max() == 1.0
    Image.new("P", (2, 2), 0).save(tmp_path / "palette.png")
    assert read_image(tmp_path / "palette.png").shape == (2, 2, 3)


def test_writing_replaces_whole_files_only(tmp_path):
    target = tmp_path / "deep" / "a.png"
    target.parent.mkdir()
    write_image(target, picture(3))
    before = target.read_bytes()
    with pytest.raises(ValueError, match="shape"):
        write_image(target, np.zeros((2, 2, 5)))
    assert target.read_bytes() == before
    assert [file.name for file in target.parent.iterdir()] == ["a.png"]


def test_a_failed_write_leaves_nothing_behind(tmp_path, monkeypatch):
    write_image(tmp_path / "a.png", picture(3))
    before = (tmp_path / "a.png").read_bytes()

    def fail(*arguments, **options):
        raise OSError("disk full")

    monkeypatch.setattr(Image.Image, "save", fail)
    with pytest.raises(OSError, match="disk full"):
        write_image(tmp_path / "a.png", picture(3, seed=1))
    assert (tmp_path / "a.png").read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("suffix", [".hdr", ".rgbe", ".pfm"])
@pytest.mark.parametrize("width", [1, 7, 300])
def test_float_formats_round_trip(tmp_path, suffix, width):
    image = (10.0 ** np.random.default_rng(2).uniform(-4, 4, (5, width, 3))).astype(np.float32)
    image[2, 0] = 0.0
    write_image(tmp_path / f"a{suffix}", image)
    back = read_image(tmp_path / f"a{suffix}")
    assert back.dtype == np.float32
    if suffix == ".pfm":
        np.testing.assert_array_equal(back, image)
    else:  # eight bits of a pixel's largest component
        assert (np.abs(back - image) <= image.max(axis=2, keepdims=True) * 2.0**-7).all()


def test_rgbe_reads_runs_and_writes_what_mitsuba_reads(tmp_path):
    row = bytes((2, 2, 0, 10)) + bytes((138, 128)) + bytes((2, 64, 32, 136, 0)) + 2 * bytes((138, 129))
    header = b"#?RADIANCE\n# a comment\nEXPOSURE=1.0\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 10\n"
    (tmp_path / "runs.hdr").write_bytes(header + row + row)
    image = read_image(tmp_path / "runs.hdr")
    np.testing.assert_array_equal(image[..., 0], np.full((2, 10), 1.0))
    np.testing.assert_array_equal(image[0, :3, 1], [0.5, 0.25, 0.0])
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    picture_of = 100.0 * picture(3) ** 4
    for suffix in (".hdr", ".pfm", ".bmp", ".tga", ".png", ".exr"):
        write_image(tmp_path / f"m{suffix}", picture_of)
        theirs = mi.Bitmap(str(tmp_path / f"m{suffix}")).convert(
            mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False
        )
        np.testing.assert_allclose(read_image(tmp_path / f"m{suffix}"), np.array(theirs), rtol=1e-5, atol=1e-6)


def test_rgbe_writes_what_is_not_a_colour_as_black(tmp_path):
    write_image(tmp_path / "a.hdr", np.float32([[[np.nan, -1.0, 1.0], [np.inf, 0.0, 0.0], [1e-42, 0.0, 0.0]]]))
    back = read_image(tmp_path / "a.hdr")[0]
    np.testing.assert_array_equal(back[0], [0.0, 0.0, 1.0])
    assert back[1, 0] > 1e38 and not back[2].any()


@pytest.mark.parametrize("suffix", [".bmp", ".tga"])
def test_other_low_range_formats_round_trip(tmp_path, suffix):
    image = picture(3)
    write_image(tmp_path / f"a{suffix}", image)
    step = 0.5001 / 255.0
    np.testing.assert_allclose(linear_to_srgb(read_image(tmp_path / f"a{suffix}")), linear_to_srgb(image), atol=step)


def test_no_folder_is_made(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no folder '.*missing'; make it first"):
        write_image(tmp_path / "missing" / "a.png", picture(3))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["a.exr", "a.png", "a.jpg", "a.bmp", "a.hdr", "a.pfm"])
def test_damaged_files_are_named(tmp_path, name):
    (tmp_path / name).write_bytes(b"not an image")
    with pytest.raises(ValueError, match=rf"{name}.*export it again"):
        read_image(tmp_path / name)
    write_image(tmp_path / name, picture(3))
    whole = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=rf"{name}.*export it again"):
        read_image(tmp_path / name)


def test_missing_and_unsupported_files(tmp_path):
    with pytest.raises(FileNotFoundError, match="check the name"):
        read_image(tmp_path / "a.exr")
    with pytest.raises(ValueError, match=r"use one of \.exr, \.hdr"):
        read_image(tmp_path / "a.gif")
    with pytest.raises(ValueError, match=r"use one of \.exr, \.hdr"):
        write_image(tmp_path / "a.webp", picture(3))
