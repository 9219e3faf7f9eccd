"""Directives that put this renderer and Mitsuba side by side, from the lines of ``docs/data``.

``{side-by-side} QUESTION`` is one table: a row for each measurement that answers the question, in seconds, with the
letter of its run. ``{runs}`` lists the runs: machine, versions, commit and setting of each letter.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass

from generated import DATA, Generated, _number


@dataclass(frozen=True)
class Row:
    """A row of a table; None: not measured.

    Attributes:
        case: what was rendered.
        mine: this renderer's seconds.
        theirs: Mitsuba's seconds.
        ratio: Mitsuba's time over this renderer's, as it was measured: a median of ratios.
        gain: Mitsuba's error² × time over this renderer's.
    """

    case: str
    mine: float | None
    theirs: float | None
    ratio: float | None = None
    gain: float | None = None


@dataclass(frozen=True)
class Source:
    """Lines of a file that belong into a table.

    Attributes:
        file: its name in ``docs/data``, without the ending.
        table: how the lines' ``table`` begins.
        read: makes rows of these lines, each with the line that it stems from.
    """

    file: str
    table: str
    read: Callable[[list[dict]], list[tuple[Row, dict]]]


def _speed(what: str, label: str):
    """Return a reader of the lines of one pass."""

    def read(lines: list[dict]) -> list[tuple[Row, dict]]:
        found = [line for line in lines if line["what"] == what]
        return [(_of_ratio(label, line["seconds"], line["× Mitsuba's speed"]), line) for line in found]

    return read


def _material(kind: str):
    """Return a reader of images, of gradients, or of derivative images."""

    def read(lines: list[dict]) -> list[tuple[Row, dict]]:
        columns = f"{kind}, seconds", f"{kind}, × Mitsuba's speed"
        return [(_of_ratio(line["scene"], *(line[column] for column in columns)), line) for line in lines]

    return read


def _of_ratio(case: str, mine: float, ratio: float) -> Row:
    return Row(case, mine, mine * ratio, ratio)


def _media(kind: str):
    """Return a reader of images, or of gradients, against ``volpath`` and ``prbvolpath``."""

    def read(lines: list[dict]) -> list[tuple[Row, dict]]:
        found = [line for line in lines if line["what"].endswith(f"{kind}: speed")]
        names = [line["what"].partition(", image")[0] for line in found]
        return [
            (Row(name, line["seconds"], line["of, seconds"], line["ratio"]), line)
            for name, line in zip(names, found, strict=True)
        ]

    return read


def _shapes(lines: list[dict]) -> list[tuple[Row, dict]]:
    found = [line for line in lines if line["and of"] == "Mitsuba"]
    names = [line["what"].partition(", image")[0] for line in found]
    return [
        (Row(name, line["seconds"], line["its seconds"], line["measured"]), line)
        for name, line in zip(names, found, strict=True)
    ]


def _global(lines: list[dict]) -> list[tuple[Row, dict]]:
    rows = []
    for line in lines:
        guided = "unguided" if line["guiding"] == "none" else f"guided by {line['guiding']}"
        mine, theirs = line["seconds"], line["Mitsuba prb_projective unguided, seconds"]
        rows.append((Row(f"{line['scene']}; {guided}", mine, theirs, theirs / mine, line["gain"]), line))
    return rows


def _reverse(lines: list[dict]) -> list[tuple[Row, dict]]:
    *ours, theirs = lines
    assert theirs["renderer"].startswith("Mitsuba")
    seconds = theirs["seconds"]
    name = "Cornell box, the sliding box, image and gradient in reverse mode; "
    return [(Row(name + line["renderer"], line["seconds"], seconds, seconds / line["seconds"]), line) for line in ours]


def _shadow(lines: list[dict]) -> list[tuple[Row, dict]]:
    rows = []
    for line in lines:
        case = f"soft shadow of a moving sphere; {line['method']}, {line['samples']} samples"
        mine = None if line["method"].startswith("Mitsuba") else line["seconds"]
        rows.append((Row(case, mine, None if mine else line["seconds"], gain=line["gain"]), line))
    return rows


BOX, BALL = "Cornell box", "Cornell box with a mesh of 82,000 triangles"
REFLECTANCES = "gradient of all reflectances, reverse"
VERTICES = "gradient of all reflectances and vertices, reverse, interior term"
QUESTIONS: dict[str, list[Source]] = {
    "image": [
        Source("speed", "Cornell box", _speed("image", BOX)),
        Source("speed", "The same", _speed("image", BALL)),
        Source("materials", "Materials", _material("image")),
        Source("media", "Media, 128", _media(", image")),
        Source("implicit", "Shapes", _shapes),
    ],
    "gradient": [
        Source("speed", "Cornell box", _speed(REFLECTANCES, f"{BOX}, all reflectances")),
        Source("speed", "The same", _speed(REFLECTANCES, f"{BALL}, all reflectances")),
        Source("speed", "Cornell box", _speed(VERTICES, f"{BOX}, all reflectances and vertices, interior term alone")),
        Source("speed", "The same", _speed(VERTICES, f"{BALL}, all reflectances and vertices, interior term alone")),
        Source("materials", "Materials", _material("gradient")),
        Source("media", "Media, 128", _media("gradient")),
    ],
    "forward": [Source("materials", "Materials", _material("derivative image"))],
    "moving": [
        Source("global", "Derivative images", _global),
        Source("global", "Reverse mode", _reverse),
        Source("soft_shadow", "Soft shadow", _shadow),
    ],
}


def _rows(source: Source) -> list[tuple[Row, dict]]:
    """Return the rows of a source, with their lines."""
    text = (DATA / f"{source.file}.jsonl").read_text(encoding="utf-8")
    lines = [line for line in map(json.loads, text.splitlines()) if line["table"].startswith(source.table)]
    rows = source.read(lines)
    if not rows:
        raise ValueError(f"no line of docs/data/{source.file}.jsonl is what docs/_ext/side_by_side.py looks for")
    return rows


def _run(machine: dict) -> str:
    versions = ", ".join(f"{key} {machine[key]}" for key in ("warp", "mitsuba") if key in machine)
    return f"{machine['cores']} cores of {machine['cpu']} | {versions} | `{machine['commit']}`"


def runs() -> dict[str, list[str]]:
    """Return what the letters of all questions stand for, in their order: machine, and the settings on it."""
    found: dict[str, list[str]] = {}
    for sources in QUESTIONS.values():
        for source in sources:
            for _, line in _rows(source):
                settings = found.setdefault(_run(line["machine"]), [])
                setting = re.search(r"\d+ × \d+ pixels[^:;(]*", line["table"])
                text = f"`{line['benchmark']}`: {setting.group().strip()}" if setting else ""
                if text and text not in settings:
                    settings.append(text)
    return found


def table(question: str) -> str:
    """Return the table of a question as Markdown; gains have a column where there are any."""
    letters = {run: chr(ord("A") + i) for i, run in enumerate(runs())}
    found = [entry for source in QUESTIONS[question] for entry in _rows(source)]
    gains = any(row.gain is not None for row, _ in found)
    names = ["scene", "warp_psdr, seconds", "Mitsuba, seconds", "Mitsuba's time over ours", *["gain"] * gains, "run"]
    out = [f"| {' | '.join(names)} |", "|" + "---|" * len(names)]
    for row, line in found:
        numbers = map(_number, (row.mine, row.theirs, row.ratio, *[row.gain] * gains))
        out.append(f"| {' | '.join([row.case, *numbers, letters[_run(line['machine'])]])} |")
    return "\n".join(out)


class SideBySide(Generated):
    """The table of a question."""

    required_arguments = 1

    def text(self) -> str:
        """Return the table."""
        question = self.arguments[0]
        for source in QUESTIONS[question]:
            self.env.note_dependency(str(DATA / f"{source.file}.jsonl"))
        return table(question)


class Runs(Generated):
    """The runs by their letters."""

    def text(self) -> str:
        """Return a table."""
        rows = [f"| {chr(ord('A') + i)} | {run} | {'; '.join(text)} |" for i, (run, text) in enumerate(runs().items())]
        return "\n".join(["| run | machine | versions | commit | setting |", "|---|---|---|---|---|", *rows])


def setup(app) -> dict:
    """Add the directives."""
    app.add_directive("side-by-side", SideBySide)
    app.add_directive("runs", Runs)
    return {"parallel_read_safe": True}
