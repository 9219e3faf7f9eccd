"""Comparison of methods of the interior term on one derivative: the time that each takes to an accuracy."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.accuracy.pilot import CLOCKS, run, select
from warp_psdr.accuracy.report import DEVIATE, Report, positive
from warp_psdr.estimate.arguments import checked_seed
from warp_psdr.invalid import warns
from warp_psdr.options import interior
from warp_psdr.options.integrator import Integrator
from warp_psdr.plan.integrator import integrator_of
from warp_psdr.scene.description import Sensor

if TYPE_CHECKING:
    from warp_psdr.scene.parameters import Parameters
    from warp_psdr.scene.scene import Scene

#: What is compared if nothing is named: unbiased, of paths from the camera.
METHODS: tuple[interior.Method, ...] = (
    interior.Replay(),
    interior.Resampled(),
    interior.Antithetic(),
    interior.Attached(bsdf="attached", weights="attached"),
    interior.DifferentialRatioTracking(),
)
#: Relative error that times are told for.
ERROR = 0.01


@dataclass(frozen=True, kw_only=True)
class Compared:
    """A method.

    Attributes:
        method: the method.
        seconds: predicted, to a relative error of 1 %; NaN: refused, or there was nothing to compare.
        error: standard error of the logarithm of it.
        refused: why it cannot estimate the derivative; empty: it can.
    """

    method: interior.Method
    seconds: float = np.nan
    error: float = np.nan
    refused: str = ""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Methods on one derivative, the fastest first; ``str`` is a table."""

    rows: tuple[Compared, ...]

    @property
    def best(self) -> interior.Method:
        """The fastest method, for ``PathIntegrator(interior=...)``."""
        return self.rows[0].method

    def __str__(self) -> str:
        lines = [f"{'method':<44} seconds to 1 %"]
        for row in self.rows:
            time = "alone" if np.isnan(row.seconds) else f"{row.seconds:.3g} (x/ {np.exp(row.error):.2f})"
            lines.append(f"{row.method!s:<44} {row.refused.partition('. ')[0] if row.refused else time}")
        return "\n".join(lines)


@warns
def compare(
    scene: Scene,
    params: Parameters,
    adjoint=None,
    *,
    tangents: dict | None = None,
    methods: Sequence[interior.Method] | None = None,
    integrator: Integrator | None = None,
    sensor: Sensor = 0,
    seed: int = 0,
    seconds: float = 4.0,
    clock: str = "wall",
) -> Comparison:
    """Measure which method of the interior term takes the least time to an accuracy, by a pilot of each.

    The boundary term, which all of them share, is left out. Where one method alone can estimate the derivative there is
    no pilot. Kernels of every method are compiled.

    Args:
        scene: a loaded scene.
        params: its parameters; with an adjoint after ``requires_grad``.
        adjoint: derivative of a loss with respect to the image, as ``render_backward`` takes it.
        tangents: instead of an adjoint: as ``render_forward`` takes them.
        methods: of ``psdr.interior``; default: ``Replay()``, ``Resampled()``, ``Antithetic()``,
            ``Attached(...)``, ``DifferentialRatioTracking()``.
        integrator: as of ``render``; default: what the scene file names. Its own method of the interior is not used.
        sensor: which camera, by its number or its id; of a ``batch`` all its cameras; several in a list.
        seed: of the pilots.
        seconds: what the pilot of a method may take.
        clock: "wall", or "cpu" for the processor time of all threads.

    Returns:
        The methods, the fastest first, those that cannot estimate the derivative last, with the reason.

    Raises:
        ValueError: wrong arguments; no method can estimate the derivative; it does not stand out of the noise.
    """
    if clock not in CLOCKS:
        raise ValueError(f"clock: got {clock!r}, expected 'wall' or 'cpu'")
    if (adjoint is None) == (tangents is None):
        raise ValueError("compare takes an adjoint (of a gradient), or tangents (of a derivative image)")
    seed, seconds = checked_seed(seed), positive("seconds", seconds)
    base = dataclasses.replace(integrator_of(scene, integrator), boundary=None)
    views = scene.description.views(sensor)
    able, refused = {}, []
    for method in METHODS if methods is None else methods:
        chosen = dataclasses.replace(base, interior=method)
        try:
            able[method] = select(scene, params, adjoint, tangents, integrator=chosen, views=views)
        except ValueError as reason:
            if methods is None and isinstance(method, interior.Replay):
                raise  # what replay does not do is no question of the method
            refused.append(Compared(method=method, refused=str(reason)))
    if not able:
        raise ValueError(f"no method can estimate this: {'; '.join(row.refused for row in refused)}")
    if len(able) == 1:
        return Comparison(rows=(Compared(method=next(iter(able))), *refused))
    reports = {
        method: run(what, spp=None, seed=seed, seconds=seconds, tiles=False, clock=clock)
        for method, what in able.items()
    }
    rows = ranked(reports)
    return Comparison(rows=(*rows, *refused))


def ranked(reports: dict[interior.Method, Report]) -> list[Compared]:
    """Return the methods of reports, the fastest first.

    All share one norm of the derivative, the mean of their estimates: they tell it with noise, which would count twice.
    """
    blocks = sorted(set.intersection(*(set(report.seen) for report in reports.values())))
    if not blocks:
        raise ValueError("no part of the derivative stands out of the noise of every method; raise seconds")
    norm2 = {block: float(np.mean([report.norm2[block] for report in reports.values()])) for block in blocks}
    rows = []
    for method, report in reports.items():
        shared = dataclasses.replace(report, norm2=report.norm2 | norm2, seen=tuple(blocks))
        low, high = shared.seconds_interval(ERROR)
        rows.append(Compared(method=method, seconds=shared.seconds_to(ERROR), error=np.log(high / low) / (2 * DEVIATE)))
    return sorted(rows, key=lambda row: row.seconds)
