"""Long simulations on tapes: stretches are recorded one after the other, and memory grows as the root of the frames.

A tape keeps every state of a simulation. Here states are kept at the beginnings of stretches alone. From the last
stretch to the first one, each is simulated again from its beginning, this time on a tape of its own, rendered, and
differentiated; the adjoint of its first state is that of the last state of the stretch before [Griewank and Walther
2000, Algorithm 799: revolve, of one level].
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_psdr.device import active_tape

__all__ = ["rollout"]


@dataclass(frozen=True)
class Rollout:
    """What ``rollout`` returns.

    Attributes:
        loss: the sum of all frames' losses.
        losses: of every frame, float64.
        last: the state behind the last frame.
    """

    loss: float
    losses: np.ndarray
    last: Any


def rollout(
    step: Callable[[Any, int], Any],
    show: Callable[[Any, int], wp.array],
    frames: int,
    *,
    state: Any,
    every: int | None = None,
) -> Rollout:
    """Simulate, render and differentiate many frames, in little memory.

    Gradients are added to those of all arrays that ``step`` and ``show`` read, and of the first state's. They have the
    bits that one tape over all frames gives. The simulation runs twice, each frame is rendered once.

    Args:
        step: (state, frame) -> the next state, in arrays that it allocates; kernels, which a tape may record. Equal
            arguments must give equal bits.
        show: (state, frame) -> loss, one number of float32; renders what ``step`` has returned. ``psdr.bind`` and
            ``psdr.render`` find the tape that is active.
        frames: their number.
        state: the first one: an array, a list or a mapping of arrays, or an object that has them (``newton.State``).
            What is differentiated requires a gradient.
        every: frames of a stretch; default: the root of their number, which takes the least memory.

    Raises:
        ValueError: numbers out of range, a loss that is no single number with a gradient, or a tape is active.
    """
    every = math.isqrt(max(frames - 1, 0)) + 1 if every is None else every
    if frames < 1 or every < 1:
        raise ValueError(f"rollout: got frames={frames}, every={every}, expected positive numbers")
    if active_tape() is not None:
        raise ValueError("rollout: it records tapes of its own; call it outside of a tape's with block")
    starts = list(range(0, frames, every))
    kept, now = {0: state}, state
    for k in range(starts[-1]):
        now = step(now, k)
        if k + 1 in starts:
            kept[k + 1] = now
    losses, last, behind = np.zeros(frames), None, None
    for first in reversed(starts):
        stop = min(first + every, frames)
        tape, seeds, now = wp.Tape(), [], kept.pop(first)
        begun = arrays_of(now)
        with tape:
            for k in range(first, stop):
                now = step(now, k)
                seeds.append(_checked(show(now, k), k))
        losses[first:stop] = [float(loss.numpy()[0]) for loss in seeds]
        if behind is None:
            last = now
        else:
            for array, adjoint in zip(arrays_of(now), behind, strict=True):
                if array.grad is not None and adjoint is not None:
                    array.grad.assign(adjoint)
        for loss in seeds:
            loss.grad.fill_(1.0)
        tape.backward()
        behind = [array.grad for array in begun]
    return Rollout(float(losses.sum()), losses, last)


def arrays_of(state: Any) -> list[wp.array]:
    """Return the arrays of floating-point numbers of a state, in a fixed order."""
    if isinstance(state, wp.array):
        values = [state]
    elif isinstance(state, Mapping):
        values = [state[key] for key in sorted(state)]
    elif isinstance(state, (list, tuple)):
        values = list(state)
    else:
        values = [value for _name, value in sorted(vars(state).items())]
    return [value for value in values if isinstance(value, wp.array)]


def _checked(loss: Any, frame: int) -> wp.array:
    if not isinstance(loss, wp.array) or loss.size != 1 or loss.dtype is not wp.float32 or loss.grad is None:
        raise ValueError(f"rollout: show returned {loss!r} for frame {frame}, expected one float32 with a gradient")
    return loss
