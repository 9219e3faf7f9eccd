"""The examples of clusters: one runs on processes of this machine, and those that need others say what."""

import ast
import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

from warp_psdr import image_io

EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "cluster"


def run(name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)


@pytest.mark.slow
def test_local_cluster(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    done = run("local_cluster.py", "--steps", "6", "--output", str(tmp_path))
    assert done.returncode == 0, done.stderr[-2000:]
    assert "bits of one process: True" in done.stdout
    losses = [float(x) for x in re.findall(r"loss (\S+)", done.stdout)]
    assert losses[-1] < 0.7 * losses[0]
    errors = ast.literal_eval(done.stdout.splitlines()[-1])
    assert len(errors) == 2
    assert image_io.read_image(tmp_path / "walls.png", raw=True).std() > 0.1


def test_two_gpus_says_what_it_needs() -> None:
    if importlib.util.find_spec("dask_cuda") is not None:
        pytest.skip("dask-cuda is installed")
    done = run("two_gpus.py")
    assert done.returncode == 1 and "pip install 'warp-psdr[cluster]' dask-cuda" in done.stderr


def test_slurm_script_is_a_script_of_its_shell() -> None:
    subprocess.run(["bash", "-n", str(EXAMPLES / "slurm.sh")], check=True)
    text = (EXAMPLES / "slurm.sh").read_text(encoding="utf-8")
    assert "examples/cluster/local_cluster.py" in text
