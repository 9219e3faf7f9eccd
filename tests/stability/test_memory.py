"""Memory stays flat over many steps of an optimisation, and below a ceiling."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.fit.scenes import write_fit
from tests.stability.descent import EVERY

ROOT = Path(__file__).resolve().parents[2]
#: MB of a whole process at these sizes of image: Python, Warp, its compiler's library and the kernels take 250.
CEILING = 700.0
#: MB a step that may be added over the second half of a long run. The allocator's fragments still grow by a fifth of
#: it; a step's tape that is kept adds five times as much.
GROWTH = 0.005
#: The same over a short run, in which fragments grow by a half of it.
SHORT_GROWTH = 0.02
#: Seconds after which a process that hangs is ended: a safety net.
PATIENCE = 1800.0


def measured(steps: int, *arguments: object) -> dict:
    command = [sys.executable, "-m", "tests.stability.descent", str(steps), *map(str, arguments)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    report = json.loads(done.stdout.splitlines()[-1])
    assert len(report["memory"]) == steps // EVERY
    assert max(report["memory"]) < CEILING
    return report


def growth(memory: list[float]) -> float:
    """Return the slope of the regression line, MB a step."""
    return float(np.polyfit(EVERY * np.arange(len(memory)), memory, 1)[0])


@pytest.mark.slow
def test_memory_over_a_few_steps() -> None:
    report = measured(60)
    assert report["moved"] > 0.0 and report["builds"] > 1
    assert growth(report["memory"][2:]) < SHORT_GROWTH


@pytest.mark.slow
def test_memory_over_a_thousand_steps_with_boundary_and_guiding() -> None:
    report = measured(1000)
    assert report["moved"] > 0.0 and report["builds"] > 3
    assert growth(report["memory"][50:]) < GROWTH


@pytest.mark.slow
def test_memory_over_a_thousand_steps_of_fit(tmp_path: Path) -> None:
    assert growth(measured(1000, write_fit(tmp_path))["memory"][50:]) < GROWTH
