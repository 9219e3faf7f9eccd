"""The pilot: a short run that measures what a batch of every term costs and how uncertain it is.

Every term runs once untimed, then twice to separate fixed from marginal cost. Rounds of one batch of every term follow
until the prediction is certain or the pilot's time is over. The result depends on the clock, not on the seed alone.

Derivation: ``docs/theory/accuracy.md#the-pilot``.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.accuracy import bias, quantity
from warp_psdr.accuracy.allocation import efficiency
from warp_psdr.accuracy.quantity import Part, Quantity
from warp_psdr.accuracy.report import Report, TermReport, positive
from warp_psdr.accuracy.rounds import AIM_ROUNDS, LARGER, Known, Rounds, typical
from warp_psdr.accuracy.statistics import Moments, moments, relative_variance
from warp_psdr.accuracy.tiles import BATCHES as TILE_BATCHES
from warp_psdr.accuracy.tiles import Tiling, measured, spread, uniform
from warp_psdr.accuracy.views import gradient, together
from warp_psdr.estimate.arguments import checked_seed, samples
from warp_psdr.invalid import warns
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.options.integrator import Integrator
from warp_psdr.plan.integrator import integrator_of
from warp_psdr.scene.description import Sensor
from warp_psdr.scene.loaded import check_loaded

if TYPE_CHECKING:
    from warp_psdr.scene.description import Views
    from warp_psdr.scene.parameters import Parameters
    from warp_psdr.scene.scene import Scene

CLOCKS: dict[str, Callable[[], float]] = {"wall": time.perf_counter, "cpu": time.process_time}
#: Seed streams: of the pilot's tilings, batches, batches of the other size, first runs, the bias, and first rounds.
STREAM_PILOT, STREAM_TILES, STREAM_BATCHES, STREAM_OTHER, STREAM_WARM, STREAM_BIAS = 0x70696C6F, 0, 1, 2, 3, 4
STREAM_FIRST = 5
#: Share of a batch's time that is the fixed cost's.
FIXED_SHARE = 0.1
#: Samples a pixel of a batch, at most; of an image, whose samples are stratified within a pixel, at first and at least;
#: and of a term that matters, as far as the time allows it: fewer could only become more by leaps.
MOST_SPP, FIRST_IMAGE_SPP, LEAST_IMAGE_SPP, LEAST_SPP = 256, 16, 4, 4
#: Share of the pilot's time up to which a first timing is repeated, or followed by one of more samples.
AGAIN = 0.02
#: Rounds that say which terms matter, the share of the pilot's time that they may take, and the least time of a term as
#: a share of a round: what has not been met yet is not known to be small.
FIRST_ROUNDS, FIRST_SHARE, LEAST_SHARE = 6, 0.25, 0.03
#: Standard error of the logarithm of a predicted time at which a pilot goes on for so many times its time, as it does
#: where nothing stands out of the noise. (A budget's own pilot has less patience with what is only uncertain.)
UNCERTAIN, PATIENCE = 0.15, 4.0
#: Share of a time budget, and of the predicted time to an error, that its own pilot may take.
SHARE = 0.2
#: Share of the pilot's time that tilings may take, and that all which comes before its rounds counts as at most.
TILE_SHARE, FIRST_MOST = 0.25, 0.5


@warns
def accuracy(
    scene: Scene,
    params: Parameters | None = None,
    adjoint=None,
    *,
    tangents: dict | None = None,
    integrator: Integrator | None = None,
    sensor: Sensor = 0,
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
        integrator: as of ``render``; default: what the scene file names. Sample counts of its boundary method are not
            used.
        sensor: which camera, by its number or its id; of a ``batch`` all its cameras; several in a list. Samples of
            several are spread evenly over their images.
        spp: samples a pixel of a batch, of every term; default: chosen by the costs.
        seed: of the pilot.
        seconds: what the pilot may take; more where four batches a term need it, and up to four times as much where
            nothing stands out of the noise yet, or the standard error of a predicted time is above 15 %.
        tiles: spread samples over the image by its variance, and by the adjoint of every pixel, where that pays.
        clock: "wall", or "cpu" for the processor time of all threads, which other work on the machine changes less.
        progress: called with the finished fraction.

    Returns:
        The report; ``print`` it, ask it for ``seconds_to(error)``, or pass it to ``render(..., report=report)``.

    Raises:
        ValueError: wrong arguments; what the methods do not cover; or the gradient does not stand out of the noise.
    """
    check_loaded(scene)
    if clock not in CLOCKS:
        raise ValueError(f"clock: got {clock!r}, expected 'wall' or 'cpu'")
    if adjoint is not None and tangents is not None:
        raise ValueError("accuracy takes an adjoint (of a gradient) or tangents (of a derivative image), not both")
    integrator = integrator_of(scene, integrator)
    views = scene.description.views(sensor)
    what = select(scene, params, adjoint, tangents, integrator=integrator, views=views)
    other = bias.unbiased(integrator, what)
    twin = None if other is None else select(scene, params, adjoint, tangents, integrator=other, views=views)
    seed, seconds = checked_seed(seed), positive("seconds", seconds)
    spp = None if spp is None else samples("spp", spp)
    return run(
        what, spp=spp, seed=seed, seconds=seconds, tiles=tiles, clock=clock, setup=True, twin=twin, progress=progress
    )


