"""Photographs: what codes say of radiance, which pixels count, derivatives by the camera's numbers, and bad files."""

import numpy as np
import pytest

import warp_psdr as psdr

SIZE = (6, 8)


def radiance(seed=0):
    return np.random.default_rng(seed).uniform(0.1, 0.8, (*SIZE, 3))


@pytest.mark.parametrize(
    ("response", "encode"),
    [
        ("srgb", psdr.image_io.linear_to_srgb),
        (2.2, lambda v: v ** (1.0 / 2.2)),
        (np.linspace(0.0, 1.0, 257) ** 1.8, lambda v: v ** (1.0 / 1.8)),
    ],
    ids=["sRGB", "power", "curve"],
)
def test_codes_become_linear(response, encode):
    codes = np.round(65535 * encode(radiance())).astype(np.uint16)
    photograph = psdr.Photograph(codes, response=response)
    np.testing.assert_allclose(photograph.linear, radiance(), atol=2e-4)
    # An error of a residual is one of a code.
    h = 1e-3
    np.testing.assert_allclose(
        photograph.residual(radiance() + h), encode(radiance() + h) - encode(radiance()), atol=1e-4
    )


def test_pixels_that_are_clipped_or_masked_do_not_count():
    codes = np.full((*SIZE, 3), 100, np.uint8)
    codes[0, 0, 1] = 255
    mask = np.ones(SIZE)
    mask[1, 1] = 0.0
    weights = psdr.Photograph(codes, mask=mask).weights
    assert not weights[0, 0].any() and not weights[1, 1].any() and (weights.sum(axis=2) > 0.0).sum() == 46
    halves = psdr.Photograph(codes, mask=mask, reduce=2)
    assert halves.shape == (3, 4) and not halves.weights[0, 0].any() and halves.weights[0, 1].all()


def test_a_mask_may_be_asked_again():
    kept = [np.ones(SIZE), np.pad(np.ones((1, 1)), ((2, 3), (3, 4)))]
    photograph = psdr.Photograph(radiance(), response=None, mask=lambda: kept[-1])
    kept.pop()
    assert (photograph.weights > 0.0).sum() == 3
    photograph.look()
    assert (photograph.weights > 0.0).all()


@pytest.mark.parametrize(
    ("unknowns", "options"),
    [
        (["white_balance", "vignetting"], {"response": None, "vignetting": [0.2, -0.1]}),
        (["exposure", "gamma"], {"response": 2.0}),
    ],
    ids=["white balance and vignetting", "exposure and gamma"],
)
def test_derivatives_by_the_camera_are_differences(unknowns, options):
    photograph = psdr.Photograph(radiance(1), unknowns=unknowns, exposure=0.9, **options)
    found = photograph.derivatives(radiance())
    assert len(found) == len(photograph.labels) == photograph.unknown_values.size
    for i, row in enumerate(found):
        step = 1e-4 * np.eye(len(found))[i]
        photograph.move(step)
        high = photograph.residual(radiance())
        photograph.move(-2.0 * step)
        low = photograph.residual(radiance())
        photograph.move(step)
        assert np.abs(row).max() > 0.01
        np.testing.assert_allclose(row, (high - low) / 2e-4, rtol=1e-3, atol=1e-6)


def test_what_is_wrong_is_told(tmp_path):
    from PIL import Image

    codes = np.full((*SIZE, 3), 100, np.uint8)
    turned = tmp_path / "turned.jpg"
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(codes).save(turned, exif=exif)
    with pytest.raises(ValueError, match=r"stored turned \(EXIF orientation 6"):
        psdr.Photograph(turned)
    with pytest.raises(ValueError, match="integer values are hardly linear"):
        psdr.Photograph(codes, response=None)
    with pytest.raises(ValueError, match="no pixel counts"):
        psdr.Photograph(codes, mask=np.zeros(SIZE))
    with pytest.raises(ValueError, match=r"the mask has shape \(3, 3\)"):
        psdr.Photograph(codes, mask=np.ones((3, 3)))
    with pytest.raises(ValueError, match="reduce=5 does not divide"):
        psdr.Photograph(codes, reduce=5)
    with pytest.raises(ValueError, match="expected some of exposure"):
        psdr.Photograph(codes, unknowns=["focus"])
    with pytest.raises(ValueError, match="'gamma' is the exponent of a response that is a number"):
        psdr.Photograph(codes, unknowns=["gamma"])
    with pytest.raises(FileNotFoundError):
        psdr.Photograph(tmp_path / "none.png")
