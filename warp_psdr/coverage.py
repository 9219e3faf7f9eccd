"""The table of what works with what: kinds of shapes and effects, and requests; the plan answers every cell."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from warp_psdr import html
from warp_psdr.coverage_scenes import EFFECTS, KINDS, REQUESTS, names_of, scene
from warp_psdr.plan.plan import decide
from warp_psdr.scene.load import load_dict

if TYPE_CHECKING:
    from warp_psdr.coverage_scenes import Parts
    from warp_psdr.scene.scene import Scene

#: Diffuse paint of the shape that is asked about.
PAINT = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.4, 0.5, 0.6]}}
YES, NO, NONE = "yes", "no", "–"
#: What sentences have in common: which gradient is refused, by which method, and that the interior term alone is not.
FRAME = re.compile(
    r"^derivatives by \S+: |^the requested gradient .*? cannot estimate here: |; or say \S+\(boundary=None.*"
)
METHOD = re.compile(r"^interior\.\w+\(.*?\) (?=does not know|is biased)")


@dataclass(frozen=True)
class Cell:
    """One answer.

    Attributes:
        kind: of the shape that is asked about.
        effect: what the scene holds besides; "": nothing.
        request: what is asked for, a key of ``REQUESTS``.
        answer: "yes", "no", or "–": the shape has no such parameter, the sensor no such film.
        reason: the sentence with which it is refused; "": it is not.
    """

    kind: str
    effect: str
    request: str
    answer: str
    reason: str = ""

    @property
    def short(self) -> str:
        """The reason without what all have in common."""
        return METHOD.sub("it ", FRAME.sub("", self.reason))

    @property
    def row(self) -> str:
        """The row's name."""
        return f"{self.kind}, {self.effect}" if self.effect and self.kind != "mesh" else self.effect or self.kind


class Coverage(Sequence[Cell]):
    """The cells, row by row; prints as a table, with the sentences of what is refused below it."""

    def __init__(self, cells: Sequence[Cell]):
        self._cells = tuple(cells)
        #: Sentence -> its number.
        self.reasons = {r: n for n, r in enumerate(dict.fromkeys(c.short for c in self._cells if c.reason), 1)}

    def __getitem__(self, index):
        return self._cells[index]

    def __len__(self) -> int:
        return len(self._cells)

    def _rows(self) -> list[list[str]]:
        found: dict[str, list[str]] = {}
        for cell in self:
            text = f"no ({self.reasons[cell.short]})" if cell.reason else cell.answer
            found.setdefault(cell.row, [cell.row]).append(text)
        return list(found.values())

    def _header(self) -> list[str]:
        return ["", *dict.fromkeys(cell.request for cell in self)]

    def __repr__(self) -> str:
        rows = [self._header(), *self._rows()]
        return "\n".join([*html.aligned(rows), "", *(f"{n}: {reason}" for reason, n in self.reasons.items())])

    def _repr_html_(self) -> str:
        sentences = html.table(("", "refused"), [(str(n), reason) for reason, n in self.reasons.items()])
        return html.table(self._header(), self._rows()) + sentences

    def markdown(self) -> str:
        """Return the table as Markdown: requests down, kinds and effects across."""
        columns = list(zip(self._header(), *self._rows(), strict=True))
        lines = [f"| {' | '.join(column)} |" for column in columns]
        lines.insert(1, "|" + "---|" * len(columns[0]))
        return "\n".join([*lines, "", *(f"{n}. {reason}" for reason, n in self.reasons.items())])


def coverage(*, kind: str | None = None, effect: str | None = None, request: str | None = None) -> Coverage:
    """Return what works with what, as the plan answers it for small scenes.

    Args:
        kind: of a shape, as "sdfgrid" or "exact sphere"; None: every kind, and a mesh beside every effect.
        effect: what the scene holds besides, as "media"; None: nothing, for a kind that is named.
        request: a column, as "pose" or "in a mirror"; None: all of them.

    Returns:
        The table: "yes", or the number of the sentence with which a gradient, or an image, is refused.

    Raises:
        ValueError: there is no such kind, effect or request.
    """
    tables = (("kind", kind, KINDS), ("effect", effect, EFFECTS), ("request", request, REQUESTS))
    for name, given, known in tables:
        if given is not None and given not in known:
            raise ValueError(f"{name}: got {given!r}, expected one of {', '.join(map(repr, known))}")
    rows = [(k, effect or "") for k in ([kind] if kind else KINDS)]
    if kind is None and effect is None:
        rows += [("mesh", e) for e in EFFECTS]
    return Coverage([cell for row in rows for cell in _cells(*row, [request] if request else REQUESTS)])


def described(kind: str, effect: str, request: str) -> tuple[Parts, list[str]] | None:
    """Return the scene of a cell, and the parameters that are requested; None: there is no such thing."""
    plugin, values = KINDS[kind]
    parts = {**scene(), "shape": {"bsdf": PAINT, **plugin}}
    names = names_of(REQUESTS[request], values)
    try:
        parts = EFFECTS[effect](parts) if effect else parts
        return None if names is None else (REQUESTS[request].change(parts), names)
    except LookupError:  # a sensor on a shape has no film of its own
        return None


def _cells(kind: str, effect: str, requests: Iterable[str]) -> Iterator[Cell]:
    loaded: dict[str, Scene] = {}  # requests share scenes
    for request in requests:
        found = described(kind, effect, request)
        if found is None:
            yield Cell(kind, effect, request, NONE)
            continue
        parts, names = found
        try:
            if repr(parts) not in loaded:
                loaded[repr(parts)] = _load(parts)
            decide(loaded[repr(parts)], integrator=REQUESTS[request].integrator, names=names)
            yield Cell(kind, effect, request, YES)
        except ValueError as error:
            yield Cell(kind, effect, request, NO, " ".join(str(error).split()))


def _load(parts: Parts) -> Scene:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # notes on what a small scene is not
        return load_dict(parts)
