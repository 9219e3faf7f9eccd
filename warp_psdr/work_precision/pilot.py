"""The pilot: a short run that measures what a batch of every term costs and how uncertain it is.

1. Every term runs once, untimed: kernels are compiled and guiding structures built.
2. Two timings at two sample counts give each term's fixed and marginal cost, and from these the batch: large enough
   that the fixed cost is a tenth of it, small enough that the pilot has time for many.
3. A few batches of the term over pixels say whether samples are better spread unevenly over the image (``tiles.py``).
4. Rounds of one batch of every term, each with a seed of its own, until the prediction is as certain as
   ``CERTAIN`` or the pilot's time is over; every fifth round also runs a batch of another size, whose time and
   variance give the marginal cost and the exponent. Where rare samples carry the variance, that time may not be enough:
   the pilot goes on while the prediction is less certain than ``UNCERTAIN``, or, before an error is asked for, until it
   has taken ``SHARE`` of what that is predicted to take.
5. Where the method is biased by choice, batches of an unbiased one tell by how much (``bias.py``).

How long the pilot runs, and so what it finds, depends on the machine's speed: it is no function of the seed alone.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.arguments import checked_seed, samples
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.options import PathIntegrator, from_description
from warp_psdr.work_precision import bias
from warp_psdr.work_precision import quantity as quantities
from warp_psdr.work_precision.allocation import efficiency
from warp_psdr.work_precision.quantity import Part, Quantity
from warp_psdr.work_precision.report import LARGEST_FOR_ERROR, Report, TermReport, positive
from warp_psdr.work_precision.statistics import Moments, Running, jackknife, moments, relative_variance
from warp_psdr.work_precision.tiles import BATCHES as TILE_BATCHES
from warp_psdr.work_precision.tiles import Tiling, measured, spread, uniform

if TYPE_CHECKING:
    from warp_psdr.parameters import Parameters
    from warp_psdr.scene.scene import Scene

CLOCKS: dict[str, Callable[[], float]] = {"wall": time.perf_counter, "cpu": time.process_time}
#: Seed streams: of the pilot's tilings, batches, batches of the other size, first runs, and of the bias.
STREAM_PILOT, STREAM_TILES, STREAM_BATCHES, STREAM_OTHER, STREAM_WARM, STREAM_BIAS = 0x70696C6F, 0, 1, 2, 3, 4
#: Share of a batch's time that is the fixed cost's.
FIXED_SHARE = 0.1
#: Samples a pixel of a batch, at most; of an image, whose samples are stratified within a pixel, at first and at least;
#: and the two counts of the first timings.
MOST_SPP, FIRST_IMAGE_SPP, LEAST_IMAGE_SPP, FIRST_COUNTS = 256, 16, 4, (1, 4)
#: Rounds: the least, the most, and how many the pilot's time should be enough for.
LEAST_ROUNDS, MOST_ROUNDS, AIM_ROUNDS = 4, 256, 64
#: Standard error of the logarithm of a predicted time at which the pilot ends.
CERTAIN = 0.12
#: Rounds after which what is known is looked at; after the pilot's time, when it has grown by a factor.
LOOKS, LATER = (32, 45, 64, 91, 128, 181), 1.2
#: Standard error at which it goes on for so many times its time, as it does where nothing stands out of the noise. (A
#: budget's own pilot has less patience with what is only uncertain.)
UNCERTAIN, PATIENCE = 0.2, 4.0
#: Share of a time budget, and of the predicted time to an error, that its own pilot may take.
SHARE = 0.2
#: Share of the pilot's time that tilings may take.
TILE_SHARE = 0.25
#: Batches of the other size: larger by this factor, as those for an error are at most, so that what they cost and how
#: they vary lies between two that were measured; and the rounds from one to the next.
LARGER, OTHER_EVERY = int(LARGEST_FOR_ERROR), 5
#: Share of the times of a batch that count, from the fastest on.
KEPT_TIMES = 0.9
#: Batches of a term that are kept hold at most this many numbers (256 MB).
KEPT = 1 << 25


def accuracy(
    scene: Scene,
    params: Parameters | None = None,
    adjoint=None,
    *,
    tangents: dict | None = None,
    integrator: PathIntegrator | None = None,
    sensor: int = 0,
    spp: int | None = None,
    seed: int = 0,
    seconds: float = 4.0,
    tiles: bool = True,
    clock: str = "wall",
    progress: Callable[[float], None] | None = None,
) -> Report:
    """Measure what accuracy costs: of a gradient, of a derivative image, or of the image itself.

    Every term has a row: the interior, what of the boundary the camera sees, its direct part (a light or the sky seen
    past an edge from what the camera sees) and its indirect one (``kernels/boundary/depth.py``), and rarer ones.

    Args:
        scene: a loaded scene.
        params: its parameters; with an adjoint after ``requires_grad``.
        adjoint: derivative of a loss with respect to the image, as ``render_backward`` takes it: accuracy of the
            gradient.
        tangents: as ``render_forward`` takes them: accuracy of the derivative image. Neither: accuracy of the image.
        integrator: default: what the scene file names. Sample counts of its boundary method are not used.
        sensor: which camera.
        spp: samples a pixel of a batch, of every term; default: chosen by the costs.
        seed: of the pilot.
        seconds: what the pilot may take; more where four batches a term need it, and up to four times as much where
            nothing stands out of the noise yet, or the standard error of a predicted time is above 20 %.
        tiles: spread samples over the image by its variance, and by the adjoint of every pixel, where that pays.
        clock: "wall", or "cpu" for the processor time of all threads, which other work on the machine changes less.
        progress: called with the finished fraction.

    Returns:
        The report; ``print`` it, ask it for ``seconds_to(error)``, or pass it to ``render(..., report=report)``.

    Raises:
        ValueError: wrong arguments; what the methods do not cover; or the gradient does not stand out of the noise.
    """
    if clock not in CLOCKS:
        raise ValueError(f"clock: got {clock!r}, expected 'wall' or 'cpu'")
    if adjoint is not None and tangents is not None:
        raise ValueError("accuracy takes an adjoint (of a gradient) or tangents (of a derivative image), not both")
    what = select(scene, params, adjoint, tangents, integrator=integrator, sensor=sensor)
    other = bias.unbiased(integrator or from_description(scene.description.integrator), what)
    twin = None if other is None else select(scene, params, adjoint, tangents, integrator=other, sensor=sensor)
    seed, seconds = checked_seed(seed), positive("seconds", seconds)
    spp = None if spp is None else samples("spp", spp)
    return run(
        what, spp=spp, seed=seed, seconds=seconds, tiles=tiles, clock=clock, setup=True, twin=twin, progress=progress
    )


def select(scene: Scene, params, adjoint, tangents, *, integrator, sensor: int) -> Quantity:
    """Return what is to be estimated.

    Raises:
        ValueError: parameters are missing.
    """
    if adjoint is None and tangents is None:
        return quantities.image(scene, integrator=integrator, sensor=sensor)
    if params is None:
        raise ValueError("params: needed with an adjoint or tangents; params = psdr.traverse(scene)")
    if tangents is not None:
        return quantities.derivative(scene, params, tangents, integrator=integrator, sensor=sensor)
    return quantities.gradient(scene, params, adjoint, integrator=integrator, sensor=sensor)


def run(
    what: Quantity,
    *,
    spp: int | None,
    seed: int,
    seconds: float,
    tiles: bool,
    clock: str,
    setup: bool = False,
    twin: Quantity | None = None,
    error: float | None = None,
    patience: float = PATIENCE,
    progress: Callable[[float], None] | None = None,
) -> Report:
    """Run the pilot of a quantity.

    Arguments as ``accuracy``'s; ``setup``: also time what is built once; ``twin``: the same by an unbiased method, from
    which the bias is measured; ``error``: what will be asked for; ``patience``: how many times its time a pilot may
    take that is ``UNCERTAIN``.

    Raises:
        ValueError: the gradient does not stand out of the noise.
    """
    now, seed = CLOCKS[clock], mix_seed(seed, STREAM_PILOT)
    warm, even = mix_seed(seed, STREAM_WARM), what
    for part in what.parts:
        part.run(1, warm)
    start = now()
    building = [_building(part, now) if setup else 0.0 for part in what.parts]
    sizes = _sizes(what, spp, seconds, now, warm)
    found_tiles = _tiles(what, sizes[0], seed, seconds, now) if tiles else None
    side, deviations = found_tiles or (0, ())
    tiling = spread(what, side, deviations) if side else uniform(what)
    what = what.tiled(tiling)

    def allowed(found: Moments, cost: np.ndarray) -> float:
        if not found.seen.any():
            return PATIENCE * seconds
        if error is not None:
            relative = relative_variance(found.variance, found.norm2, found.seen)
            return max(seconds, SHARE * float(efficiency(cost, relative)) / error**2)
        return seconds if _spread(found, cost, np.zeros(len(cost))) <= UNCERTAIN else patience * seconds

    kept, times, others, other_times, found = _rounds(what, sizes, seed, seconds, allowed, start, now, progress)
    if not found.seen.any():
        raise ValueError(
            f"the {'gradient' if what.role == 'reverse' else 'image'} does not stand out of the noise of "
            f"{found.batches} batches: it is zero, or needs a longer pilot (seconds=...), or a method that samples it "
            "better"
        )
    names = list(what.blocks)
    second = moments(others, list(what.blocks.values())) if len(others[0]) > 2 else None
    terms = tuple(
        _term(what, k, sizes[k], building[k], times[k], other_times[k], names, found, second, tiling)
        for k in range(len(what.parts))
    )
    cost = np.array([t.seconds for t in terms])
    squared = None
    if twin is not None:
        squared = bias.measured(even, twin, found, sizes[0], mix_seed(seed, STREAM_BIAS), seconds, now)
    report = Report(
        role=what.role,
        clock=clock,
        batches=found.batches,
        pilot_seconds=now() - start,
        terms=terms,
        norm2=dict(zip(names, found.norm2.tolist(), strict=True)),
        norm2_error=dict(zip(names, found.norm2_error.tolist(), strict=True)),
        seen=tuple(name for name, seen in zip(names, found.seen, strict=True) if seen),
        spread=_spread(found, cost, np.array([t.seconds_error for t in terms])),
        bias=bias.named(what),
        bias_squared=squared,
        measured=_measured(kept, list(what.blocks.values()), found, cost),
        tile=side,
        deviations=deviations,
    )
    if progress is not None:
        progress(1.0)
    return report


def _building(part: Part, now: Callable[[], float]) -> float:
    """Return the seconds of what is built once for many batches of a term."""
    begun = now()
    if part.prepare is None:
        return 0.0
    part.prepare()
    return now() - begun


def _sizes(what: Quantity, spp: int | None, seconds: float, now: Callable[[], float], seed: int) -> list[int]:
    """Return samples a pixel of the batches of each term."""
    if spp is not None:
        return [spp] * len(what.parts)
    sizes, fixed, marginal = [], [], []
    first, least = (FIRST_IMAGE_SPP, LEAST_IMAGE_SPP) if what.role == "primal" else (1, 1)
    for part in what.parts:
        few, many = (min(_timed(part.run, count, seed, now) for _ in range(2)) for count in FIRST_COUNTS)
        marginal.append(max((many - few) / (FIRST_COUNTS[1] - FIRST_COUNTS[0]), 1e-7))
        fixed.append(max(few - marginal[-1], 0.0))
        wanted = fixed[-1] / (FIXED_SHARE * marginal[-1])
        sizes.append(min(max(1 << max(math.ceil(math.log2(max(wanted, 1.0))), 0), first), MOST_SPP))

    def of_round() -> float:
        return sum(a + b * n for a, b, n in zip(fixed, marginal, sizes, strict=True))

    while of_round() * AIM_ROUNDS > seconds:
        # Halving what is mostly fixed cost would save the pilot little and cost what follows much.
        costs = [b * n if n > least and b * n > a else 0.0 for a, b, n in zip(fixed, marginal, sizes, strict=True)]
        if max(costs) == 0.0:
            break
        sizes[int(np.argmax(costs))] //= 2
    return sizes


def _timed(function: Callable[[int, int], object], spp: int, seed: int, now: Callable[[], float]) -> float:
    begun = now()
    function(spp, seed)
    return now() - begun


def _tiles(
    what: Quantity, spp: int, seed: int, seconds: float, now: Callable[[], float]
) -> tuple[int, tuple[float, ...]] | None:
    """Return the side of the tiles and their deviations; None: an even spread will do, or there is no time for it."""
    stream = mix_seed(seed, STREAM_TILES)
    once = _timed(what.parts[0].run, spp, stream, now)
    while spp > 1 and once * TILE_BATCHES > TILE_SHARE * seconds:
        spp, once = spp // 2, once / 2
    if once * TILE_BATCHES > TILE_SHARE * seconds:
        return None
    return measured(what, spp, [mix_seed(stream, 1 + b) for b in range(TILE_BATCHES)])


def _rounds(
    what: Quantity,
    sizes: list[int],
    seed: int,
    seconds: float,
    allowed: Callable[[Moments, np.ndarray], float],
    start: float,
    now: Callable[[], float],
    progress: Callable[[float], None] | None,
):
    """Run batches of all terms until enough is known, or the time that is allowed for it is over."""
    parts, blocks = what.parts, list(what.blocks.values())
    size = max(block.stop for block in blocks) * len(parts)
    most = max(min(MOST_ROUNDS, KEPT // size), 4)
    kept: list[list] = [[] for _ in parts]
    others: list[list] = [[] for _ in parts]
    times: list[list[float]] = [[] for _ in parts]
    other_times: list[list[float]] = [[] for _ in parts]
    sums = [Running(blocks) for _ in parts]  # their additions are part of what a batch costs
    streams = [mix_seed(seed, STREAM_BATCHES), mix_seed(seed, STREAM_OTHER)]
    next_look = 0.0
    while True:
        number = len(kept[0])
        for k, part in enumerate(parts):
            begun = now()
            raw = part.run(sizes[k], mix_seed(streams[0], number))
            batch = what.finished(raw)
            sums[k].add(raw, batch)
            times[k].append(now() - begun)
            kept[k].append(batch.astype(np.float32))
            if number % OTHER_EVERY == 1:
                begun = now()
                raw = part.run(other_size(sizes[k]), mix_seed(streams[1], number))
                batch = what.finished(raw)
                sums[k].add(raw, batch)
                other_times[k].append(now() - begun)
                if number < most // 2:
                    others[k].append(batch.astype(np.float32))
        number += 1
        spent = now() - start
        if progress is not None:
            progress(min(max(spent / seconds, number / MOST_ROUNDS), 0.99))
        over = number >= LEAST_ROUNDS and spent >= seconds
        # How much is known is looked at rarely: after powers of the square root of two, and after the time a while.
        if number < most and number not in LOOKS and not (over and spent >= next_look):
            continue
        next_look = LATER * spent
        found = moments(kept, blocks)
        cost = np.array([_typical(t)[0] for t in times])
        known = number in LOOKS and found.seen.all() and _spread(found, cost, np.zeros(len(parts))) <= CERTAIN
        if number >= most or known or (over and spent >= allowed(found, cost)):
            return kept, times, others, other_times, found


def other_size(spp: int) -> int:
    """Return the samples a pixel of the batches that tell the marginal cost and the exponent."""
    return LARGER * spp


def _term(
    what: Quantity,
    k: int,
    spp: int,
    setup: float,
    times: list[float],
    other_times: list[float],
    names: list[str],
    found: Moments,
    second: Moments | None,
    tiling: Tiling,
) -> TermReport:
    camera = what.scene.camera(what.sensor)
    pixels = camera.crop_width * camera.crop_height
    counts = [n * pixels for n in (spp, other_size(spp))]
    if k == 0:
        counts = [tiling.samples(n) for n in (spp, other_size(spp))]
    (seconds, seconds_error), (other, _error) = _typical(times), _typical(other_times)
    marginal = max((seconds - other) / (counts[0] - counts[1]), 0.0) if counts[0] != counts[1] else 0.0
    if marginal == 0.0 or marginal * counts[0] > seconds:
        marginal = seconds / max(counts[0], 1)
    exponent = error = math.nan
    if second is not None:
        exponent, error = _exponent(found, second, k, math.log(spp / other_size(spp)))
    return TermReport(
        name=what.parts[k].name,
        spp=spp,
        samples=counts[0],
        seconds=seconds,
        seconds_error=seconds_error,
        fixed_seconds=max(seconds - marginal * counts[0], 0.0),
        sample_seconds=marginal,
        setup_seconds=setup,
        variance=dict(zip(names, found.variance[k].tolist(), strict=True)),
        variance_error=dict(zip(names, found.variance_error[k].tolist(), strict=True)),
        exponent=exponent,
        exponent_error=error,
        largest=float(found.largest[k]),
        kurtosis=float(found.kurtosis[k]),
    )


def _exponent(found: Moments, second: Moments, k: int, log_ratio: float) -> tuple[float, float]:
    """Return the exponent of the variance's fall and its standard error (delta method on the two logarithms).

    Few batches of the other size say little of how uncertain they are: no less than the kurtosis of the many says.
    """
    values, errors = [], []
    excess = max(float(found.kurtosis[k]) - 1.0, 0.0)
    for m in (found, second):
        u = relative_variance(m.variance, found.norm2, found.seen)[k]
        without = relative_variance(m.variance_without, found.norm2, found.seen)[:, k]
        if u <= 0.0:
            return math.nan, math.nan
        values.append(math.log(u))
        errors.append(max(float(jackknife(without)) / u, math.sqrt(excess / m.batches)))
    return (values[1] - values[0]) / log_ratio, math.hypot(*errors) / abs(log_ratio)


def _typical(times: list[float]) -> tuple[float, float]:
    """Return the mean of times without the slowest tenth, which other work on the machine makes, and its error."""
    kept = np.sort(times)[: max(math.ceil(KEPT_TIMES * len(times)), 1)]
    return float(kept.mean()), float(kept.std() / math.sqrt(len(kept)))


def _spread(found: Moments, cost: np.ndarray, cost_error: np.ndarray) -> float:
    """Return the standard error of the logarithm of error^2 * time."""
    seen = found.seen
    if not seen.any():
        return math.inf
    u = relative_variance(found.variance, found.norm2, seen)
    without = relative_variance(found.variance_without, found.norm2_without, seen)
    best = float(efficiency(cost, u))
    if best <= 0.0:
        return 0.0
    statistical = float(jackknife(np.log(np.maximum(efficiency(cost, without), 1e-300))))
    # d log (sum sqrt(U C))^2 / dC_k = sqrt(U_k / C_k) / sum sqrt(U C).
    timing = np.sqrt(u / np.maximum(cost, 1e-300)) * cost_error / math.sqrt(best)
    return math.hypot(statistical, float(np.linalg.norm(timing)))


def _measured(kept: list[list], blocks: list[slice], found: Moments, cost: np.ndarray) -> tuple:
    """Return (seconds, relative error) of means of 1, 2, 4, ... batches a term, from the scatter of such means."""
    points, size = [], 1
    while len(kept[0]) // size >= 4:
        groups = len(kept[0]) // size
        means = [[np.mean(x[i * size : (i + 1) * size], axis=0) for i in range(groups)] for x in kept]
        u = relative_variance(moments(means, blocks).variance, found.norm2, found.seen).sum()
        points.append((float(size * cost.sum()), math.sqrt(u)))
        size *= 2
    return tuple(point for point in points if point[1] > 0.0)