def select(scene: Scene, params, adjoint, tangents, *, integrator, views: Views) -> Quantity:
    """Return what is to be estimated.

    Raises:
        ValueError: parameters are missing.
    """
    if adjoint is None and tangents is None:
        return together(views, lambda n: quantity.image(scene, integrator=integrator, sensor=n))
    if params is None:
        raise ValueError("params: needed with an adjoint or tangents; params = psdr.traverse(scene)")
    if tangents is not None:
        return together(views, lambda n: quantity.derivative(scene, params, tangents, integrator=integrator, sensor=n))
    return gradient(scene, views, params, adjoint, integrator=integrator)


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
    sizes, least = ([spp] * len(what.parts), []) if spp is not None else _sizes(what, seconds, now, warm)
    found_tiles = _tiles(what, sizes[0], seed, seconds, now) if tiles and not what.each else None
    side, deviations = found_tiles or (0, ())
    tilings = [spread(what, side, deviations) if side else uniform(q) for q in what.each or (what,)]
    what = what if what.each else what.tiled(tilings[0])
    if spp is None:
        sizes = _balanced(what, sizes, least, mix_seed(seed, STREAM_FIRST), seconds, now)

    def allowed(known: Known) -> float:
        found = known.found
        if not found.seen.any():
            return PATIENCE * seconds
        if error is not None:
            relative = relative_variance(found.variance, found.norm2, found.seen)
            return max(seconds, SHARE * float(efficiency(known.cost, relative)) / error**2)
        return seconds if known.spread(LARGER) <= UNCERTAIN else patience * seconds

    rounds = Rounds(what, sizes, (mix_seed(seed, STREAM_BATCHES), mix_seed(seed, STREAM_OTHER)), now)
    known = rounds.run(seconds, allowed, max(start, now() - FIRST_MOST * seconds), progress)
    found = known.found
    if not found.seen.any():
        raise ValueError(
            f"the {'gradient' if what.role == 'reverse' else 'image'} does not stand out of the noise of "
            f"{found.batches} batches: it is zero, or needs a longer pilot (seconds=...), or a method that samples it "
            "better"
        )
    names = list(what.blocks)
    terms = tuple(
        _term(what, k, sizes[k], building[k], rounds.times[1][k], known, names, tilings) for k in range(len(what.parts))
    )
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
        spread=known.spread(),
        bias=bias.named(what),
        bias_squared=squared,
        measured=_measured(rounds.kept[0], list(what.blocks.values()), found, known.cost),
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


def _sizes(what: Quantity, seconds: float, now: Callable[[], float], seed: int) -> tuple[list[int], list[int]]:
    """Return samples a pixel of the batches of each term, and those whose time is as long as what is fixed in it."""
    sizes, fixed, marginal = [], [], []
    first, least = (FIRST_IMAGE_SPP, LEAST_IMAGE_SPP) if what.role == "primal" else (1, 1)
    for part in what.parts:
        (count, few), (larger, many) = _first_timings(part, seed, seconds, now)
        marginal.append(max((many - few) / (larger - count), 1e-7))
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
    return sizes, [max(math.ceil(a / b), LEAST_SPP) for a, b in zip(fixed, marginal, strict=True)]


