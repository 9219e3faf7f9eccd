"""What ``psdr.certify`` returns: a verdict on every parameter's gradient, and the comparisons behind it."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from warp_psdr import html
from warp_psdr.certify.statistics import Slope
from warp_psdr.files import write_atomic

FORMAT, VERSION = "warp_psdr certificate", 1
#: Verdicts.
WITHIN, BIASED, UNDECIDED, NOT_SEEN = "within", "biased", "undecided", "not seen"

#: Of the page.
STYLE = "body{font:14px sans-serif;margin:2em} td,th{padding:2px 10px} tr:nth-child(even){background:#eee}"


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One comparison.

    Attributes:
        check: "slope", "estimators", ...
        parameter: name of the parameter.
        what: the direction, or the methods.
        verdict: "within", "biased", "undecided" or "not seen".
        slope: of the derivative against the other side; None: there is none.
        p_value: of "the slope is 1 within the tolerance", adjusted for all comparisons of the certificate.
        batches: of both sides.
        seconds: that would decide it, about; infinite: no time would; NaN: it is decided.
        leans: whether the slope is away from 1 beyond the tolerance with a p-value of .05 by itself.
        note: what else is known.
    """

    check: str
    parameter: str
    what: str
    verdict: str
    slope: Slope | None
    p_value: float
    batches: tuple[int, int]
    seconds: float = math.nan
    leans: bool = False
    note: str = ""

    def cells(self) -> tuple[str, ...]:
        """Return the table's cells."""
        s = self.slope
        value = "" if s is None else f"{s.value:.4f} ± {s.error:.4f}"
        interval = "" if s is None else f"{s.low:.4f} … {s.high:.4f}"
        note = self.note
        if self.verdict == UNDECIDED and not note:
            note = _needed(self.seconds)
        return self.parameter, self.check, self.what, value, interval, f"{self.p_value:.2g}", self.verdict, note


@dataclass(frozen=True)
class OfParameter:
    """The comparisons of one parameter.

    Attributes:
        name: of the parameter.
        findings: its comparisons.
    """

    name: str
    findings: tuple[Finding, ...]

    @property
    def verdict(self) -> str:
        """The verdict on the gradient.

        "biased": a comparison says so. "within": one against differences (of none, one against another method) says
        so, and no other leans away from 1. "not seen": nothing depends on the parameter. Else "undecided".
        """
        found = {f.verdict for f in self.findings}
        if BIASED in found:
            return BIASED
        first = [f for f in self.findings if f.check == self.findings[0].check]
        if any(f.verdict == WITHIN for f in first) and not any(f.leans for f in self.findings):
            return WITHIN
        return NOT_SEEN if found == {NOT_SEEN} else UNDECIDED  # also where no direction has a derivative

    @property
    def slope(self) -> Slope | None:
        """The slope whose interval reaches farthest from 1, of those against differences; None: there is none."""
        slopes = [f.slope for f in self.findings if f.slope is not None and f.check == "slope"]
        return max(slopes, key=lambda s: max(1.0 - s.low, s.high - 1.0), default=None)


@dataclass(frozen=True)
class Effect:
    """What a gradient loses without an effect.

    Attributes:
        option: of the integrator, by which the effect is left out.
        parameter: name of the parameter.
        lost: share of the derivative along the direction that stands out most; negative: it grows.
        error: standard error of ``lost``.
        bar: half of its 95 % bar.
        saved: share of the gradient's time.
    """

    option: str
    parameter: str
    lost: float
    error: float
    bar: float
    saved: float

    def cells(self) -> tuple[str, ...]:
        """Return the table's cells."""
        lost = f"{100.0 * self.lost:.3g} ± {100.0 * self.bar:.2g} %"
        return self.parameter, self.option, lost, f"{100.0 * self.saved:.0f} %"


EFFECTS_HEADER = ("parameter", "option", "loses", "saves, of the time")


#: Relative errors whose price is told.
ERRORS = (0.1, 0.03, 0.01)


@dataclass(frozen=True)
class Price:
    """What a gradient costs.

    Attributes:
        parameter: name of the parameter.
        seconds: to relative errors of ``ERRORS`` (root mean square), about; infinite where the pilot saw noise alone.
    """

    parameter: str
    seconds: tuple[float, ...]

    def cells(self) -> tuple[str, ...]:
        """Return the table's cells."""
        return self.parameter, *("?" if math.isinf(s) else f"{s:.2g} s" for s in self.seconds)


