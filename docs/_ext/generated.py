"""Directives whose text is made when the documentation is built: from the code's tables, and from measurements.

``{methods}`` is ``psdr.methods()``, ``{about-method} OPTION`` one row of it; ``{plugins} KIND`` what the loader reads
of its plugins, with the pictures that ``swatches.py`` has made; ``{models}`` the declared scattering models;
``{api} GROUP`` names of the API; ``{measured} NAME`` the tables of ``data/NAME.jsonl``, in the form that ``--output``
of the benchmarks writes, or slopes with the commits that recorded them; ``{combinations}`` what may be attached
together, and what materials are not; ``{coverage} kinds`` and ``{coverage} effects`` what ``psdr.coverage()`` answers.
"""

from __future__ import annotations

import inspect
import json
import math
from pathlib import Path

import api_names
import plugin_parameters
from docutils import nodes
from docutils.statemachine import StringList
from sphinx.util.docutils import SphinxDirective

import warp_psdr as psdr
from warp_psdr.coverage_scenes import EFFECTS, KINDS
from warp_psdr.kernels import constants
from warp_psdr.kernels.bsdf import model
from warp_psdr.kernels.bsdf.composite import Composite
from warp_psdr.kernels.bsdf.dispatch import COMPOSITES, MODELS
from warp_psdr.options import combinations

#: Names of lobes.
LOBES = {
    constants.LOBE_SMOOTH: "smooth",
    constants.LOBE_DELTA_REFLECTION: "mirror reflection",
    constants.LOBE_DELTA_TRANSMISSION: "smooth transmission",
    constants.LOBE_NULL: "passage without a turn",
}
DATA = Path(__file__).resolve().parents[1] / "data"
SWATCHES = DATA.parent / "swatches"
#: Keys of a measured line that are no columns.
ABOUT = ("benchmark", "table", "machine", "note")


class Generated(SphinxDirective):
    """Parses the Markdown that ``text`` returns."""

    def run(self) -> list[nodes.Node]:
        """Return the parsed text."""
        parent = nodes.container()
        lines = self.text().splitlines()
        self.state.nested_parse(StringList(lines, self.get_source_info()[0]), self.content_offset, parent)
        return parent.children

    def text(self) -> str:
        """Return Markdown."""
        raise NotImplementedError


class Methods(Generated):
    """The table of methods; pages are linked from ``docs/methods``."""

    def text(self) -> str:
        """Return the table."""
        lines = ["| method | term | option, file |", "|---|---|---|"]
        for m in psdr.methods():
            page = m.page.rpartition("/")[2]
            method = f"[{m.paper}](/methods/{page}) {{cite}}`{m.key}`"
            lines.append(f"| {method} | {m.term} | `{m.option}` <br> `{m.file}` |")
        return "\n".join(lines)


class MethodCard(Generated):
    """Paper, option, term and file of the method with this option, and the option's parameters."""

    required_arguments = 1
    final_argument_whitespace = True

    def text(self) -> str:
        """Return a list."""
        (method,) = [m for m in psdr.methods() if m.option == self.arguments[0]]
        name = method.option.partition("(")[0]
        return "\n".join(
            [
                "| | |\n|---|---|",
                f"| paper | {{cite}}`{method.key}` |",
                f"| term | {method.term} |",
                f"| option | `psdr.{method.option}` ({{py:obj}}`parameters <warp_psdr.{name}>`) |",
                f"| file | `{method.file}` |",
            ]
        )


class Combinations(Generated):
    """What of samples and weights may be attached together."""

    def text(self) -> str:
        """Return a table."""
        lines = [
            "| directions | light points | weights | where | verdict | toy | right | variance | why |",
            "|---|---|---|---|---|---|---|---|---|",
        ]
        where = {
            combinations.ALWAYS: "",
            combinations.EDGES: "light has edges",
            combinations.MOVING_LIGHT: "light moves",
        }
        for row in combinations.TABLE:
            choices = " | ".join(" or ".join(given) for given in (row.bsdf, row.emitter, row.weights))
            verdict = "offered" if row.offered else "not offered" if row.right else "**biased**"
            numbers = f"{row.found:.3g} | {row.exact:.3g} | {row.variance:.2g}"
            lines.append(f"| {choices} | {where[row.when]} | {verdict} | {numbers} | {row.reason} |")
        lines += ["", "| material whose directions stay | why |", "|---|---|"]
        lines += [f"| `{model}` | {reason} |" for model, reason in combinations.UNMOVED.items()]
        return "\n".join(lines)


