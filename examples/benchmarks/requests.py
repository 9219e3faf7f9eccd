"""Requests that scene files invite: of random parameters of each kind, which are answered, and how rightly.

    python examples/benchmarks/requests.py FOLDER... --records raw.jsonl --define spp=16 --out docs/data/requests.jsonl
    python examples/benchmarks/requests.py FOLDER... --records raw.jsonl --define spp=16 --slopes --most 3 \
        --sample 12 --out docs/data/requests.jsonl

Up to ``--each`` parameters of every kind are drawn from each scene, and the plan is asked for the derivative by each,
with the integrator of the file: it is taken, or refused with a sentence. With ``--slopes`` a derivative along a random
direction is compared with central differences with equal random numbers, and its first calls are timed, with an empty
kernel cache for each scene. What crashes or hangs is recorded, and goes on with the next. What is in ``--records`` is
not asked again; all that it holds of the scenes is in the tables. FOLDER: a clone of a repository that holds scenes.
"""

import argparse
import json
import os
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import zip_longest
from pathlib import Path
from threading import Lock

import numpy as np
from common import machine, markdown
from request_tables import SLOPES, tables
from work_precision_data import Records

WORKER = Path(__file__).with_name("request_cases.py")
#: What tells one line of the records from another.
KEY = ("kind", "file", "name", "compared", "seed", "each", "size")
#: Scenes that one process asks when nothing is timed.
TOGETHER = 16
#: Letters of a file in which its ``<scene`` is looked for.
HEAD = 4096
#: Label, file, and the folder that holds all that it names.
Scene = tuple[str, Path, Path]


def scene_files(given: list[Path]) -> Iterator[Scene]:
    """Yield scene files, and those in folders."""
    for path in (p.resolve() for p in given):
        if path.is_file():
            yield f"{path.parent.name}/{path.name}", path, path.parent
            continue
        if not path.is_dir():
            raise SystemExit(f"SCENES: no such file or folder: {path}; give scene files, or folders that hold some")
        for file in sorted(path.rglob("*.xml")):
            with open(file, encoding="utf-8", errors="replace") as stream:
                if "<scene" in stream.read(HEAD):
                    yield f"{path.name}/{file.relative_to(path).as_posix()}", file, path


def sample(scenes: list[Scene], count: int, seed: int) -> list[Scene]:
    """Return some scenes at random, of each repository one in turn."""
    repositories: dict[str, list[Scene]] = {}
    for n in np.random.default_rng(seed).permutation(len(scenes)):
        repositories.setdefault(scenes[n][0].partition("/")[0], []).append(scenes[n])
    turns = zip_longest(*(repositories[name] for name in sorted(repositories)))
    return [scene for turn in turns for scene in turn if scene is not None][:count]


def lines_of(command: list[str], given: object, patience: float, environment: dict) -> Iterator[dict]:
    """Yield the JSON lines of a program that reads ``given``; the last, "end", says how: "", "hangs", or its status."""
    with tempfile.TemporaryFile() as source:
        source.write(json.dumps(given).encode())
        source.seek(0)
        process = subprocess.Popen(command, stdin=source, stdout=subprocess.PIPE, env=environment)
    with process:
        assert process.stdout is not None
        rest, how = b"", ""
        while True:
            if not select.select([process.stdout], [], [], patience)[0]:
                process.kill()
                how = "hangs"
                break
            block = os.read(process.stdout.fileno(), 1 << 16)
            if not block:
                break
            *lines, rest = (rest + block).split(b"\n")
            yield from map(json.loads, lines)
        status = process.wait()
    yield {"kind": "end", "how": how or (f"exit status {status}" if status else "")}


