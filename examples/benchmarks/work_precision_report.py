"""Tables and the page of plots of the work-precision benchmark."""

import math
from collections.abc import Callable
from pathlib import Path

from work_precision_data import Reference, bias, gains, jackknife, root_text, squared_difference, summary, verdict
from work_precision_reasons import why

#: Panels a row of the page, and inches of one.
COLUMNS, PANEL = 4, (3.3, 2.7)
#: Names of references that are not renderers.
CLOSED, DIFFERENCES = "closed form", "finite differences"
#: Names of methods in the legend: what they are options of.
NAMES = {
    "ours": "warp_psdr, path",
    "ours, Replay": "warp_psdr, interior.Replay",
    "ours, unguided": "warp_psdr, PathSpace, unguided",
    "ours, KdTree": "warp_psdr, PathSpace, KdTree reused",
    "ours, KdTree, first call": "warp_psdr, PathSpace, KdTree built anew",
    "Mitsuba path": "Mitsuba, path",
    "Mitsuba prb": "Mitsuba, prb",
    "Mitsuba, none": "Mitsuba, prb_projective, unguided",
}
#: What is measured against, and the clocks: axis labels.
ERROR = "RMS error / RMS of the reference"
CLOCKS = {
    "wall": "wall-clock seconds of one rendering",
    "processor": "processor seconds of one rendering, all threads",
}
#: Columns that the page of plots reads.
VERDICT, FLOOR, BIAS = "against finite differences", "error that remains", "bias of the mean"
#: Name of a reference -> its images of a case, or None where it has none.
References = Callable[[str, str], Reference | None]


def theirs(method: str) -> bool:
    """Whether a method is Mitsuba's."""
    return method.startswith("Mitsuba")


def work_rows(rows: list[dict], cases: list[str]) -> list[dict]:
    """Return the table of times at equal error: one row a case and method, at its largest sample count."""
    sums, result = summary(rows), []
    cold = {(r["case"], r["method"]): r["seconds"] for r in rows if r["kind"] == "cold"}
    for case in cases:
        for row in gains(sums, case, theirs):
            gain = "–" if row["gain"] is None else f"{row['gain']:.2g}"
            result.append(
                {
                    "case": case,
                    "method": row["method"],
                    "samples": row["spp"],
                    "seconds": f"{row['seconds']:.2g}",
                    "error": f"{row['error']:.2g}",
                    "seconds × error²": f"{row['work']:.2g}",
                    "× Mitsuba's best": gain,
                    "first call [s]": f"{cold.get((case, row['method']), math.nan):.2g}",
                }
            )
        for row in rows:
            if row["kind"] == "refused" and row["case"] == case:
                shown = dict.fromkeys(("samples", "seconds", "error", "seconds × error²", "× Mitsuba's best"), "–")
                result.append({"case": case, "method": row["method"]} | shown | {"first call [s]": "**raises**"})
    return result


def best_rows(rows: list[dict], judged: list[dict], wanted: dict[str, float]) -> list[dict]:
    """Return one row a case: our best method, Mitsuba's, the ratio of their times at equal error, and why it is low.

    Args:
        rows: the measurements.
        judged: of ``bias_rows``.
        wanted: case -> ratio from which on none is asked why.
    """
    sums, wrong, result = summary(rows), wrong_ones(judged), []
    for case, least in wanted.items():
        found = [r for r in gains(sums, case, theirs) if r["work"] > 0.0]
        own = min((r for r in found if not theirs(r["method"])), key=lambda r: r["work"], default=None)
        other = min((r for r in found if theirs(r["method"])), key=lambda r: r["work"], default=None)
        if own is None:
            continue
        row = {"case": case, "best of ours": own["method"], "Mitsuba's best": "–", "ratio of times": "–"}
        row |= {"wanted": f"≥ {least:g}", "why it is lower": ""}
        if other is not None:
            ratio = other["work"] / own["work"]
            row |= {"Mitsuba's best": other["method"], "ratio of times": f"{ratio:.2g}"}
            if ratio < least:
                pair = ([r for r in sums if (r["case"], r["method"]) == (case, m["method"])] for m in (own, other))
                row["why it is lower"] = why(*pair)
        notes = [f"{name} {text}" for (c, name), text in wrong.items() if c == case]
        notes += [f"{r['method']} raises" for r in rows if r["kind"] == "refused" and r["case"] == case]
        result.append(row | {"notes": "; ".join(notes)})
    return result


def bias_rows(cases: list[str], names: dict[str, list[str]], references: References) -> list[dict]:
    """Return how far references are from each other, and from finite differences.

    Args:
        cases: which.
        names: case -> methods with a reference, ours first.
        references: finds them.
    """
    result = []
    for case in cases:
        differences = references(case, DIFFERENCES)
        own = references(case, names[case][0]) if names[case] else None
        if references(case, CLOSED) is not None or own is None:
            continue
        for name in names[case]:
            a = references(case, name)
            if a is None:
                continue
            row = {"case": case, "reference": name, "its noise": "blank"}
            if not a.blank:
                row["its noise"] = f"{(a.noise / a.power) ** 0.5:.2g}"
            away = "–" if a is own else root_text(*jackknife(squared_difference, a, own))
            right = "–" if differences is None else verdict(a, differences)
            result.append(row | {"difference to ours": away, VERDICT: right})
    return result


