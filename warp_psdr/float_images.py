"""Images in floating point without a library: Radiance's RGBE (.hdr) and the portable float map (.pfm).

G. Ward, "Real Pixels", Graphics Gems II (1991), and the Radiance file format: text lines, an empty one, the resolution,
then pixels of three mantissas and one exponent, each component of a row run-length encoded. A portable float map has
three text lines, the last one a scale whose sign tells the order of bytes, and rows from the bottom up.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import BinaryIO

import numpy as np

__all__ = ["read_float_image", "write_pfm", "write_rgbe"]

#: Longest text line of a header, and most of them: more than any program writes.
_LINE_MAX, _LINES_MAX = 4096, 256
#: Widths of rows that are run-length encoded; others are plain.
_ENCODED_MIN, _ENCODED_MAX = 8, 32767
#: Longest stretch of bytes that a row's code takes over as they are.
_STRETCH = 128
#: Exponent of a pixel of 1 / 256, and the powers of two whose mantissas have eight bits.
_BIAS = 128 + 8
#: Largest value of a pixel: 255 at the largest exponent.
_RGBE_MAX = float(np.ldexp(255.0, 255 - _BIAS))


def read_float_image(file: Path, most: int) -> np.ndarray:
    """Return the pixels of a .hdr or .pfm file as stored, (H, W, 1 or 3) float32, top row first.

    Args:
        file: Its content tells which of the two it is.
        most: Largest number of values that are read.

    Raises:
        ValueError: If the file is neither, is cut off, or has more values.
    """
    with file.open("rb") as stream:
        kind, width, height, channels, little = _header(stream)
        if width * height * channels > most:
            raise ValueError(f"it has {width * height * channels} values, and at most {most} are read: make it smaller")
        data = stream.read()
    if kind == "pfm":
        if len(data) < 4 * width * height * channels:
            raise ValueError("it ends within its pixels")
        values = np.frombuffer(data, "<f4" if little else ">f4", width * height * channels)
        return values.reshape(height, width, channels)[::-1].astype(np.float32)
    pixels = _rgbe_pixels(data, width, height)
    scale = np.ldexp(np.float32(1.0), pixels[..., 3].astype(np.int32) - _BIAS)
    return np.where(pixels[..., 3:] > 0, pixels[..., :3] * scale[..., None], np.float32(0.0)).astype(np.float32)


def write_rgbe(file: Path, array: np.ndarray) -> None:
    """Write (H, W, 1 or 3) as RGBE: eight bits of the largest component; what is negative or NaN as 0."""
    height, width = array.shape[:2]
    values = np.broadcast_to(array, (height, width, 3)).astype(np.float64)
    values = np.clip(np.nan_to_num(values, nan=0.0, posinf=_RGBE_MAX), 0.0, _RGBE_MAX)
    exponent = np.frexp(values.max(axis=2))[1]
    mantissa = np.floor(values * np.ldexp(1.0, 8 - exponent)[..., None]).astype(np.int64)
    pixels = np.concatenate([mantissa, exponent[..., None] + 128], axis=2)
    pixels[(pixels[..., 3] <= 0) | (mantissa.max(axis=2) == 0)] = 0
    rows = np.clip(pixels, 0, 255).astype(np.uint8)
    with file.open("wb") as stream:
        stream.write(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (height, width))
        for row in rows:
            stream.write(_coded(row, width) if _ENCODED_MIN <= width <= _ENCODED_MAX else row.tobytes())


def write_pfm(file: Path, array: np.ndarray) -> None:
    """Write (H, W, 1 or 3) as a portable float map: every value is kept."""
    height, width, channels = array.shape
    with file.open("wb") as stream:
        stream.write(b"%s\n%d %d\n-1.0\n" % (b"PF" if channels == 3 else b"Pf", width, height))
        stream.write(np.ascontiguousarray(array[::-1], "<f4").tobytes())


def _coded(row: np.ndarray, width: int) -> bytes:
    """Return a row as the format wants wide ones, with its bytes as they are: stretches, and no runs."""
    parts = [bytes((2, 2, width >> 8, width & 255))]
    for component in row.T:
        for first in range(0, width, _STRETCH):
            stretch = component[first : first + _STRETCH].tobytes()
            parts += [bytes((len(stretch),)), stretch]
    return b"".join(parts)


def _rgbe_pixels(data: bytes, width: int, height: int) -> np.ndarray:
    """Return the bytes of the pixels, (H, W, 4)."""
    pixels = np.zeros((height, width, 4), np.uint8)
    at = 0
    for row in pixels:
        head = data[at : at + 4]
        if len(head) < 4:
            raise ValueError("it ends within its pixels")
        if not _ENCODED_MIN <= width <= _ENCODED_MAX or head[:2] != b"\2\2" or head[2] & 128:
            at = _plain_row(data, at, row)
            continue
        if head[2] << 8 | head[3] != width:
            raise ValueError("a row has another width than its header says")
        at += 4
        for component in range(4):
            at = _coded_component(data, at, row[:, component])
    return pixels


def _coded_component(data: bytes, at: int, out: np.ndarray) -> int:
    """Decode runs and stretches of one component of a row; returns where the next one starts."""
    filled = 0
    while filled < len(out):
        if at + 1 >= len(data):
            raise ValueError("it ends within its pixels")
        count = data[at]
        if count > _STRETCH:
            count -= _STRETCH
            out[filled : filled + count] = data[at + 1]
            at += 2
        else:
            part = np.frombuffer(data, np.uint8, min(count, len(data) - at - 1), at + 1)
            if not count or len(part) < count or filled + count > len(out):
                raise ValueError("its run lengths do not fit its rows")
            out[filled : filled + count] = part
            at += 1 + count
        filled += count
    if filled > len(out):
        raise ValueError("its run lengths do not fit its rows")
    return at


def _plain_row(data: bytes, at: int, out: np.ndarray) -> int:
    """Decode a row of whole pixels, of which (1, 1, 1, n) repeats the one before (old run-length code)."""
    filled, shift = 0, 0
    while filled < len(out):
        pixel = data[at : at + 4]
        if len(pixel) < 4:
            raise ValueError("it ends within its pixels")
        at += 4
        if pixel[:3] == b"\1\1\1" and filled:
            count = min(pixel[3] << shift, len(out) - filled)
            out[filled : filled + count] = out[filled - 1]
            filled, shift = filled + count, min(shift + 8, 16)
        else:
            out[filled] = np.frombuffer(pixel, np.uint8)
            filled, shift = filled + 1, 0
    return at


def _header(stream: BinaryIO) -> tuple[str, int, int, int, bool]:
    """Return (kind, width, height, channels, whether bytes come lowest first)."""
    first = _line(stream)
    if first in ("PF", "Pf"):
        size = re.fullmatch(r"(\d{1,9})\s+(\d{1,9})", _line(stream))
        if size is None:
            raise ValueError("it declares no size")
        return "pfm", *_sizes(size[1], size[2]), 3 if first == "PF" else 1, float(_line(stream)) < 0.0
    if not first.startswith("#?"):
        raise ValueError("it starts neither as a Radiance image nor as a portable float map")
    for _ in range(_LINES_MAX):
        line = _line(stream)
        if line.startswith("FORMAT=") and line != "FORMAT=32-bit_rle_rgbe":
            raise ValueError(f"its {line}, expected FORMAT=32-bit_rle_rgbe")
        if not line:
            break
    size = re.fullmatch(r"-Y (\d{1,9}) \+X (\d{1,9})", _line(stream))
    if size is None:
        raise ValueError("it declares no size, or rows that run otherwise than from the top left")
    return "rgbe", *_sizes(size[2], size[1]), 3, True


def _sizes(width: str, height: str) -> tuple[int, int]:
    if not int(width) or not int(height):
        raise ValueError(f"it declares {width} x {height} pixels")
    return int(width), int(height)


def _line(stream: BinaryIO) -> str:
    line = stream.readline(_LINE_MAX)
    if not line.endswith(b"\n"):
        raise ValueError("a line of its header has no end")
    return line[:-1].decode("latin-1").strip()
