"""Equal seeds and histories give equal bits: for any number of workers, in any process, and after a reset.

What "history" means. Without guiding, an image, a gradient or a derivative image depends on the scene's values, the
options and the seed, and on nothing else. A guided boundary term also depends on the structure that earlier gradients
of the same scene left on it (``guiding/store.py``): it was built, and refreshed, with their seeds and at their values.
Either way the estimate is unbiased; what differs is its random error. So the same calls in the same order give equal
bits, and ``psdr.guiding.reset(scene)`` in front of a gradient makes it independent of what came before.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import warp_psdr as psdr
from tests.stability.bits import GUIDED, METHODS, MOVES, Bench, digest, history

ROOT = Path(__file__).resolve().parents[2]
#: Seconds after which a process that hangs is ended: a safety net.
PATIENCE = 900.0
#: Root mean square of the difference between devices, relative to that of the result: CPU and CUDA round the same
#: formulas differently (fused products, sin, exp, pow), and CUDA adds float32 in another order. Where a path decides by
#: a comparison, a last bit can send it another way: a sample in some thousands, with all that it brings.
DEVICES = 1e-2


@pytest.fixture(autouse=True)
def all_workers_afterwards():
    yield
    psdr.set_workers(None)


def equal_for_any_number_of_workers(method: str, numbers: tuple[int, ...]) -> list[str]:
    expected: list[str] = []
    for number in numbers:
        psdr.set_workers(number)
        found = history(Bench(method))
        expected = expected or found
        assert found == expected, f"{number} workers"
    assert len(set(expected)) == 3 * len(MOVES)
    return expected


@pytest.mark.slow
def test_equal_bits_for_any_number_of_workers() -> None:
    equal_for_any_number_of_workers("kdtree", (1, 3))


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_equal_bits_in_other_processes(method: str) -> None:
    """Other orders of sets and dictionaries, other threads of NumPy's linear algebra, other numbers of workers."""
    expected = equal_for_any_number_of_workers(method, (1, 2, 3, 7))
    for seed, workers, threads in (("0", "2", "1"), ("12345", "7", "2")):
        environment = os.environ | {"PYTHONHASHSEED": seed, "OPENBLAS_NUM_THREADS": threads}
        command = [sys.executable, "-m", "tests.stability.bits", method, workers]
        done = subprocess.run(
            command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=PATIENCE, check=False
        )
        assert done.returncode == 0, done.stderr[-2000:]
        assert json.loads(done.stdout.splitlines()[-1]) == expected


def independent_of_history(method: str) -> None:
    bench = Bench(method)
    fresh = [digest(*bench.gradients(0)), digest(bench.derivative(0))]
    again = [digest(*bench.gradients(0)), digest(bench.derivative(0))]
    assert again == fresh  # a structure at the same values is used as it is
    history(bench)
    bench.move(0.003)
    bench.gradients(5)
    bench.move(0.0)  # near to where the last structure was built: it is refreshed
    kept = [digest(*bench.gradients(0)), digest(bench.derivative(0))]
    assert (kept != fresh) == (method in GUIDED)
    psdr.guiding.reset(bench.scene)
    assert [digest(*bench.gradients(0)), digest(bench.derivative(0))] == fresh


@pytest.mark.slow
def test_kept_structures_are_history_and_can_be_forgotten() -> None:
    independent_of_history("kdtree")


@pytest.mark.slow
@pytest.mark.parametrize("method", [method for method in METHODS if method != "kdtree"])
def test_history_with_the_other_methods(method: str) -> None:
    independent_of_history(method)


@pytest.mark.gpu
@pytest.mark.parametrize("method", METHODS)
def test_devices_agree_within_rounding(method: str) -> None:
    results = []
    for device in ("cpu", "cuda:0"):
        bench = Bench(method, device)
        results.append([bench.image(0), *bench.gradients(0), bench.derivative(0)])
    for ours, theirs in zip(*results, strict=True):
        difference = np.sqrt(np.mean((ours - theirs) ** 2))
        assert difference < DEVICES * np.sqrt(np.mean(ours**2))
