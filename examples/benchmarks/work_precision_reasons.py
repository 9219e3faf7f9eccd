"""Why a ratio of times at equal error is what it is, from the run's own measurements.

With n samples a pixel, a run takes n / r seconds and has the squared error v / n, so the time to an error e is v / (r
e^2), and the ratio of two methods' times is a product of two factors:

    ratio = (r of ours / r of theirs) (v of theirs / v of ours):    samples a second, and noise of a sample.

The first has causes that are measured as well: the processor time of a sample, all threads together; cores that wait
(processor time over wall time); and a fixed cost (seconds = a + b n through the least and the largest sample count; a
is the part that more samples do not change).
"""

from collections.abc import Sequence

#: Factors within it of one count as equal: medians of few runs differ by that much.
EQUAL = 0.1
#: Shares of fixed cost, and differences of busy cores, that are worth a word.
FIXED_SHARE, CORES = 0.1, 0.2


def why(own: Sequence[dict], other: Sequence[dict]) -> str:
    """Return the reason in words.

    Args:
        own: rows of ``work_precision_data.summary`` of our method, one a sample count.
        other: those of the method that it is compared with.
    """
    a, b = (max(rows, key=lambda r: r["spp"]) for rows in (own, other))
    rate = (a["spp"] / a["seconds"]) / (b["spp"] / b["seconds"])
    noise = (b["spp"] * b["error"] ** 2) / (a["spp"] * a["error"] ** 2)
    words = [
        (rate, _compared(rate, "as many samples a second", "fewer samples a second", "more samples a second")),
        (noise, _compared(noise, "as much noise in a sample", "more noise in a sample", "less noise in a sample")),
    ]
    causes = _causes(own, other) if rate < 1.0 + EQUAL else ""
    words[0] = (rate, words[0][1] + causes)
    return ", ".join(text for _factor, text in sorted(words, key=lambda w: w[0]))


def _compared(factor: float, equal: str, worse: str, better: str) -> str:
    text = equal if abs(factor - 1.0) <= EQUAL else worse if factor < 1.0 else better
    return f"{text} ({factor:.2g}×)"


def _causes(own: Sequence[dict], other: Sequence[dict]) -> str:
    """Return the causes of a low rate, in brackets."""
    found = []
    shares = [fixed_share(rows) for rows in (own, other)]
    if max(shares) > FIXED_SHARE:
        found.append("fixed cost {:.0%} of our time, {:.0%} of its".format(*shares))
    last = [max(rows, key=lambda r: r["spp"]) for rows in (own, other)]
    if all("cores" in r for r in last):
        a, b = (r["cores"] * r["seconds"] / r["spp"] for r in last)
        found.insert(0, f"{a / b:.2g}× its processor time a sample")
        if abs(last[0]["cores"] - last[1]["cores"]) > CORES:
            found.append("{:.1f} cores busy, its {:.1f}".format(*(r["cores"] for r in last)))
    return f" [{'; '.join(found)}]" if found else ""


def fixed_share(rows: Sequence[dict]) -> float:
    """Return the share of a fixed cost in the time of the largest sample count; 0 where there is one count only."""
    few, many = min(rows, key=lambda r: r["spp"]), max(rows, key=lambda r: r["spp"])
    if few["spp"] == many["spp"]:
        return 0.0
    slope = (many["seconds"] - few["seconds"]) / (many["spp"] - few["spp"])
    return min(max(1.0 - slope * many["spp"] / many["seconds"], 0.0), 1.0)
