"""Read and write images as linear float32 arrays: EXR, HDR and PFM hold such, PNG, JPEG, BMP and TGA hold sRGB."""

from __future__ import annotations

import errno
import io
import os
import warnings
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from warp_psdr.files import atomic_path
from warp_psdr.float_images import read_float_image, write_pfm, write_rgbe

_EXR, _RGBE, _PFM = (".exr",), (".hdr", ".rgbe"), (".pfm",)
#: Suffix -> Pillow's name of the format.
_LOW_RANGE = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG", ".bmp": "BMP", ".tga": "TGA"}
#: Suffixes of the formats that are read and written.
SUFFIXES = (*_EXR, *_RGBE, *_PFM, *_LOW_RANGE)
#: Formats with an alpha channel.
_WITH_ALPHA = (*_EXR, ".png", ".tga")
#: Largest finite value of a half float; larger values are written as this one instead of infinity.
_HALF_MAX = 65504.0
#: Values of an image (pixels times channels): 2 GB as float32, 16 times those of an 8k environment map in colour.
_VALUES_MAX = 1 << 29


def srgb_to_linear(values: Any) -> np.ndarray:
    """Decode sRGB values in [0, 1] to linear ones (IEC 61966-2-1), float32, any shape."""
    v = np.asarray(values, dtype=np.float32)
    return np.where(v <= 0.04045, v / 12.92, ((np.maximum(v, 0.0) + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_to_srgb(values: Any) -> np.ndarray:
    """Encode linear values as sRGB, clipped to [0, 1], NaN as 0, float32, any shape."""
    v = np.clip(np.nan_to_num(np.asarray(values, dtype=np.float32), nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
    return np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1.0 / 2.4) - 0.055).astype(np.float32)


def read_image(path: str | os.PathLike[str], *, raw: bool = False) -> np.ndarray:
    """Read an image, top row first.

    Args:
        path: A file of one of the formats in ``SUFFIXES``.
        raw: Leave 8- and 16-bit values as they are stored (divided by 255 or 65535) instead of decoding sRGB.

    Returns:
        Linear values, float32, shape (H, W, C): C is 1 (grey), 2 (grey, alpha), 3 or 4 (RGB, RGBA). An alpha channel
        is never decoded. NaN and infinity in EXR and PFM files are returned as they are.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is of another kind, cannot be decoded, or has more than 2^29 values.
    """
    file = Path(path)
    _check_suffix(file)
    if not os.path.isfile(file):
        raise FileNotFoundError(f"no such image: '{file}'; check the name")
    if file.suffix.lower() in _EXR:
        return _read_exr(file)
    return _read_low_range(file, file, raw) if file.suffix.lower() in _LOW_RANGE else _read_float(file)


def write_image(path: str | os.PathLike[str], image: Any, *, half: bool = False) -> None:
    """Write an image; the file appears complete or not at all.

    EXR keeps every value (``half``: 16-bit floats, clipped to their range), and so does PFM; HDR keeps eight bits of a
    pixel's largest component. PNG, JPEG, BMP and TGA clip to [0, 1], encode sRGB and write NaN as black.

    Args:
        path: File whose suffix picks the format, in a folder that exists.
        image: Linear values, shape (H, W), (H, W, 1), (H, W, 3) or (H, W, 4), or an object with ``numpy()``. EXR, PNG
            and TGA have a fourth channel, alpha; the others leave it out.
        half: EXR only.

    Raises:
        ValueError: If the shape or the suffix is not supported.
        FileNotFoundError: If the folder does not exist; none is made.
        OSError: If the file cannot be written; then what was there before is untouched.
    """
    file = Path(path)
    _check_suffix(file)
    array = np.asarray(image.numpy() if hasattr(image, "numpy") else image, dtype=np.float32)
    if array.ndim == 2:
        array = array[..., None]
    if array.ndim != 3 or array.shape[2] not in (1, 3, 4) or 0 in array.shape:
        raise ValueError(
            f"cannot write an image of shape {np.shape(array)} to '{file}'; "
            "expected (H, W), (H, W, 1), (H, W, 3) or (H, W, 4) with H and W of at least 1; of a transient image give "
            "one bin: image.numpy()[:, :, bin]"
        )
    if not file.parent.is_dir():
        raise FileNotFoundError(f"cannot write '{file}': there is no folder '{file.parent}'; make it first")
    suffix = file.suffix.lower()
    if suffix not in _WITH_ALPHA:
        array = array[..., :3]
    with atomic_path(file) as temporary:
        if suffix in _EXR:
            _write_exr(temporary, array, half)
        elif suffix in _LOW_RANGE:
            _write_low_range(temporary, array)
        else:
            (write_rgbe if suffix in _RGBE else write_pfm)(temporary, array)


def _check_suffix(file: Path) -> None:
    if file.suffix.lower() not in SUFFIXES:
        raise ValueError(f"'{file}' has no supported image suffix; use one of {', '.join(SUFFIXES)}")


def _read_exr(file: Path) -> np.ndarray:
    import OpenEXR

    from warp_psdr.exr_header import declared_values

    try:
        _check_size(declared_values(file))
        with OpenEXR.File(str(file), separate_channels=True) as source:
            channels = {name: np.asarray(channel.pixels) for name, channel in source.channels().items()}
    except Exception as problem:
        raise ValueError(f"'{file}' is no readable EXR image ({problem}); export it again") from None
    for names in (("R", "G", "B", "A"), ("R", "G", "B"), ("Y", "A"), ("Y",)):
        if all(name in channels for name in names):
            break
    else:
        if len(channels) != 1:
            found = ", ".join(channels) or "none"
            raise ValueError(f"'{file}' has the channels {found}; expected R, G, B (and A), or Y, or a single one")
        names = tuple(channels)
    planes = [channels[name] for name in names]
    if any(plane.shape != planes[0].shape for plane in planes):
        raise ValueError(f"the channels of '{file}' differ in size; export it without chroma subsampling")
    return np.ascontiguousarray(np.stack(planes, axis=-1), dtype=np.float32)


def _read_float(file: Path) -> np.ndarray:
    try:
        return read_float_image(file, _VALUES_MAX)
    except ValueError as problem:
        raise ValueError(f"'{file}' is no readable HDR or PFM image ({problem}); export it again") from None


def _write_exr(file: Path, array: np.ndarray, half: bool) -> None:
    import OpenEXR

    if half:
        array = np.clip(array, -_HALF_MAX, _HALF_MAX)
    names = {1: ("Y",), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}[array.shape[2]]
    dtype = np.float16 if half else np.float32
    planes = {name: np.ascontiguousarray(array[..., i], dtype=dtype) for i, name in enumerate(names)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    try:
        with OpenEXR.File(header, planes) as target:
            target.write(str(file))
    except RuntimeError as problem:
        raise OSError(errno.EIO, str(problem)) from problem


def read_picture(data: BinaryIO, name: str, *, raw: bool = False) -> np.ndarray:
    """Read a PNG, JPEG, BMP or TGA image that another file holds; see ``read_image``.

    Args:
        data: The image's bytes.
        name: For messages.
        raw: Leave values as they are stored instead of decoding sRGB.

    Raises:
        ValueError: If it cannot be decoded, or has more than 2^29 values.
    """
    return _read_low_range(data, name, raw)


def _read_low_range(file: Path | BinaryIO, name: object, raw: bool) -> np.ndarray:
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the size is checked here
            # Files of other formats, which have readers of their own, are not what their suffix says.
            with Image.open(file, formats=tuple(set(_LOW_RANGE.values()))) as source:
                _check_size(source.width * source.height * len(source.getbands()))
                source.load()
                values = _pixels(source)
    except Exception as problem:  # damaged files fail in many ways
        raise ValueError(f"'{name}' is no readable PNG, JPEG, BMP or TGA image ({problem}); export it again") from None
    if not raw:
        # In place: large images have room for no second copy.
        color = values.shape[2] - (values.shape[2] in (2, 4))
        for row in values:
            row[..., :color] = srgb_to_linear(row[..., :color])
    return values


def _check_size(values: int) -> None:
    if values > _VALUES_MAX:
        raise ValueError(f"it has {values} values, and at most {_VALUES_MAX} are read: make it smaller")


def _pixels(source: Any) -> np.ndarray:
    """Return a Pillow image's values in [0, 1], shape (H, W, C)."""
    if source.mode.startswith("I"):
        return (np.asarray(source, dtype=np.float32) / np.float32(65535.0))[..., None]
    if source.mode == "P":
        source = source.convert("RGBA" if "transparency" in source.info else "RGB")
    elif source.mode not in ("L", "LA", "RGB", "RGBA"):
        source = source.convert("L" if source.mode == "1" else "RGB")
    values = np.array(source, dtype=np.float32)
    values /= 255.0
    return values[..., None] if values.ndim == 2 else values


def _write_low_range(file: Path, array: np.ndarray) -> None:
    from PIL import Image

    values = linear_to_srgb(array[..., :3])
    if array.shape[2] == 4:
        values = np.concatenate([values, np.clip(np.nan_to_num(array[..., 3:]), 0.0, 1.0)], axis=-1)
    pixels = np.round(values * 255.0).astype(np.uint8)
    stream = io.BytesIO()
    picture = Image.fromarray(pixels[..., 0] if pixels.shape[2] == 1 else pixels)
    picture.save(stream, _LOW_RANGE[file.suffix.lower()], quality=95)
    # Not by Pillow, whose JPEG encoder does not notice when a disk is full.
    file.write_bytes(stream.getvalue())
