"""Certificates of gradients: of this renderer's scenes, of Mitsuba 3, and how often right gradients raise an alarm.

    python examples/benchmarks/certificates.py [scenes|mitsuba|alarms ...] [--budget 60] [--kept alarms.jsonl]
        [--output docs/data/certificates.jsonl]

``alarms`` examines the gradient table of the tests and random scenes, with several seeds each; what is done is kept in
a file, from which the next run goes on.
"""

import json
import tempfile
import warnings
from collections import Counter
from pathlib import Path

from accuracy_cases import FRESH, PAIRS, Loaded
from certificates_mitsuba import renderers
from common import Report, arguments, psdr

RESOLUTION, QUICK_RESOLUTION = 32, 12
#: Checks whose kernels are those of a gradient and its transpose.
CHECKS = ("slope", "identities", "precision")
#: Certificates of each right gradient, one after the other, since compiling takes longest; random scenes.
SEEDS, RANDOM_SCENES = 3, 50
VERDICTS = ("within", "undecided", "not seen", "biased", "refused")


def row_of(title: str, name: str, certificate: psdr.Certificate) -> dict:
    """Return what a certificate says of a parameter; the slope is that of the direction that is told best."""
    of = certificate[name]
    slopes = [f.slope for f in of.findings if f.check == "slope" and f.slope is not None]
    slope = min(slopes, key=lambda s: s.error, default=None)
    told = [f for f in of.findings if f.verdict != "undecided"]
    return {
        "gradient": title,
        "verdict": of.verdict,
        "slope": None if slope is None else slope.value,
        "error": None if slope is None else slope.error,
        "comparisons": len(of.findings),
        "decided": len(told),
        "seconds": certificate.seconds,
    }


def scenes(budget: float, resolution: int) -> list[dict]:
    """Return a row for each gradient of the benchmark scenes."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for pair in (p for p in (*PAIRS, *FRESH) if p.parameters and p.boundary == "auto"):
            loaded = Loaded(pair, Path(folder), resolution, adjoint="waves")
            certificate = psdr.certify(
                loaded.scene, loaded.params, integrator=loaded.integrator, budget=budget, checks=CHECKS
            )
            print(f"\n{pair}\n{certificate}", flush=True)
            found += [row_of(f"{pair.scene}: {name}", name, certificate) for name in certificate]
    return found


def mitsuba(budget: float, threads: int) -> list[dict]:
    """Return a row for each gradient of Mitsuba's."""
    found = []
    for title, (render, gradient, values, options) in renderers(threads).items():
        certificate = psdr.certify_function(render, gradient, values, budget=budget, **options)
        print(f"\n{title}\n{certificate}", flush=True)
        found += [row_of(f"{title}: {name}", name, certificate) for name in certificate]
    return found


def right_gradients() -> list:
    """Return (case, seed) of gradients that the tests hold right by other means."""
    from tests.boundary import mirrors, random_scenes, test_table

    table = {(c.scene, c.names, c.depth): c for c in (*test_table.CASES, *mirrors.CASES)}
    drawn = [random_scenes.draw(seed) for seed in range(RANDOM_SCENES)]
    return [(case, seed) for case in (*table.values(), *drawn) for seed in range(SEEDS)]


def alarms(budget: float, kept: Path | None, most: int | None) -> list[dict]:
    """Return one row: certificates of right gradients by verdict."""
    done = {}
    if kept is not None and kept.is_file():
        done = {d["key"]: d["verdict"] for d in map(json.loads, kept.read_text().splitlines())}
    for case, seed in right_gradients()[:most]:
        key = f"{case.scene}, {' '.join(case.names)}, depth {case.depth}, seed {seed}"
        if key not in done:
            done[key] = _verdict(case, seed, budget)
            print(key, done[key], flush=True)
            if kept is not None:
                with open(kept, "a", encoding="utf-8") as file:
                    file.write(json.dumps({"key": key, "verdict": done[key]}) + "\n")
    counts = Counter(done.values())
    return [
        {"certificates": len(done), **{v: counts[v] for v in ("within", "undecided", "not seen", "biased", "refused")}}
    ]


def _verdict(case, seed: int, budget: float) -> str:
    from tests.boundary.scenes import load

    scene, params = load(case.scene)
    params.requires_grad_only(*case.names)
    integrator = psdr.PathIntegrator(max_depth=case.depth, hide_emitters=case.hidden)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            certificate = psdr.certify(scene, params, integrator=integrator, budget=budget, checks=CHECKS, seed=seed)
    except ValueError as reason:
        print(reason, flush=True)
        return "refused"
    if certificate.ok is False:
        print(certificate, flush=True)
    verdicts = {certificate[name].verdict for name in certificate}
    return next(v for v in ("biased", "undecided", "not seen", "within") if v in verdicts)


def main() -> None:
    """Issue the certificates that are asked for, and report them."""
    parser = arguments(__doc__)
    parser.add_argument("parts", nargs="*", default=["scenes"], help="scenes, mitsuba, alarms; default: scenes")
    parser.add_argument("--budget", type=float, help="seconds of a certificate; default: 60, quick and alarms: 6")
    parser.add_argument("--kept", type=Path, help="file of the certificates of alarms that are done")
    options = parser.parse_args()
    budget = options.budget or (6.0 if options.quick else 60.0)
    report = Report("certificates", options.output)
    if "scenes" in options.parts:
        report.table("this renderer", scenes(budget, QUICK_RESOLUTION if options.quick else RESOLUTION))
    if "mitsuba" in options.parts:
        report.table("Mitsuba 3", mitsuba(budget, options.threads))
    if "alarms" in options.parts:
        report.table("right gradients", alarms(options.budget or 6.0, options.kept, 4 if options.quick else None))


if __name__ == "__main__":
    main()