def floor_rows(cases: list[str], names: dict[str, list[str]], references: References) -> list[dict]:
    """Return what remains of the error with any number of samples: the distance to the closed form."""
    result = []
    for case in cases:
        closed = references(case, CLOSED)
        for name in names[case] if closed is not None else []:
            a = references(case, name)
            if a is not None:
                floor = root_text(*jackknife(squared_difference, a, closed))
                mean, error = jackknife(bias, a, closed)
                result.append({"case": case, "method": name, FLOOR: floor, BIAS: f"{mean:.1e} ± {error:.0e}"})
    return result


def wrong_ones(rows: list[dict]) -> dict[tuple[str, str], str]:
    """Return (case, reference) -> verdict, of those that are wrong."""
    return {(r["case"], r["reference"]): r[VERDICT].replace("*", "") for r in rows if "wrong" in r[VERDICT]}


def _decade(axis, name: str, values: list[float]) -> None:
    """Set logarithmic limits around values: at least a decade, so that one of its ends is labelled."""
    from matplotlib.ticker import NullFormatter

    logs = [math.log10(v) for v in values]
    middle, half = (min(logs) + max(logs)) / 2.0, max(0.58 * (max(logs) - min(logs)), 0.55)
    axis.set(**{f"{name}scale": "log", f"{name}lim": (10.0 ** (middle - half), 10.0 ** (middle + half))})
    getattr(axis, f"{name}axis").set_minor_formatter(NullFormatter())


def draw(
    path: Path,
    rows: list[dict],
    cases: dict[str, str],
    floors: list[dict],
    judged: list[dict],
    title: str,
    clock: str = "wall",
) -> None:
    """Draw one panel a case: error against seconds, both logarithmic.

    Horizontal lines are errors that remain. Methods have one colour on the whole page, Mitsuba's are dashed.

    Args:
        path: file to write.
        rows: the measurements.
        cases: name -> scene and what is computed, the title of its panel.
        floors: of ``floor_rows``.
        judged: of ``bias_rows``.
        title: machine, versions and size of the images.
        clock: "wall", or "processor" (of all threads), which other programs on the machine disturb less.
    """
    from matplotlib import colormaps
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    sums = [r for r in summary(rows) if r["error"] > 0.0]
    if clock == "processor":
        sums = [r | {"seconds": r["seconds"] * r["cores"]} for r in sums]
    methods = list(dict.fromkeys(r["method"] for r in sums))
    own = [m for m in methods if not theirs(m)]
    colors = {m: colormaps["tab10"](i % 10) for i, m in enumerate(own)}
    colors |= {m: colormaps["Dark2"](i % 8) for i, m in enumerate(m for m in methods if theirs(m))}
    count = math.ceil(len(cases) / COLUMNS)
    figure = Figure(figsize=(COLUMNS * PANEL[0], count * PANEL[1] + 0.9), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(count, COLUMNS, squeeze=False).reshape(-1)
    wrong = wrong_ones(judged)
    for axis, case in zip(axes, cases, strict=False):
        of_case = [r for r in sums if r["case"] == case]
        for method in dict.fromkeys(r["method"] for r in of_case):
            points = sorted((r["spp"], r["seconds"], r["error"]) for r in of_case if r["method"] == method)
            style = {"linestyle": "--", "marker": "s"} if theirs(method) else {"linestyle": "-", "marker": "o"}
            axis.plot(
                [p[1] for p in points],
                [p[2] for p in points],
                color=colors[method],
                markersize=3.5,
                linewidth=1.2,
                **style,
            )
        remains = []
        for row in floors:
            if row["case"] == case and not row[FLOOR].startswith("<"):
                remains.append(float(row[FLOOR]))
                axis.axhline(remains[-1], color=colors.get(row["method"]), linewidth=2.0, alpha=0.4)
        notes = [f"{name}: {text}" for (c, name), text in wrong.items() if c == case]
        notes += [f"{r['method']}: raises" for r in rows if r["kind"] == "refused" and r["case"] == case]
        if notes:
            text = "\n".join(notes).replace(" (", "\n(")
            axis.text(0.03, 0.03, text, transform=axis.transAxes, fontsize=6.5, color="firebrick")
        if of_case:
            _decade(axis, "x", [r["seconds"] for r in of_case])
            _decade(axis, "y", [r["error"] for r in of_case] + remains)
        axis.set_title(cases[case], fontsize=9)
        axis.grid(True, which="both", alpha=0.2)
        axis.tick_params(labelsize=7, which="both")
    for axis in axes[len(cases) :]:
        axis.set_axis_off()
    for axis in axes[max(len(cases) - COLUMNS, 0) : len(cases)]:
        axis.set_xlabel(CLOCKS[clock], fontsize=8)
    for axis in axes[: len(cases) : COLUMNS]:
        axis.set_ylabel(ERROR, fontsize=8)
    lines = [
        Line2D(
            [],
            [],
            color=colors[m],
            linestyle="--" if theirs(m) else "-",
            marker="s" if theirs(m) else "o",
            label=NAMES.get(m, m.replace("ours", "warp_psdr")),
        )
        for m in methods
    ]
    if any(not row[FLOOR].startswith("<") for row in floors):
        lines.append(Line2D([], [], color="0.5", linewidth=2.0, alpha=0.6, label="error that remains (float32)"))
    figure.legend(handles=lines, loc="outside lower center", ncols=4, fontsize=8)
    figure.suptitle(title, fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
