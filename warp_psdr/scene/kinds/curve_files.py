"""Curves as Mitsuba reads them: a control point a line, (x, y, z, radius); an empty line starts a new curve."""

from __future__ import annotations

from pathlib import Path

import numpy as np

#: Most bytes of a file.
MOST_BYTES = 1 << 31


def read_curves(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the control points of a file, (N, 4) float32, and the first one of each curve, (C,).

    Lines that start with '#' are left out. What follows the fourth number of a line is not read, as in Mitsuba.

    Raises:
        ValueError: it is too long or no text, or a line holds fewer than four numbers.
    """
    if file.stat().st_size > MOST_BYTES:
        raise ValueError(f"'{file.name}' has more than {MOST_BYTES} bytes; split it into several shapes")
    try:
        lines = [line.strip() for line in file.read_text(encoding="utf-8").split("\n")]
    except UnicodeDecodeError:
        raise ValueError(f"'{file.name}' is no text; give a control point, 'x y z radius', a line") from None
    lines = [line for line in lines if not line.startswith("#")]
    filled = np.array([bool(line) for line in lines], bool)
    words = [line.split()[:4] for line in lines if line]
    try:
        points = np.array(words, np.float64).reshape(-1, 4)
    except ValueError:
        number = next(i for i, line in enumerate(words) if not _is_point(line))
        raise ValueError(
            f"'{file.name}', control point {number + 1}: got {' '.join(words[number])!r}; give 'x y z radius'"
        ) from None
    starts = filled & ~np.concatenate([[False], filled[:-1]])
    numbers = np.cumsum(filled) - 1
    with np.errstate(over="ignore"):
        return points.astype(np.float32), numbers[starts]


def _is_point(words: list[str]) -> bool:
    try:
        return len([float(word) for word in words]) == 4
    except ValueError:
        return False