class Coverage(Generated):
    """What works with what: requests down, kinds of shapes or effects across, and the sentences of what is refused."""

    required_arguments = 1
    #: Columns of a table.
    WIDTH = 10

    def text(self) -> str:
        """Return tables."""
        rows = coverage_rows(self.arguments[0])
        parts = [rows[i : i + self.WIDTH] for i in range(0, len(rows), self.WIDTH)]
        tables = [psdr.Coverage([cell for row in part for cell in psdr.coverage(**row)]) for part in parts]
        return "\n\n".join(table.markdown() for table in tables)


def coverage_rows(of: str) -> list[dict[str, str]]:
    """Return what ``psdr.coverage`` is asked for: every kind, or a mesh beside every effect."""
    if of == "kinds":
        return [{"kind": kind} for kind in KINDS]
    return [{"kind": "mesh", "effect": effect} for effect in EFFECTS]


class Plugins(Generated):
    """What the loader reads of a kind of plugin."""

    required_arguments = 1

    def text(self) -> str:
        """Return a table; plugins that are read alike share a row."""
        lines = _swatches(self.arguments[0])
        lines += ["| plugin | parameters that are read | values in `psdr.traverse` |", "|---|---|---|"]
        rows: dict[tuple[str, str], list[str]] = {}
        for plugin in plugin_parameters.plugins(self.arguments[0]):
            read = ", ".join(f"`{p}`" for p in plugin.read) or "–"
            values = ", ".join(f"`{v}`" for v in plugin.values) or "–"
            rows.setdefault((read, values), []).append(f"`{plugin.name}`")
        lines += [f"| {', '.join(names)} | {read} | {values} |" for (read, values), names in rows.items()]
        return "\n".join(lines)


def _swatches(kind: str) -> list[str]:
    """Return the pictures of a kind of plugins that ``swatches.py`` has made, as a grid."""
    files = sorted(SWATCHES.glob(f"{kind}_*.png"))
    names = [file.stem.removeprefix(f"{kind}_") for file in files]
    cells = [f":::{{figure}} /swatches/{f.name}\n:alt: {n}\n\n`{n}`\n:::" for f, n in zip(files, names, strict=True)]
    return ["::::{container} picture-grid", *"\n".join(cells).splitlines(), "::::", ""] if cells else []


class Models(Generated):
    """The declarations of the scattering models: parameters with defaults and ranges, lobes."""

    def text(self) -> str:
        """Return a table, a row a parameter."""
        lines = ["| model | parameter | default | range | lobes |", "|---|---|---|---|---|"]
        for declared in (*MODELS, *COMPOSITES):
            nested = isinstance(declared, Composite)
            lobes = "those of the nested models" if nested else ", ".join(LOBES[lobe] for lobe in declared.lobes)
            for parameter in declared.parameters:
                if isinstance(parameter, model.Table | model.Measured):
                    continue
                about = " | ".join(_parameter(parameter))
                lines.append(f"| `{declared.plugin}` | {about} | {lobes} |")
        # A model that serves a plugin where one parameter is given repeats the others.
        return "\n".join(dict.fromkeys(lines))


def _parameter(parameter) -> tuple[str, str, str]:
    """Return a declared parameter's name, default and range."""
    ranges = ", ".join(
        f"`{v.name}` ≥ {v.low:g}" if math.isinf(v.high) else f"`{v.name}` {v.low:g} to {v.high:g}"
        for v in parameter.values
        if not math.isinf(v.low)
    )
    match parameter:
        case model.RelativeIndex():
            return "`int_ior`, `ext_ior`", f"{parameter.interior}, {parameter.exterior}", ranges
        case model.ComplexIndex():
            return "`eta`, `k`, or `material`", "a perfect mirror", ranges
        case model.UniformRoughness():
            return "`alpha`", f"{parameter.default:g}", ranges
        case model.SpecularIndex():
            return "`specular`, or `eta`", f"`specular` {parameter.default:g}", ranges
        case model.Roughness():
            return "`alpha`, or `alpha_u` and `alpha_v`", f"{parameter.default:g}", ranges
        case model.Choice():
            return f"`{parameter.name}`", parameter.default, ", ".join(parameter.options)
        case model.Flag():
            return f"`{parameter.name}`", str(parameter.default).lower(), "true, false"
        case model.NormalTexture():
            return f"`{parameter.name}`", "none", "a texture of normals, `raw`"
        case model.HeightTexture():
            return "a nested texture", "none", "heights, any number"
    default = parameter.default if parameter.default is not None else "none"
    return f"`{parameter.name}`", str(default).lower() if isinstance(default, bool | str) else f"{default:g}", ranges


