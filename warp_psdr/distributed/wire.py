"""What goes over the wire: arrays without their zeros, and data that is sent once and known by its hash."""

from __future__ import annotations

import hashlib
import math
import pickle
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Packed:
    """An array without the rows (along its last axis; of one axis: the numbers) that are zero.

    A share of an image is zero outside of its pixels, and a gradient by a texture where nothing looked it up.

    Attributes:
        shape: of the array.
        mask: a bit for every row, whether it is kept; None: all are.
        rows: those that are kept, (rows, columns).
    """

    shape: tuple[int, ...]
    mask: np.ndarray | None
    rows: np.ndarray

    @property
    def nbytes(self) -> int:
        """Size of what is sent, bytes."""
        return self.rows.nbytes + (0 if self.mask is None else self.mask.nbytes)


def pack(array: np.ndarray) -> Packed:
    """Leave out what is zero."""
    rows = np.ascontiguousarray(array).reshape(-1, array.shape[-1] if array.ndim > 1 else 1)
    kept = np.zeros(len(rows), bool)
    for column in rows.T:
        kept |= column != 0.0
    if kept.all():
        return Packed(array.shape, None, rows)
    return Packed(array.shape, np.packbits(kept), rows[kept])


def add(one: Packed, other: Packed) -> Packed:
    """Return the sum of two arrays of one shape: where one of them is zero the other stays as it is."""
    if one.mask is None and other.mask is None:
        return Packed(one.shape, None, one.rows + other.rows)
    a, b = _kept(one), _kept(other)
    both = a | b
    rows = np.zeros((int(both.sum()), one.rows.shape[1]), one.rows.dtype)
    rows[a[both]] = one.rows
    rows[b[both]] += other.rows
    return Packed(one.shape, None if both.all() else np.packbits(both), rows)


def unpack(packed: Packed) -> np.ndarray:
    """Return the array."""
    if packed.mask is None:
        return packed.rows.reshape(packed.shape)
    kept = _kept(packed)
    rows = np.zeros((len(kept), packed.rows.shape[1]), packed.rows.dtype)
    rows[kept] = packed.rows
    return rows.reshape(packed.shape)


def _kept(packed: Packed) -> np.ndarray:
    """Return which rows are kept."""
    size = math.prod(packed.shape) // packed.rows.shape[1]
    return np.ones(size, bool) if packed.mask is None else np.unpackbits(packed.mask, count=size).view(bool)


@dataclass(frozen=True, eq=False)
class Parcel:
    """Data that is sent to a process once.

    Attributes:
        digest: SHA-256 of the data, by which processes know it.
        data: pickled.
    """

    digest: str
    data: bytes

    def __repr__(self) -> str:
        return f"<Parcel {self.digest[:8]}, {len(self.data)} bytes>"


def parcel(value: Any) -> Parcel:
    """Wrap a value up."""
    data = pickle.dumps(value, protocol=pickle.HIGHEST_PROTOCOL)
    return Parcel(hashlib.sha256(data).hexdigest(), data)


class Store:
    """Values by their digests; those that were used least recently go first.

    Args:
        most: sizes of the values together, at most; the last one stays in any case.
    """

    def __init__(self, most: int):
        self._most, self._held = most, 0
        self._values: OrderedDict[str, tuple[Any, int]] = OrderedDict()

    def get(self, digest: str) -> Any:
        """Return a value that is there."""
        self._values.move_to_end(digest)
        return self._values[digest][0]

    def put(self, digest: str, value: Any, size: int) -> None:
        """Keep a value of a size."""
        self._values[digest] = (value, size)
        self._held += size
        while self._held > self._most and len(self._values) > 1:
            self._held -= self._values.popitem(last=False)[1][1]

    def __contains__(self, digest: str) -> bool:
        return digest in self._values
