"""Check 6: seconds that a gradient takes to relative errors, from the pilot that certificates make anyway.

The error is the root mean square over a parameter's numbers, relative to the gradient's. It falls with the square root
of the samples. ``psdr.accuracy`` says it more precisely, and term by term.
"""

from __future__ import annotations

import math

import numpy as np

from warp_psdr.certify.certificate import ERRORS, Price

NAME = "price"


def price(parameter: str, batches: np.ndarray, seconds: float) -> Price:
    """Return what a parameter's gradient costs.

    Args:
        parameter: its name.
        batches: (n, ...) independent gradients.
        seconds: of one of them.
    """
    noise = float(batches.var(axis=0, ddof=1).sum())
    signal = float((batches.mean(axis=0) ** 2).sum()) - noise / len(batches)
    if signal <= 0.0:
        return Price(parameter, tuple(math.inf for _error in ERRORS))
    return Price(parameter, tuple(seconds * noise / signal / error**2 for error in ERRORS))