PRICES_HEADER = ("parameter", *(f"to {100.0 * error:g} %" for error in ERRORS))

HEADER = ("parameter", "check", "what", "slope", "interval", "p", "verdict", "")


@dataclass(frozen=True, kw_only=True)
class Certificate(Mapping[str, OfParameter]):
    """Verdicts on gradients: a mapping from parameters' names; ``print`` shows a table.

    Attributes:
        parameters: names of what was examined.
        findings: all comparisons.
        effects: what gradients lose without an effect.
        prices: what gradients cost.
        refused: (method, reason) of methods that do not cover the request.
        notes: what else is known.
        level: probability with which intervals hold, and with which no right gradient is called biased.
        tolerance: of slopes.
        budget: seconds that were given.
        seconds: seconds that were spent, compiling left out.
    """

    parameters: tuple[str, ...]
    findings: tuple[Finding, ...]
    effects: tuple[Effect, ...] = ()
    prices: tuple[Price, ...] = ()
    refused: tuple[tuple[str, str], ...] = ()
    notes: tuple[str, ...] = ()
    level: float
    tolerance: float
    budget: float
    seconds: float

    def __getitem__(self, name: str) -> OfParameter:
        if name not in self.parameters:
            raise KeyError(f"the certificate says nothing of {name!r}; it examined {', '.join(self.parameters)}")
        return OfParameter(name, tuple(f for f in self.findings if f.parameter == name))

    def __iter__(self) -> Iterator[str]:
        return iter(self.parameters)

    def __len__(self) -> int:
        return len(self.parameters)

    @property
    def ok(self) -> bool | None:
        """True: every gradient is within the tolerance; False: a bias was found; None: something is undecided."""
        verdicts = {self[name].verdict for name in self}
        if BIASED in verdicts:
            return False
        return True if verdicts == {WITHIN} else None

    def __str__(self) -> str:
        tables = ["\n".join(html.aligned([header, *rows])) for header, rows in self._tables()]
        return "\n\n".join([self.summary, *tables, "\n".join(self._below())]).rstrip()

    @property
    def summary(self) -> str:
        """One line: how many parameters have which verdict."""
        counts: dict[str, int] = {}
        for name in self:
            counts[self[name].verdict] = counts.get(self[name].verdict, 0) + 1
        told = ", ".join(f"{n} {verdict}" for verdict, n in counts.items())
        spent = f"{self.seconds:.1f} s of {self.budget:g} s"
        return f"gradients: {told} (slope 1 ± {self.tolerance:g} at level {self.level:g}; {spent})"

    def _tables(self) -> list[tuple[tuple[str, ...], list[tuple[str, ...]]]]:
        """Return (header, rows) of each table that has rows."""
        tables = ((HEADER, self.findings), (EFFECTS_HEADER, self.effects), (PRICES_HEADER, self.prices))
        return [(header, [item.cells() for item in items]) for header, items in tables if items]

    def _below(self) -> list[str]:
        return [*self.notes, *(f"{method} does not cover it: {reason}" for method, reason in self.refused)]

    def _repr_html_(self) -> str:
        """Return the table that a notebook shows."""
        tables = html.preformatted("").join(html.table(header, rows) for header, rows in self._tables())
        return html.preformatted(self.summary) + tables + html.preformatted("\n".join(self._below()))

    def to_json(self) -> dict[str, Any]:
        """Return the certificate in values that JSON has; numbers that are not finite are None."""
        held = asdict(self)
        verdicts = {name: self[name].verdict for name in self}
        return _finite({"format": FORMAT, "version": VERSION, "ok": self.ok, "verdicts": verdicts, **held})

    def save(self, path: str | os.PathLike) -> None:
        """Write the certificate as a JSON file."""
        text = json.dumps(self.to_json(), indent=1) + "\n"
        write_atomic(path, lambda file: file.write(text.encode()))

    def html(self, path: str | os.PathLike) -> None:
        """Write the certificate as a page that needs no other file."""
        head = f'<head><meta charset="utf-8"><title>Certificate of gradients</title><style>{STYLE}</style></head>'
        text = f"<!doctype html><html>{head}<body>{self._repr_html_()}</body></html>\n"
        write_atomic(path, lambda file: file.write(text.encode()))


def _needed(seconds: float) -> str:
    if math.isnan(seconds):
        return ""
    if math.isinf(seconds):
        return "longer steps of differences are inexact, and shorter ones noisy: no time decides it"
    return f"some {seconds:.2g} s would decide it"


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