class Api(Generated):
    """The public names of one group of ``api_names.GROUPS``, or of a public module, ``psdr.losses``."""

    required_arguments = 1
    final_argument_whitespace = True

    def text(self) -> str:
        """Return autodoc's directives."""
        title = self.arguments[0]
        if not title.startswith("psdr."):
            names = [name for name in psdr.__all__ if not inspect.ismodule(getattr(psdr, name))]
            return "\n".join(
                line
                for name in api_names.grouped(names)[title]
                for line in _directive("warp_psdr", name, getattr(psdr, name))
            )
        if title == "psdr.torch":  # PyTorch is not installed everywhere: autodoc loads it
            return "```{eval-rst}\n.. automodule:: warp_psdr.torch\n   :members:\n```"
        module = getattr(psdr, title.removeprefix("psdr."))
        out = [inspect.getdoc(module) or "", ""]
        for inner in _public(module):
            out += _directive(module.__name__, inner, getattr(module, inner))
        return "\n".join(out)


def _public(module) -> list[str]:
    if hasattr(module, "__all__"):
        return list(module.__all__)
    return [
        name
        for name, value in vars(module).items()
        if not name.startswith("_")
        and (inspect.isfunction(value) or inspect.isclass(value))
        and value.__module__ == module.__name__
    ]


def _directive(module: str, name: str, value) -> list[str]:
    kind = "autoclass" if inspect.isclass(value) else "autofunction" if callable(value) else "autodata"
    lines = ["```{eval-rst}", f".. {kind}:: {module}.{name}"]
    if kind == "autoclass":
        lines += ["   :members:"]
    if kind == "autodata":
        lines += ["   :no-value:"]  # a path of the machine that builds
    return [*lines, "```", ""]


class Measured(Generated):
    """Measured tables with their machine and commit."""

    required_arguments = 1

    def text(self) -> str:
        """Return the tables of a file."""
        file = DATA / f"{self.arguments[0]}.jsonl"
        self.env.note_dependency(str(file))
        return measured(file)


def measured(file: Path) -> str:
    """Return the tables of a file of measured lines as Markdown, without columns that are empty."""
    tables: dict[tuple, list[dict]] = {}
    for line in file.read_text(encoding="utf-8").splitlines():
        row = json.loads(line)
        machine = json.dumps(row.get("machine"), sort_keys=True)
        tables.setdefault((row["benchmark"], row["table"], machine), []).append(row)
    out = []
    for (benchmark, title, text), rows in tables.items():
        machine = json.loads(text)
        columns = [key for key in rows[0] if key not in ABOUT and any(row[key] not in (None, "") for row in rows)]
        source = f" (`{benchmark}`)" if machine else ""
        out += [f"**{title}**{source}", "", f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]
        out += [f"| {' | '.join(_cell(row, key) for key in columns)} |" for row in rows]
        about = []
        if machine:
            versions = [f"{key} {machine[key]}" for key in ("warp", "mitsuba", "commit") if key in machine]
            about = [f"*{machine['cores']} cores of {machine['cpu']}; {', '.join(versions)}.*"]
        notes = dict.fromkeys(row["note"] for row in rows if "note" in row)
        out += ["", " ".join([*about, *notes]), ""]
    return "\n".join(out)


def _cell(row: dict, key: str) -> str:
    """Return a cell: a slope and its error with equally many decimals, pairs as ranges."""
    value = row[key]
    if key not in ("slope", "error") or not {"slope", "error"} <= set(row) or value is None:
        return _number(value)
    alike = value if isinstance(value, list) else [x for x in (row["slope"], row["error"]) if isinstance(x, float)]
    decimals = max(2, *(len(repr(x).partition(".")[2]) for x in alike))
    return "–".join(f"{x:.{decimals}f}" for x in (value if isinstance(value, list) else [value]))


def _number(value) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:,.3g}" if abs(value) < 1000.0 else f"{value:,.0f}"
    return "" if value is None else f"{value:,}" if isinstance(value, int) else str(value)


def setup(app) -> dict:
    """Add the directives."""
    directives = {
        "methods": Methods,
        "about-method": MethodCard,
        "models": Models,
        "plugins": Plugins,
        "api": Api,
        "measured": Measured,
        "combinations": Combinations,
        "coverage": Coverage,
    }
    for name, directive in directives.items():
        app.add_directive(name, directive)
    return {"parallel_read_safe": True}