def _first_timings(
    part: Part, seed: int, seconds: float, now: Callable[[], float]
) -> tuple[tuple[int, float], tuple[int, float]]:
    """Return two sample counts and their times, which differ by enough that noise matters little, if that is cheap."""

    def timed(spp: int) -> tuple[int, float]:
        once = _timed(part.run, spp, seed, now)
        return spp, once if once > AGAIN * seconds else min(once, _timed(part.run, spp, seed, now))

    first, second = timed(1), timed(4)
    while second[0] < MOST_SPP and second[1] < min(1.5 * first[1], AGAIN * seconds):
        second = timed(4 * second[0])
    return first, second


def _balanced(
    what: Quantity, sizes: list[int], least: list[int], seed: int, seconds: float, now: Callable[[], float]
) -> list[int]:
    """Return smaller sizes for the batches of terms that the best split gives less time than a round does, or may.

    ``least``: of terms that matter, since smaller ones would waste what is fixed in their time.
    """
    times: list[list[float]] = [[] for _ in sizes]
    batches: list[list] = [[] for _ in sizes]
    start = now()
    for number in range(FIRST_ROUNDS):
        share = (now() - start) / (FIRST_SHARE * seconds)
        if number == 1 and share > 0.5:
            return sizes
        if number >= 2 and share > 1.0:
            break
        for k, part in enumerate(what.parts):
            begun = now()
            batches[k].append(what.finished(part.run(sizes[k], mix_seed(seed, number))))
            times[k].append(now() - begun)
    found, cost = moments(batches, list(what.blocks.values())), np.min(times, axis=1)
    # What matters of a block that does not stand out of the noise yet is not known, nor is its norm.
    norm2 = np.maximum(found.norm2, found.variance.sum(axis=0))
    if not norm2.any():
        return sizes
    root = np.sqrt(cost * relative_variance(found.variance, norm2, norm2 > 0.0))
    share = root / root.sum()
    wanted = min(float(cost.sum()), seconds / AIM_ROUNDS)
    smaller = np.minimum(np.maximum(share, LEAST_SHARE) * wanted / cost, 1.0)
    floor = np.where(share > LEAST_SHARE, least, 1)
    return [max(math.ceil(f * n), min(n, int(few))) for f, n, few in zip(smaller, sizes, floor, strict=True)]


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


def _term(
    what: Quantity,
    k: int,
    spp: int,
    setup: float,
    other_times: list[float],
    known: Known,
    names: list[str],
    tilings: list[Tiling],
) -> TermReport:
    found = known.found
    cameras = [what.scene.camera(q.sensor) for q in what.each or (what,)]
    pixels = sum(camera.crop_width * camera.crop_height for camera in cameras)
    counts = [n * pixels for n in (spp, LARGER * spp)]
    if k == 0:
        counts = [sum(tiling.samples(n) for tiling in tilings) for n in (spp, LARGER * spp)]
    seconds, (other, _error) = float(known.cost[k]), typical(other_times)
    marginal = max((seconds - other) / (counts[0] - counts[1]), 0.0) if counts[0] != counts[1] else 0.0
    if marginal == 0.0 or marginal * counts[0] > seconds:
        marginal = seconds / max(counts[0], 1)
    return TermReport(
        name=what.parts[k].name,
        spp=spp,
        samples=counts[0],
        seconds=seconds,
        seconds_error=float(known.cost_error[k]),
        fixed_seconds=max(seconds - marginal * counts[0], 0.0),
        sample_seconds=marginal,
        setup_seconds=setup,
        variance=dict(zip(names, found.variance[k].tolist(), strict=True)),
        variance_error=dict(zip(names, found.variance_error[k].tolist(), strict=True)),
        exponent=known.exponents[k][0],
        exponent_error=known.exponents[k][1],
        largest=float(found.largest[k]),
        kurtosis=float(found.kurtosis[k]),
    )


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
