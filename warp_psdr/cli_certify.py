"""``warp-psdr certify``: its options, and what it prints."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from warp_psdr.cli_output import fractions

#: Exit statuses by ``Certificate.ok``: within the tolerance, a bias was found, undecided.
EXIT_STATUS = {True: 0, False: 3, None: 4}


def add_certify_options(parser: argparse.ArgumentParser) -> None:
    """Add what is examined, how surely, and where the certificate is written to."""
    parser.add_argument("--param", action="append", required=True, metavar="NAME", help="as for gradient; repeatable")
    parser.add_argument("--budget", type=float, default=60.0, help="seconds, compiling left out (default 60)")
    parser.add_argument("--level", type=float, default=0.99, help="of all verdicts together (default 0.99)")
    parser.add_argument("--tolerance", type=float, default=0.02, help="of slopes about 1 (default 0.02)")
    checks = "slope, identities, estimators, necessity, price; repeatable"
    parser.add_argument("--check", action="append", metavar="NAME", help=checks)
    parser.add_argument(
        "--boundary", choices=("auto", "none"), default="auto", help="none: leave the boundary term out"
    )
    parser.add_argument("--seed", type=int, default=0, help="of all random numbers (default 0)")
    parser.add_argument("--json", type=Path, metavar="FILE.json", help="write the certificate")
    parser.add_argument("--html", type=Path, metavar="FILE.html", help="write it as a page")


def run_certify(arguments: argparse.Namespace, scene: Any, integrator: Any) -> int:
    """Examine a loaded scene and return the exit status."""
    import warp_psdr as psdr

    params = psdr.traverse(scene)
    params.requires_grad(*arguments.param)
    options = {name: getattr(arguments, name) for name in ("sensor", "budget", "level", "tolerance", "seed")}
    with fractions("certify") as progress:
        certificate = psdr.certify(
            scene, params, integrator=integrator, checks=arguments.check or "all", progress=progress, **options
        )
    print(certificate)
    for path, write in ((arguments.json, certificate.save), (arguments.html, certificate.html)):
        if path is not None:
            write(path)
            print(f"wrote {path}")
    return EXIT_STATUS[certificate.ok]
