"""Read Wavefront OBJ files as arrays of bytes: no line is looked at by itself, unless it is wrong.

trimesh's reader sorts the vertices and splits the mesh by material, while scene parameters rely on Mitsuba's order:
that of the first use in the faces.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warp_psdr.scene.errors import SceneError, error
from warp_psdr.scene.shapes.meshes import FaceMaterials, MeshData, fans

#: Keywords that are read, with the numbers that their lines hold at least.
_COLUMNS = {"v": 3, "vt": 2, "vn": 3}
_REEXPORT = "export the mesh again"
#: Kinds of lines that name a material, and a file of materials.
_USEMTL, _MTLLIB = -2, -3
#: Up to this byte, characters are white space or stand for nothing.
_BLANK = 32
#: Keys of corners are made of three indices; larger products do not fit.
_KEY_MAX = 2**62


def read_obj(file: Path, place: str, note: Any) -> MeshData:
    """Read positions, texture coordinates, normals, vertex colours and polygons (cut into fans).

    Args:
        file: An existing file.
        place: Place in the scene, for messages.
        note: Called with remarks for the user; there are none.

    Raises:
        ValueError: If a line cannot be read, or a face refers to what is not there.
    """
    lines = _Lines.of(file)
    pools = {keyword: _numbers(lines, keyword, place) for keyword in _COLUMNS}
    corners, counts = _corners(lines, tuple(len(pool) for pool in pools.values()), place)
    if len(counts) == 0:
        return MeshData(np.empty((0, 3)), np.empty((0, 3), dtype=np.int64))
    vertex, indices = _in_order_of_use(corners, [len(pool) + 1 for pool in pools.values()])
    positions, texcoords, normals = pools.values()
    data = MeshData(positions[vertex[:, 0], :3], fans(indices, counts))
    if (vertex[:, 1] >= 0).any():
        data.texcoords = np.where(vertex[:, 1:2] >= 0, texcoords[vertex[:, 1], :2], 0.0)
    if (vertex[:, 2] >= 0).any():
        data.normals = np.where(vertex[:, 2:3] >= 0, normals[vertex[:, 2], :3], 0.0)
    if positions.shape[1] >= 6:
        with np.errstate(over="ignore"):  # what overflows becomes infinite, which the checks report
            data.attributes["vertex_color"] = positions[vertex[:, 0], 3:6].astype(np.float32)
    data.materials = _materials(lines, counts)
    return data


def _materials(lines: _Lines, counts: np.ndarray) -> FaceMaterials | None:
    """Return the material of every triangle: that of the last ``usemtl`` before its polygon."""
    used = np.flatnonzero(lines.kind == _USEMTL)
    files = [lines.rest(i) for i in np.flatnonzero(lines.kind == _MTLLIB).tolist()]
    if not len(used):
        return None
    said = [lines.rest(i) for i in used.tolist()]
    names = list(dict.fromkeys(said))
    number = np.array([-1, *(names.index(name) for name in said)])
    polygons = number[np.searchsorted(used, np.flatnonzero(lines.of_kind("f")))]
    return FaceMaterials(np.repeat(polygons, counts - 2), names, files)


@dataclass(eq=False)
class _Lines:
    """The lines of a file that say something.

    Attributes:
        text: (B,) uint8, every line with its end; keywords are blanked.
        start, end: (L,) bytes of each line, its end included.
        number: (L,) of each line in the file, from 1.
        words: (L,) of each line, its keyword included.
        kind: (L,) keyword of each line: its place in ``kinds``, ``_USEMTL``, ``_MTLLIB`` or -1.
    """

    text: np.ndarray
    start: np.ndarray
    end: np.ndarray
    number: np.ndarray
    words: np.ndarray
    kind: np.ndarray

    kinds = ("v", "vt", "vn", "f")

    @classmethod
    def of(cls, file: Path) -> _Lines:
        """Split a file."""
        # An end for the last line, and two bytes more, so that a keyword's neighbours can be read.
        text = np.append(np.fromfile(file, dtype=np.uint8), np.frombuffer(b"\n  ", dtype=np.uint8))
        returns = np.flatnonzero(text == ord("\r"))
        text[returns] = np.where(text[returns + 1] == ord("\n"), _BLANK, ord("\n"))
        word = _words(text)
        ends = np.flatnonzero(text == ord("\n")) + 1
        # Words before each line's end, so of each line.
        before = np.searchsorted(word, ends)
        words = np.diff(before, prepend=0)
        said = words > 0
        number = np.flatnonzero(said) + 1
        start = np.concatenate([[0], ends[:-1]])[said]
        first = word[(before - words)[said]]
        a, b, c = text[first], text[first + 1], text[first + 2]
        kind = np.full(len(number), -1)
        kind[(a == ord("v")) & (b <= _BLANK)] = 0
        kind[(a == ord("v")) & (b == ord("t")) & (c <= _BLANK)] = 1
        kind[(a == ord("v")) & (b == ord("n")) & (c <= _BLANK)] = 2
        kind[(a == ord("f")) & (b <= _BLANK)] = 3
        # Other words that begin so say nothing.
        kind[(a == ord("u")) & (b == ord("s")) & (c == ord("e"))] = _USEMTL
        kind[(a == ord("m")) & (b == ord("t")) & (c == ord("l"))] = _MTLLIB
        # What follows a keyword are numbers.
        text[first[kind >= 0]] = _BLANK
        text[first[(kind == 1) | (kind == 2)] + 1] = _BLANK
        return cls(text, start, ends[said], number, words[said], kind)

    def of_kind(self, keyword: str) -> np.ndarray:
        """Return which lines have a keyword."""
        return self.kind == self.kinds.index(keyword)

    def joined(self, keyword: str) -> bytes:
        """Return what follows the keyword in all of its lines, one behind the other."""
        which = self.of_kind(keyword).astype(np.int8)
        change = np.diff(which, prepend=0, append=0)
        # Runs of such lines.
        first, last = np.flatnonzero(change > 0), np.flatnonzero(change < 0) - 1
        bounds = zip(self.start[first].tolist(), self.end[last].tolist(), strict=True)
        return b"".join([self.text[start:end].data for start, end in bounds])

    def rest(self, i: int) -> str:
        """Return what follows the first word of a line."""
        text = self.text[self.start[i] : self.end[i]].tobytes().decode("utf-8", errors="replace")
        return text.strip().partition(" ")[2].strip()

    def line(self, i: int) -> str:
        """Return a line with a keyword."""
        rest = self.text[self.start[i] : self.end[i]].tobytes().decode("utf-8", errors="replace").strip()
        return f"{self.kinds[self.kind[i]]} {rest}"


def _words(text: np.ndarray) -> np.ndarray:
    """Return where words begin."""
    solid = text > _BLANK
    begins = np.flatnonzero(solid[1:] > solid[:-1]) + 1
    return np.concatenate([[0], begins]) if len(solid) and solid[0] else begins


def parse_numbers(text: bytes, dtype: type) -> np.ndarray | None:
    """Return the numbers of a text; None if it holds anything else."""
    if not text.strip():
        return np.empty(0, dtype=dtype)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # NumPy's word for a text that is no number
            return np.fromstring(text, dtype=dtype, sep=" ")
    except (DeprecationWarning, ValueError):
        return None


def _parse(text: bytes, dtype: type, count: int) -> np.ndarray | None:
    """Return so many numbers of a text; None if it does not hold just these."""
    numbers = parse_numbers(text, dtype)
    return numbers if numbers is not None and len(numbers) == count else None


def _numbers(lines: _Lines, keyword: str, place: str) -> np.ndarray:
    """Return the numbers of all lines with a keyword, shape (N, C) with C >= ``_COLUMNS[keyword]``."""
    columns = _COLUMNS[keyword]
    chosen = np.flatnonzero(lines.of_kind(keyword))
    given = lines.words[chosen] - 1
    if not len(chosen):
        return np.empty((0, columns))
    width = int(given.min())
    if width < columns:
        i = int(np.argmax(given < columns))
        where = f"{place}, line {lines.number[chosen[i]]}"
        raise error(where, f"'{lines.line(chosen[i])}' has {given[i]} numbers", f"write {columns}")
    numbers = _parse(lines.joined(keyword), np.float64, int(given.sum()))
    if numbers is None:
        raise error(place, f"a '{keyword}' line is not made of numbers", _REEXPORT)
    if (given == width).all():
        return numbers.reshape(-1, width)
    return numbers[(np.cumsum(given) - given)[:, None] + np.arange(width)]


def _corners(lines: _Lines, sizes: tuple[int, ...], place: str) -> tuple[np.ndarray, np.ndarray]:
    """Return zero-based (v, vt, vn) of every corner, -1 where absent, and the corners of each polygon."""
    chosen = np.flatnonzero(lines.of_kind("f"))
    counts = lines.words[chosen] - 1
    if (counts < 3).any():
        i = int(np.argmax(counts < 3))
        where = f"{place}, line {lines.number[chosen[i]]}"
        raise error(where, f"a face with {counts[i]} corners", "give at least three")
    if not len(chosen):
        return np.empty((0, 3), dtype=np.int64), counts
    raw = _raw_corners(lines.joined("f"), int(counts.sum()))
    if raw is None:
        raise _unreadable(lines, chosen, place)
    # Negative indices count back from the line of the face.
    seen = np.stack([np.cumsum(lines.kind == k)[chosen] for k in range(3)], axis=1)
    corners = np.where(raw >= 0, raw - 1, raw)
    if raw.size and raw.min() < 0:
        corners = np.where(raw < 0, np.repeat(seen, counts, axis=0) + raw, corners)
    wrong = (corners[:, 0] < 0) | (corners >= sizes).any(axis=1) | ((corners < 0) & (raw != 0)).any(axis=1)
    if wrong.any():
        i = int(np.searchsorted(np.cumsum(counts), np.argmax(wrong), side="right"))
        corner = lines.line(chosen[i]).split()[1 + int(np.argmax(wrong)) - int(counts[:i].sum())]
        raise error(
            f"{place}, line {lines.number[chosen[i]]}",
            f"the corner '{corner}' refers to a missing vertex, texture coordinate or normal",
            f"the file has {sizes[0]} v, {sizes[1]} vt and {sizes[2]} vn",
        )
    return corners, counts


def _raw_corners(text: bytes, count: int) -> np.ndarray | None:
    """Return the numbers of corners as they stand, 0 where absent, shape (count, 3); None: something is no corner."""
    for ending in (b"/", b" ", b"\t", b"\n"):
        if b"/" + ending in text:  # every slash is followed by a number then
            text = text.replace(b"/" + ending, b"/0" + ending)
    letters = np.frombuffer(text, dtype=np.uint8)
    slashes = np.searchsorted(np.flatnonzero(letters == ord("/")), _words(letters))
    if len(slashes) != count:
        return None
    total = text.count(b"/")
    parts = np.diff(slashes, append=total) + 1
    numbers = _parse(text.replace(b"/", b" "), np.int64, count + total)
    if numbers is None:
        return None
    if count and (parts == parts[0]).all():
        width = int(parts[0])
        raw = np.zeros((count, 3), dtype=np.int64)
        raw[:, : min(width, 3)] = numbers.reshape(count, width)[:, :3]
        return raw
    first = np.cumsum(parts) - parts
    last = len(numbers) - 1
    return np.stack([np.where(parts > k, numbers[np.minimum(first + k, last)], 0) for k in range(3)], axis=1)


def _unreadable(lines: _Lines, chosen: np.ndarray, place: str) -> SceneError:
    """Return the exception for the first corner that cannot be read."""
    for i in chosen:
        for corner in lines.line(i).split()[1:]:
            try:
                _ = [int(part) for part in corner.split("/")[:3] if part]
            except ValueError:
                where = f"{place}, line {lines.number[i]}"
                return error(where, f"cannot read the corner '{corner}'", "write v/vt/vn")
    return error(place, "the corners of a face cannot be read", "write v/vt/vn")


def _in_order_of_use(corners: np.ndarray, sizes: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the different corners in the order of their first use, (N, 3), and the number of each corner, (C,)."""
    count = len(corners)
    key, room = corners[:, 0], sizes[0]
    # Where every vertex has one texture coordinate and one normal, it stands for the corner.
    example = np.zeros((room, 3), dtype=np.int64)
    example[key] = corners
    if not np.array_equal(example[key], corners):
        for k in (1, 2):
            if room * sizes[k] > _KEY_MAX:
                key = np.unique(key, return_inverse=True)[1].reshape(-1)
                room = count
            key, room = key * sizes[k] + corners[:, k] + 1, room * sizes[k]
        if room > 4 * count:
            key = np.unique(key, return_inverse=True)[1].reshape(-1)
            room = int(key.max()) + 1
    # Written backwards, so that the first use is what stays.
    first = np.full(room, count)
    first[key[::-1]] = np.arange(count)[::-1]
    used = np.flatnonzero(first < count)
    order = used[np.argsort(first[used])]
    rank = np.empty(room, dtype=np.int64)
    rank[order] = np.arange(len(order))
    return corners[first[order]], rank[key]
