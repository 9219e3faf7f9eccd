"""The report of a pilot and its predictions: the time to an error, the error in a time, the best split.

Predictions rest on batches (``quantity.py``), runs of the size that the pilot chose and that a budget spends. Errors
are relative: for gradients the root mean square over the requested parameters of |error of the gradient| / |gradient|;
for images and derivative images the norm of the error over that of the image. A prediction is for the mean of
independent batches, whose squared error falls exactly as one over their number. ``TermReport.exponent`` says whether
more samples in one batch do better than more batches (stratified samples: above 1).
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np

from warp_psdr import html
from warp_psdr.accuracy.allocation import (
    LEAST,
    LEAST_IN_TIME,
    Allocation,
    batches_for_error,
    batches_for_time,
    ideal,
)
from warp_psdr.files import write_atomic

FORMAT, VERSION = "warp_psdr accuracy", 3
#: Errors of the printed predictions.
PRINTED_ERRORS = (0.5, 0.2, 0.1, 0.05, 0.02, 0.01)
#: Parameters that are printed one by one; the rest is in the object.
PRINTED_BLOCKS = 8
#: Exponents are measured with noise; those of stratified samples lie between these (3: smooth functions of one variable
#: are integrated, as along an edge). Sizes of batches are chosen by them, which prefers those that are too large by
#: chance: their errors count so many times.
LEAST_EXPONENT, MOST_EXPONENT, CHOSEN = 0.9, 3.0, 1.5
#: Where more batches of a term than enough would be run, they are made larger: their fixed cost is saved, and
#: stratified samples are better together. For an error, enough tell their variance within this relative error, and are
#: between these numbers; for a time, none has to. What is saved buys larger batches again, a few times.
TOLD_WITHIN, FEWEST_FOR_ERROR, MOST_FOR_ERROR, ENOUGH_FOR_TIME, REFITS = 0.2, 12.0, 64.0, 1.0, 4
#: How many times larger than the pilot's they become at most. For an error, as far as the pilot has measured, since a
#: predicted time rests on it; for a time, which is spent whatever is predicted, more.
LARGEST_FOR_ERROR, LARGEST_FOR_TIME = 4.0, 64.0
#: Sizes of batches that are tried, over those of which ``least`` would be asked for without fixed costs; and what a
#: time may be short by from rounding.
SIZES, ROUNDING = (math.inf, *(2.0 ** (0.5 * k) for k in range(8, -9, -1))), 1e-9
#: Kurtosis from which tails are heavy: that of one normal component is 3, and estimates of it exceed 5 in some 15 of
#: 1000 pilots. Share of the variance from which one batch stands out, and among how many: 4 in 100 pilots, of one
#: normal component. The least share of the time of a term of which either is said.
HEAVY, STANDS_OUT, LEAST_STANDING, WORTH_SAYING = 5.0, 0.35, 24, 0.05
#: Normal deviate of the two ends of 95 % intervals.
DEVIATE = 1.96


@dataclass(frozen=True, kw_only=True)
class TermReport:
    """A term.

    Attributes:
        name: what it is called.
        spp: samples a pixel of a batch.
        samples: samples of a batch.
        seconds: of a batch.
        seconds_error: standard error of it.
        fixed_seconds: part of it that does not grow with the samples.
        sample_seconds: the rest, a sample.
        setup_seconds: once, for what many batches share (guiding), unless it had been built; compiling is not in it.
        variance: block -> variance of a batch, the sum over the block's components.
        variance_error: standard errors of it.
        exponent: a, for a variance that falls as samples^-a; NaN: not measured.
        exponent_error: standard error of it.
        largest: share of one batch in the variance, see ``statistics.Moments``.
        kurtosis: of the batches, see there.
    """

    name: str
    spp: int
    samples: int
    seconds: float
    seconds_error: float
    fixed_seconds: float
    sample_seconds: float
    setup_seconds: float
    variance: dict[str, float]
    variance_error: dict[str, float]
    exponent: float
    exponent_error: float
    largest: float
    kurtosis: float

    @property
    def telling(self) -> float:
        """Batches that tell their variance well enough to stop by: n of them with the squared error (kurtosis - 1) / n.

        One component needs many, many components few, rare large samples more than either.
        """
        return min(max((self.kurtosis - 1.0) / TOLD_WITHIN**2, FEWEST_FOR_ERROR), MOST_FOR_ERROR)


@dataclass(frozen=True, kw_only=True)
class Report:
    """What accuracy costs.

    Attributes:
        role: "primal", "forward" or "reverse".
        clock: "wall", or "cpu": processor time of all threads.
        batches: of each term, from which variances were estimated.
        pilot_seconds: what the pilot took, without compiling.
        terms: the terms.
        norm2: block -> estimate of the squared norm of the gradient (or the image), without the noise's share.
        norm2_error: standard errors of it.
        seen: blocks whose gradient stands out of the pilot's noise; errors are relative to these.
        spread: standard error of the logarithm of a predicted time, of batches as large as the pilot's.
        bias: what the estimators leave out by design, in words; empty: nothing.
        bias_squared: squared relative bias and its standard error, where it could be measured (``bias.py``). Predicted
            errors are those about what the method converges to; this comes on top.
        measured: (seconds, relative error) of means of ever more of the pilot's batches.
        tile: side of the tiles, pixels; 0: samples are spread evenly.
        deviations: of the tiles, up to a common factor (``tiles.py``).
    """

    role: str
    clock: str
    batches: int
    pilot_seconds: float
    terms: tuple[TermReport, ...]
    norm2: dict[str, float]
    norm2_error: dict[str, float]
    seen: tuple[str, ...]
    spread: float
    bias: tuple[str, ...] = ()
    bias_squared: tuple[float, float] | None = None
    measured: tuple[tuple[float, float], ...] = ()
    tile: int = 0
    deviations: tuple[float, ...] = field(default=(), repr=False)

    @property
    def cost(self) -> np.ndarray:
        """(terms,): seconds of a batch."""
        return np.array([t.seconds for t in self.terms])

    @property
    def relative_variance(self) -> np.ndarray:
        """(terms,): squared relative error that a batch of each contributes."""
        return np.array([np.mean([t.variance[b] / self.norm2[b] for b in self.seen]) for t in self.terms])

    @property
    def time_share(self) -> np.ndarray:
        """(terms,): shares of the time of the best split."""
        root = np.sqrt(self.cost * self.relative_variance)
        return root / max(float(root.sum()), 1e-300)

    @property
    def heavy_tailed(self) -> tuple[str, ...]:
        """Terms that matter and whose variance is that of rare large samples, as far as the pilot has met any.

        Predictions of these are uncertain beyond their intervals, since another pilot may meet more, or none.
        """
        return tuple(
            t.name
            for t, share in zip(self.terms, self.time_share, strict=True)
            if share >= WORTH_SAYING
            and (t.kurtosis > HEAVY or (t.largest > STANDS_OUT and self.batches >= LEAST_STANDING))
        )

    def fitted(self, *, error: float | None = None, seconds: float | None = None) -> Report:
        """Return a report of batches of the sizes that suit an error or a time.

        They are smaller where the least number of a term is more than is asked for, and larger where that is more than
        enough. The variance of a batch that the pilot did not run follows from the exponent. Small batches waste
        what is fixed in their cost, and stratified ones are worse than their size says: how far they shrink is what is
        best.
        """
        least, largest = (LEAST, LARGEST_FOR_ERROR) if error is not None else (LEAST_IN_TIME, LARGEST_FOR_TIME)
        report = self
        for _ in range(REFITS):
            most = np.array([largest * a.spp / b.spp for a, b in zip(self.terms, report.terms, strict=True)])
            before, report = report, report._resized(most, error, seconds, least)
            if [t.spp for t in report.terms] == [t.spp for t in before.terms]:
                break
        return report

    def _resized(self, largest: np.ndarray, error: float | None, seconds: float | None, least: float) -> Report:
        """Return a report of batches of other sizes, at most so many times larger."""
        numbers = ideal(self.cost, self.relative_variance)
        if error is not None:
            wanted = numbers * float((self.relative_variance / np.maximum(numbers, 1e-300)).sum()) / error**2
            enough = np.array([t.telling for t in self.terms])
        else:
            wanted = numbers * (seconds or 0.0) / max(float(numbers @ self.cost), 1e-300)
            enough = np.full(len(numbers), ENOUGH_FOR_TIME)
        shrink, most = np.maximum(wanted / least, 1e-300), np.clip(wanted / enough, 1.0, np.maximum(largest, 1.0))
        if error is None:
            # A whole number of batches fills the time: two of 0.9 times the size instead of one, where 1.8 would.
            numbers = np.maximum(wanted / most, 1.0)
            most *= numbers / np.ceil(numbers - ROUNDING)
        if (shrink >= 1.0).all() and (np.abs(most - 1.0) <= ROUNDING).all():
            return self
        sizes = (np.minimum(factor * shrink, most).tolist() for factor in SIZES)
        reports = [replace(self, terms=tuple(map(_resized, self.terms, size))) for size in sizes]
        return min(reports, key=lambda report: report._price(error, seconds, least))

    def _price(self, error: float | None, seconds: float | None, least: float) -> tuple[float, float]:
        """Return what is to be small: the time to an error, or what a time is too short by and the error in it."""
        if error is not None:
            return float(batches_for_error(self.cost, self.relative_variance, error, least) @ self.cost), 0.0
        batches = batches_for_time(self.cost, self.relative_variance, seconds or 0.0, least)
        missing = max(float(batches @ self.cost) / max(seconds or 0.0, 1e-300) - 1.0, 0.0)
        return (missing if missing > ROUNDING else 0.0), float((self.relative_variance / batches).sum())

    def allocation(self, *, error: float | None = None, seconds: float | None = None) -> Allocation:
        """Return the best split for a relative error or for a time.

        Raises:
            ValueError: both or neither are given, or they are not positive.
        """
        if (error is None) == (seconds is None):
            raise ValueError("allocation takes one of error=... and seconds=...")
        if error is not None:
            fitted, found = self._split(error)
            numbers = np.ceil(found)
        else:
            fitted = self.fitted(seconds=positive("seconds", seconds))
            found = batches_for_time(fitted.cost, fitted.relative_variance, float(seconds or 0.0), LEAST_IN_TIME)
            numbers = np.floor(found)
        counts = {t.name: int(n) for t, n in zip(self.terms, numbers, strict=True)}
        spp = {t.name: t.spp * counts[t.name] for t in fitted.terms}
        reached = math.sqrt(float((fitted.relative_variance / found).sum()))
        return Allocation(counts, spp, float(found @ fitted.cost), reached)

    def _split(self, error: float) -> tuple[Report, np.ndarray]:
        """Return a report of the batches that suit an error, and their numbers, not rounded.

        The run is as long as one is that stops by variances which are as uncertain as the pilot's (``budget.py``).
        """
        safe = positive("error", error) / math.sqrt(1.0 + self.spread**2)
        fitted = self.fitted(error=safe)
        return fitted, batches_for_error(fitted.cost, fitted.relative_variance, safe)

    def seconds_to(self, error: float) -> float:
        """Return the predicted time to a relative error, seconds; setup and pilot are not in it."""
        return self.allocation(error=error).seconds

    def error_in(self, seconds: float) -> float:
        """Return the predicted relative error after a time; infinite where it is too short for the least batches.

        That can be less than the error whose ``seconds_to`` this is, by what larger batches save (``fitted``).
        """
        found = self.allocation(seconds=seconds)
        return found.error if found.seconds <= seconds * (1.0 + 1e-9) else math.inf

    def seconds_interval(self, error: float) -> tuple[float, float]:
        """Return the ends of a 95 % interval of ``seconds_to``."""
        fitted, batches = self._split(error)
        ratios = np.array([a.spp / b.spp for a, b in zip(fitted.terms, self.terms, strict=True)])
        exponents = np.array([counted_exponent(t.exponent, t.exponent_error)[1] for t in self.terms])
        drift = float(np.linalg.norm(fitted.time_share * exponents * np.log(ratios)))
        seconds, factor = float(batches @ fitted.cost), math.exp(DEVIATE * math.hypot(self.spread, drift))
        return seconds / factor, seconds * factor

    def __str__(self) -> str:
        """Return the tables."""
        what = {"primal": "image", "forward": "derivative image", "reverse": "gradient"}[self.role]
        lines = [
            f"Accuracy of the {what}: {self.batches} batches a term in {self.pilot_seconds:.2f} s "
            f"({'processor' if self.clock == 'cpu' else 'wall'} time)"
        ]
        rows: list[tuple[str, ...]] = [
            (
                "term",
                "spp",
                "s fixed",
                "s/sample",
                "s setup",
                "error of a batch",
                "falls as",
                "kurtosis",
                "share of time",
            )
        ]
        for term, u, share in zip(self.terms, self.relative_variance, self.time_share, strict=True):
            falls = "-" if math.isnan(term.exponent) else f"n^-{term.exponent:.2f} ± {term.exponent_error:.2f}"
            row: tuple[str, ...] = (term.name, str(term.spp), f"{term.fixed_seconds:.2g}", f"{term.sample_seconds:.2g}")
            row += (f"{term.setup_seconds:.2g}" if term.setup_seconds else "-", f"{math.sqrt(u):.3g}", falls)
            rows.append((*row, f"{term.kurtosis:.1f}" if u > 0.0 else "-", f"{100.0 * share:.0f} %"))
        lines += ["", *html.aligned(rows)]
        rows = [("parameter", "norm", *(t.name for t in self.terms))]
        for block in list(self.norm2)[:PRINTED_BLOCKS]:
            norm2 = self.norm2[block]
            if block not in self.seen:
                rows.append((block, "lost in noise", *("-" for _ in self.terms)))
                continue
            half = DEVIATE * self.norm2_error[block] / (2.0 * math.sqrt(norm2))
            rows.append((block, f"{math.sqrt(norm2):.3g} ± {half:.1g}", *(_error(t, block, norm2) for t in self.terms)))
        lines += ["", "Relative error of a batch, a parameter and a term (95 % intervals):", *html.aligned(rows)]
        if len(self.norm2) > PRINTED_BLOCKS:
            lines.append(f"... and {len(self.norm2) - PRINTED_BLOCKS} more parameters")
        rows = [("relative error", "seconds", "95 % interval", *(f"spp, {t.name}" for t in self.terms))]
        for error in PRINTED_ERRORS:
            found = self.allocation(error=error)
            low, high = self.seconds_interval(error)
            cells = (f"{error:g}", f"{found.seconds:.3g}", f"{low:.3g} .. {high:.3g}")
            rows.append((*cells, *(str(n) for n in found.spp.values())))
        lines += ["", "Predicted:", *html.aligned(rows)]
        if self.tile:
            by = "the adjoint and, in" if self.role == "reverse" else "their variance in"
            of = ", their variance" if self.role == "reverse" else ""
            lines.append(f"Samples are spread over pixels by {by} tiles of {self.tile} x {self.tile} pixels{of}.")
        heavy = self.heavy_tailed
        for term in (t for t in self.terms if t.name in heavy):
            text = f"one batch in {self.batches} carries {100.0 * term.largest:.0f} % of the variance of {term.name!r}"
            lines.append(
                f"Rare large samples: {text}, kurtosis {term.kurtosis:.1f} (3: normal); predictions are unreliable, a "
                "longer pilot may help."
            )
        lines += ["", *(f"Bias: {text}" for text in self.bias or ("none by design",))]
        if self.bias_squared is not None:
            lines.append(f"Bias, measured: {_bias(*self.bias_squared)}; predicted errors do not hold it")
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the tables."""
        return html.preformatted(str(self))

    def plot(self, path: str | os.PathLike | None = None) -> Any:
        """Draw the error against the time: the prediction with its 95 % interval, and the pilot's measured points.

        Args:
            path: file to write; its suffix names the format. None: the figure is only returned.

        Returns:
            The ``matplotlib.figure.Figure``.
        """
        from matplotlib.figure import Figure

        figure = Figure(figsize=(6.6, 5.0), layout="constrained")
        axes = figure.add_subplot()
        least = float(2.0 * self.cost.sum())
        times = np.geomspace(least, 1e3 * least, 60)
        errors = np.array([self.error_in(float(t)) for t in times])
        factor = math.exp(0.5 * DEVIATE * self.spread)  # error ~ time^-1/2
        axes.plot(times, errors, label="predicted, best split")
        axes.fill_between(times, errors / factor, errors * factor, alpha=0.2, linewidth=0.0)
        if self.bias_squared is not None and self.bias_squared[0] > DEVIATE * self.bias_squared[1]:
            floor = math.sqrt(self.bias_squared[0])
            axes.axhline(floor, color="firebrick", linewidth=1.0, linestyle="--", label="bias, measured")
            axes.plot(times, np.hypot(errors, floor), color="firebrick", linewidth=1.0, label="with the bias")
        if self.measured:
            points = np.array(self.measured)
            axes.plot(points[:, 0], points[:, 1], "o", markersize=4, label="pilot, equal numbers of batches")
        axes.set(xscale="log", yscale="log", xlabel=f"{self.clock} time [s]", ylabel="relative error")
        axes.grid(True, which="both", alpha=0.25)
        axes.legend(fontsize=8)
        if path is not None:
            figure.savefig(path, dpi=100)
        return figure

    def save(self, path: str | os.PathLike) -> None:
        """Write the report as JSON."""
        text = json.dumps({"format": FORMAT, "version": VERSION, **_plain(asdict(self))}, indent=1)
        write_atomic(path, lambda file: file.write(text.encode()))

    @classmethod
    def load(cls, path: str | os.PathLike) -> Report:
        """Read what ``save`` wrote.

        Raises:
            ValueError: the file is none of these.
        """
        with open(path, encoding="utf-8") as file:
            data = json.load(file)
        if not isinstance(data, dict) or data.get("format") != FORMAT or data.get("version") != VERSION:
            raise ValueError(f"{path}: expected what Report.save wrote in this version of warp_psdr")
        terms = tuple(TermReport(**_restored(term)) for term in data["terms"])
        known = {f.name for f in fields(cls)} - {"terms", "measured", "seen", "bias", "bias_squared", "deviations"}
        return cls(
            terms=terms,
            measured=tuple((a, b) for a, b in data["measured"]),
            seen=tuple(data["seen"]),
            bias=tuple(data["bias"]),
            bias_squared=None if data["bias_squared"] is None else tuple(data["bias_squared"]),
            deviations=tuple(data["deviations"]),
            **{name: data[name] for name in known},
        )


