"""Error bars: how far sampling noise, and what a scene lacks, may have moved a least-squares solution.

Three causes add up. The scatter of random numbers is told by two independent looks. With H = J^T W J and the residuals'
scores s_p = w_p J_p r_p of pixels p, what residuals do is H^-1 C H^-1, C the covariance of the sum of scores.
Independent residuals would give the textbook's sigma^2 H^-1. Those of photographs go together over many pixels
(response, compression, uneven light), so scores are summed over square blocks first, whose sums are about independent:
C = sum over blocks of s_b s_b^T / (1 - l_b)^2, l_b = trace(H^-1 J_b^T W J_b) / n the share of what is known that the
block tells, as if each block had been left out in turn. Blocks of many sizes are tried, whole photographs as well if
there are several, and those that give the widest bars count: smaller ones cut what goes together, in larger ones errors
of opposite signs cancel.

What goes one way everywhere leaves no scatter. So the response is doubted, and the evenness of light: the shift of the
solution, if the exponent of the response and a slope of brightness in x and y were unknown, counts as an error itself.

Derivation: ``docs/theory/photographs.md``.
"""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
from scipy import stats

from warp_psdr.observe.problem import Normal, Problem, Side, normal_equations
from warp_psdr.observe.solution import Errors, Solution, Step, that_matter

#: Edges of blocks, pixels; least number of blocks along an image's shorter side; least share of what is known that is
#: left without a block.
SIZES, ALONG, LEAST_REST = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64), 4, 0.2
#: Least number of photographs that are also left out as wholes.
PHOTOGRAPHS = 4
#: Residual, over that of a grey picture, from which on the scene does not look like the photographs.
UNLIKE = 0.7


def estimated(problem: Problem, normal: Normal, a: list[Side], b: list[Side], robust: list[np.ndarray]) -> Errors:
    """Return the errors of a problem's values, from two looks there and their normal equations."""
    inverse, undetermined = normal.inverse(problem.labels)
    sampling, maps = np.zeros_like(inverse), []
    for one, other, w in zip(a, b, robust, strict=True):
        mean, apart = 0.5 * (one.residual + other.residual), 0.5 * (one.residual - other.residual)
        columns, turned = 0.5 * (one.columns + other.columns), 0.5 * (one.columns - other.columns)
        n = one.numbers
        noise = (w * (columns * apart + turned * mean)).sum(axis=3).reshape(len(n), -1)
        sampling[np.ix_(n, n)] += noise @ noise.T
        told = np.einsum("ihwc,ij,jhwc,hw->hw", columns, inverse[np.ix_(n, n)], columns, w[..., 0], optimize=True)
        maps.append((n, np.append((w * columns * mean).sum(axis=3), told[None] / problem.size, axis=0), w[..., 0]))
    spread, freedom, block = _widest(maps, inverse)
    shift = _shift(problem, a, b, robust)
    return Errors(
        sampling=inverse @ sampling @ inverse,
        residuals=_with_unknown(spread, undetermined),
        doubts=np.outer(shift, shift),
        freedom=freedom,
        block=block,
        undetermined=tuple(undetermined),
    )


def _shift(problem: Problem, a: list[Side], b: list[Side], robust: list[np.ndarray]) -> np.ndarray:
    """Return how far the values would go if what a photograph may have were unknown, too: one Gauss-Newton step."""
    more, size = [], problem.size
    for (_sensor, photograph), one, other in zip(problem.views, a, b, strict=True):
        doubts = [photograph.doubts(side.image) for side in (one, other)]
        added = np.arange(size, size + len(doubts[0]))
        size += len(added)
        more.append([_extended(side, added, own) for side, own in zip((one, other), doubts, strict=True)])
    both = [list(sides) for sides in zip(*more, strict=True)]
    whole = normal_equations(both[0], both[1], robust, size)
    return whole.step(0.0)[: problem.size]


def _extended(side: Side, numbers: np.ndarray, columns: np.ndarray) -> Side:
    """Return a look with further columns."""
    stacked = np.concatenate([side.columns, columns.astype(np.float32)])
    return replace(side, numbers=np.append(side.numbers, numbers), columns=stacked)


def solution(
    problem: Problem, a: list[Side], b: list[Side], robust: list[np.ndarray], steps: list[Step], reason: str, bars: bool
) -> Solution:
    """Return values from two looks at the end, with their errors if ``bars``; warn where they are not to be trusted."""
    found = estimated(problem, normal_equations(a, b, robust, problem.size), a, b, robust) if bars else None
    rms, unlike = _residual(problem, a, b)
    unknowns = tuple(problem.unknowns)
    solved = Solution(tuple(problem.labels), problem.values(), found, rms, tuple(steps), reason, unknowns)
    _warn(solved.undetermined, unlike, reason)
    return solved


