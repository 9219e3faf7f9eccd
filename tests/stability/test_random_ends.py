"""Random numbers at the ends of their range: no sample may be lost to them (``random_ends.py``)."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
#: Scenes, and the methods that take them.
FAST = (("soft",), ("unguided",))
SLOW = [
    (("soft", "envmap"), ("kdtree", "projective", "edge")),
    (("spot", "room"), ("unguided", "edge")),
    (("rough", "smooth", "sunk smooth"), ("unguided", "edge")),
    (("bent plate", "ball and floor", "glowing box", "knot"), ("unguided",)),
    (("mirror ball",), ("unguided",)),
]


def check(scenes: tuple[str, ...], methods: tuple[str, ...]) -> None:
    command = [sys.executable, "-m", "tests.stability.random_ends", *scenes, *methods]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout.splitlines()[-1])
    assert len(found) == len(scenes) * len(methods)
    assert not any(found.values()), found


@pytest.mark.slow
def test_few() -> None:
    check(*FAST)


@pytest.mark.slow
@pytest.mark.parametrize(("scenes", "methods"), SLOW, ids=lambda names: ", ".join(names))
def test_many(scenes: tuple[str, ...], methods: tuple[str, ...]) -> None:
    check(scenes, methods)