def positive(name: str, value: Any) -> float:
    """Return a positive finite number.

    Raises:
        ValueError: it is none.
    """
    number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    if not number or not math.isfinite(value) or value <= 0.0:
        raise ValueError(f"{name}: got {value!r}, expected a positive number")
    return float(value)


def counted_exponent(exponent: float, error: float) -> tuple[float, float]:
    """Return the exponent that counts, by how certain the measured one is, and its error: positive part of Stein's."""
    exponent = 1.0 if math.isnan(exponent) else min(max(exponent, LEAST_EXPONENT), MOST_EXPONENT)
    if exponent == 1.0:
        return 1.0, 0.0
    share = max(1.0 - (CHOSEN * error / (exponent - 1.0)) ** 2, 0.0)
    return 1.0 + (exponent - 1.0) * share, error * share


def _resized(term: TermReport, share: float) -> TermReport:
    """Return a term with a multiple of its samples a batch, at least one a pixel."""
    spp = max(round(share * term.spp), 1)
    ratio = spp / term.spp
    exponent, _error = counted_exponent(term.exponent, term.exponent_error)
    samples = round(ratio * term.samples)
    return replace(
        term,
        spp=spp,
        samples=samples,
        seconds=term.fixed_seconds + samples * term.sample_seconds,
        variance={name: value / ratio**exponent for name, value in term.variance.items()},
    )


def _error(term: TermReport, block: str, norm2: float) -> str:
    error = math.sqrt(term.variance[block] / norm2)
    if error == 0.0:
        return "0"
    half = 0.5 * DEVIATE * term.variance_error[block] / math.sqrt(term.variance[block] * norm2)
    return f"{error:.3g} ± {half:.1g}"


def _bias(squared: float, error: float) -> str:
    """Return a relative bias, or what it is below of with two standard errors."""
    if squared > DEVIATE * error:
        root = math.sqrt(squared)
        return f"{root:.2g} ± {DEVIATE * error / (2.0 * root):.1g} of the norm"
    return f"below {math.sqrt(max(squared, 0.0) + DEVIATE * error):.1g} of the norm"


def _plain(value: Any) -> Any:
    """Return what JSON can express: no NaN."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def _restored(term: dict[str, Any]) -> dict[str, Any]:
    return {name: math.nan if value is None else value for name, value in term.items()}