def _residual(problem: Problem, a: list[Side], b: list[Side]) -> tuple[float, float]:
    """Return the residual's root mean square, and its squares over those of the photographs around their means."""
    squares, count, plain = 0.0, 0.0, 0.0
    for (_sensor, photograph), one, other in zip(problem.views, a, b, strict=True):
        counts = photograph.weights > 0.0
        squares += float((one.residual * other.residual)[counts].sum())
        target = photograph.weights * photograph.linear
        plain += float(((target - target[counts].mean())[counts] ** 2).sum())
        count += counts.sum()
    return float(np.sqrt(max(squares, 0.0) / max(count, 1.0))), squares / max(plain, 1e-30)


def _warn(undetermined: tuple[str, ...], unlike: float, reason: str) -> None:
    for text in undetermined:
        warnings.warn(f"solve: the pictures do not tell {text}; fix one of them", RuntimeWarning, stacklevel=4)
    if "not enough" in reason:
        warnings.warn(f"solve: {reason}; give more steps, or start from the values found", RuntimeWarning, stacklevel=4)
    if unlike > UNLIKE:
        warnings.warn(
            f"solve: the residuals are {100.0 * unlike:.0f} % of the photographs' own contrast (squares): the scene "
            "does not look like them; start nearer, or free what differs",
            RuntimeWarning,
            stacklevel=4,
        )


def _with_unknown(covariance: np.ndarray, undetermined: list[tuple[str, np.ndarray]]) -> np.ndarray:
    """Return a covariance that is infinite for the numbers of directions that no picture tells."""
    for _text, direction in undetermined:
        covariance[np.diag(that_matter(direction))] = np.inf
    return covariance


def _widest(
    maps: list[tuple[np.ndarray, np.ndarray, np.ndarray]], inverse: np.ndarray
) -> tuple[np.ndarray, np.ndarray, int]:
    """Return (covariance, freedom of each number, block) of the blocks that give the widest bars, each number's own.

    ``maps``: of each picture the numbers that move it, scores (k, H, W) with shares as their last plane, and weights.
    """
    most = max(min(min(scores.shape[1:]) for _n, scores, _w in maps) // ALONG, 1)
    sizes = [size for size in SIZES if size <= most] or [1]
    if len(maps) >= PHOTOGRAPHS:
        sizes.append(max(max(scores.shape[1:]) for _n, scores, _w in maps))
    found = [_of_blocks(maps, inverse, size) for size in sizes]
    deviations = np.array([np.sqrt(np.diag(covariance)) for covariance, _freedom in found])
    bars = deviations * stats.t.ppf(0.975, [freedom for _covariance, freedom in found])[:, None]
    own = bars.argmax(axis=0)
    at = int(np.argmax((bars / np.maximum(bars.max(axis=0), 1e-300)).sum(axis=1)))
    grown = deviations[own, np.arange(len(own))] / np.maximum(deviations[at], 1e-300)
    return found[at][0] * np.outer(grown, grown), np.array([found[i][1] for i in own]), sizes[at]


def _of_blocks(
    maps: list[tuple[np.ndarray, np.ndarray, np.ndarray]], inverse: np.ndarray, edge: int
) -> tuple[np.ndarray, int]:
    """Return the covariance of blocks of a size, and its degrees of freedom."""
    scores, shares = [], []
    for numbers, planes, weights in maps:
        sums = _block_sums(planes, edge, weights)
        whole = np.zeros((sums.shape[1], len(inverse)))
        whole[:, numbers] = sums[:-1].T
        scores.append(whole)
        shares.append(sums[-1])
    share = np.concatenate(shares)
    of_blocks = np.concatenate(scores) / np.maximum(1.0 - share, LEAST_REST)[:, None]
    # As many blocks tell as much as equal ones would.
    squares = float((share**2).sum())
    freedom = max(round(float(share.sum()) ** 2 / squares) - 1, 1) if squares > 0.0 else 1
    return inverse @ (of_blocks.T @ of_blocks) @ inverse, freedom


def _block_sums(scores: np.ndarray, edge: int, robust: np.ndarray) -> np.ndarray:
    """Return sums of scores (k, H, W) over squares in which pixels count, (k, blocks)."""
    k, h, w = scores.shape
    rows, columns = -(-h // edge), -(-w // edge)
    padded = np.zeros((k + 1, rows * edge, columns * edge))
    padded[:k, :h, :w] = scores
    padded[k, :h, :w] = robust > 0.0
    sums = padded.reshape(k + 1, rows, edge, columns, edge).sum(axis=(2, 4)).reshape(k + 1, -1)
    return sums[:k, sums[k] > 0.0]
