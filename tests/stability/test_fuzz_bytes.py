"""Damaged files of every kind end in a message or are read: no crash, no other error, no memory, no endless loop."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.stability.fuzz import CLEAR

ROOT = Path(__file__).resolve().parents[2]
KINDS = ("xml", "ply", "obj", "off", "stl", "glb", "gltf", "exr", "png", "jpg", "toml", "json", "npz", "npy")
KINDS += ("neuralsdf",)  # a kind of .npz files
#: Inputs of a kind: 120 and 30,000 altogether.
FEW, MANY = 8, 2000
#: Growth of the process over what reading the whole files took, MB: the inputs are of a few kilobytes.
MEMORY = 64.0
#: Seconds after which a process that hangs is ended: a safety net.
PATIENCE = 900.0
#: Share of the inputs that are refused, at least: most changes are noticed, and a fuzzer that changes nothing is.
REFUSED = 0.2


def attack(folder: Path, first: int, count: int, kinds: tuple[str, ...]) -> None:
    command = [sys.executable, "-m", "tests.stability.fuzz", str(folder), str(first), str(count), *kinds]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE, check=False)
    # OpenEXR writes warnings of its own to the standard output.
    lines = [line.partition(" ") for line in done.stdout.splitlines()]
    reports = {kind: json.loads(text) for kind, _, text in lines if kind in kinds}
    assert done.returncode == 0, f"died at {kinds[len(reports)]} ({done.returncode}): {done.stderr[-2000:]}"
    assert set(reports) == set(kinds)
    for kind, report in reports.items():
        assert not report["failures"], f"{kind}: {report['failures'][:5]}"
        assert report["memory"] < MEMORY, f"{kind}: {report['memory']} MB"
        outcomes = report["outcomes"]
        assert sum(outcomes.values()) == count
        read = outcomes.get("read", 0)
        assert read > 0 or count < MANY, f"{kind}: every input is damaged beyond its first bytes"
        assert count - read > REFUSED * count
        assert outcomes.keys() <= {"read", "SceneError", *(error.__name__ for error in CLEAR)}


def test_few_damaged_files_of_every_kind(tmp_path: Path) -> None:
    attack(tmp_path, 0, FEW, KINDS)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_many_damaged_files(kind: str, tmp_path: Path) -> None:
    attack(tmp_path, FEW, MANY, (kind,))