class Study:
    """Asks scene after scene, and keeps what they answer."""

    def __init__(self, options: argparse.Namespace):
        self._options, self._lock = options, Lock()
        self._records = Records(options.records, KEY)
        self._until = time.time() + 60.0 * options.minutes
        self._about = {"compared": options.slopes, "seed": options.seed, "each": options.each, "size": options.size}

    def known(self, scenes: list[Scene]) -> list[Scene]:
        """Return the scenes without those that the records know not to load."""
        lost = {row["file"] for row in self._records.rows if row["kind"] == "scene" and row["result"] != "done"}
        return [scene for scene in scenes if scene[0] not in lost]

    def _keep(self, line: dict) -> None:
        with self._lock:
            self._records.append(line | self._about)

    def _given(self, label: str, file: Path, folder: Path) -> dict:
        """Return the options of ``request_cases.py`` for a scene."""
        o = self._options
        done = [r["name"] for r in self._records.rows if r["kind"] == "request" and r["file"] == label
                and all(r[k] == v for k, v in self._about.items())]  # fmt: skip
        return {"file": str(file), "folder": str(folder), "label": label, "seed": o.seed, "each": o.each,
                "size": o.size, "slopes": o.slopes, "budget": o.budget, "until": self._until, "done": done,
                "most": o.most, "values": dict(o.define)}  # fmt: skip

    def ask(self, scenes: list[Scene]) -> None:
        """Ask scenes all that has no answer yet; what crashes or hangs is recorded, and the next request asked.

        Raises:
            RuntimeError: the program that asks does not begin.
        """
        while time.time() < self._until:
            left = [s for s in scenes if {"kind": "scene", "file": s[0], **self._about} not in self._records]
            if not left:
                return
            with tempfile.TemporaryDirectory() as cache:
                environment = dict(os.environ) | ({"WARP_CACHE_PATH": cache} if self._options.slopes else {})
                given, begun = [self._given(*scene) for scene in left], None
                for line in lines_of([sys.executable, str(WORKER)], given, self._options.patience, environment):
                    if line["kind"] == "start":
                        begun = {key: value for key, value in line.items() if key != "kind"}
                    elif line["kind"] != "end":
                        self._keep(line)
                    elif line["how"] and begun is None:
                        raise RuntimeError(f"{WORKER.name} ends before it asks anything: {line['how']}")
                    elif line["how"]:
                        kind = "request" if "name" in begun else "scene"
                        self._keep(begun | {"kind": kind, "result": "crashed", "why": line["how"]})

    def run(self, scenes: list[Scene]) -> None:
        """Ask all scenes, each compared one in a process of its own."""
        several = 1 if self._options.slopes else TOGETHER
        parts = [scenes[i : i + several] for i in range(0, len(scenes), several)]
        with ThreadPoolExecutor(self._options.jobs) as pool:
            for n, _ in enumerate(pool.map(self.ask, parts), 1):
                print(f"\r{min(n * several, len(scenes))} of {len(scenes)} scenes", end="", file=sys.stderr, flush=True)
        print(file=sys.stderr)

    def answers(self, scenes: list[Scene]) -> list[dict]:
        """Return the records of some scenes."""
        labels = {label for label, _, _ in scenes}
        return [row for row in self._records.rows if row["file"] in labels]


def write(file: Path, found: dict[str, list[dict]], about: dict) -> None:
    """Replace a file by the tables, one JSON object a line, in one step."""
    lines = [{"benchmark": "requests.py", "table": title, **row, "machine": about} for title, rows in found.items()
             for row in rows]  # fmt: skip
    part = file.with_suffix(".part")
    part.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
    part.replace(file)


def _pair(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected NAME=VALUE")
    return name, value


def main() -> None:
    """Ask, print the tables, and write them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="+", type=Path, help="scene files, and folders in which they are looked for")
    parser.add_argument("--records", type=Path, required=True, help="file of answers, which a later run continues")
    parser.add_argument("--out", type=Path, help="file of the tables, as JSON lines; every slope: in OUT_slopes.jsonl")
    parser.add_argument("--seed", type=int, default=0, help="of the drawing")
    parser.add_argument("--each", type=int, default=3, help="most parameters of a kind in a scene")
    parser.add_argument("--size", type=int, default=48, help="longer side of the films, in pixels")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time")
    parser.add_argument("--minutes", type=float, default=1e6, help="time after which no request begins")
    parser.add_argument("--patience", type=float, default=600.0, help="seconds after which a request hangs")
    parser.add_argument("--define", type=_pair, action="append", default=[], help="NAME=VALUE of files' $parameters")
    parser.add_argument("--slopes", action="store_true", help="compare with differences")
    parser.add_argument("--budget", type=float, default=10.0, help="processor seconds of a comparison")
    parser.add_argument("--most", type=int, help="most comparisons in a scene; default: all")
    parser.add_argument("--sample", type=int, help="so many scenes, repositories in turns; default: all")
    options = parser.parse_args()
    scenes = list(scene_files(options.scenes))
    study = Study(options)
    study.run(scenes if options.sample is None else sample(study.known(scenes), options.sample, options.seed))
    found = tables(study.answers(scenes))
    if options.out is not None:
        slopes = {title: rows for title, rows in found.items() if title == SLOPES}
        write(options.out, {title: rows for title, rows in found.items() if title != SLOPES}, machine())
        if slopes:
            write(options.out.with_name(f"{options.out.stem}_slopes.jsonl"), slopes, machine())
    for title, rows in found.items():
        markdown(title, rows)


if __name__ == "__main__":
    main()
