"""Damaged files of the kernel cache: what they held is compiled again, and a line says so."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp

from warp_psdr import kernel_cache

ROOT = Path(__file__).resolve().parents[2]


@wp.kernel(module="unique", enable_backward=False)
def write_seven(out: wp.array(dtype=wp.float32)):
    out[wp.tid()] = 7.0


def cut(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def fill(path: Path) -> None:
    path.write_bytes(bytes(range(256)) * (path.stat().st_size // 256 + 1))


DAMAGES = {
    "an empty binary": (".o", lambda path: os.truncate(path, 0)),
    "a cut binary": (".o", cut),
    "another binary": (".o", fill),
    "a cut description": (".meta", cut),
    "another description": (".meta", fill),
}


@pytest.mark.parametrize("suffix, damage", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_module_is_compiled_again(suffix: str, damage, capsys: pytest.CaptureFixture) -> None:
    device, module = wp.get_device("cpu"), write_seven.module
    kernel_cache.load(module, device)
    folder = Path(wp.config.kernel_cache_dir) / module.get_module_identifier(1)
    (file,) = folder.glob(f"*{suffix}")
    damage(file)
    module.unload()
    capsys.readouterr()
    kernel_cache.load(module, device)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("warp_psdr: the kernel cache is damaged") and str(folder) in line
    out = wp.zeros(2, dtype=wp.float32, device="cpu")
    wp.launch(write_seven, dim=2, outputs=[out], device="cpu")
    assert out.numpy().tolist() == [7.0, 7.0]
    module.unload()
    kernel_cache.load(module, device)  # what was compiled is whole
    assert capsys.readouterr().err == ""


def test_what_cannot_be_compiled_is_no_damage(capsys: pytest.CaptureFixture) -> None:
    @wp.kernel(module="unique", enable_backward=False)
    def wrong(out: wp.array(dtype=wp.float32)):
        out[wp.tid()] = wp.vec3(1.0, 2.0, 3.0)

    with pytest.raises(Exception, match=r"vec3|float"):
        kernel_cache.load(wrong.module, wp.get_device("cpu"))
    assert "damaged" not in capsys.readouterr().err


#: A program that says nothing: no driver is asked for, so its absence is no news.
STARTS = """
import warp_psdr as psdr
node = {"type": "scene", "lamp": {"type": "rectangle", "emitter": {"type": "area", "radiance": 3.0}}}
print(psdr.load_dict(node, device="cpu").device)
try:
    psdr.load_dict(node, device="cuda:77")
except ValueError as error:
    print(error)
"""


def test_a_machine_without_a_gpu_is_told_of_one_only_if_it_is_asked_for() -> None:
    done = subprocess.run([sys.executable, "-c", STARTS], cwd=ROOT, capture_output=True, text=True, check=True)
    device, error = done.stdout.splitlines()
    assert device == "cpu" and "CUDA" not in done.stderr
    assert error.startswith("device: got 'cuda:77', this machine has 'cpu'")


#: A program that counts what it compiles itself of what a scene takes, after all others like it are ready.
COUNTS = """
import os, pathlib, sys, time
import numpy as np
import warp as wp
import warp_psdr as psdr
from warp._src import build
wp.config.log_level = wp.LOG_WARNING
compiled, build_cpu = 0, build.build_cpu
def counted(*arguments, **options):
    global compiled
    compiled += 1
    return build_cpu(*arguments, **options)
build.build_cpu = counted
wp.init()
folder = pathlib.Path(sys.argv[1])
(folder / str(os.getpid())).touch()
while len(list(folder.iterdir())) < int(sys.argv[2]):
    time.sleep(0.001)
node = {"type": "scene", "lamp": {"type": "rectangle", "emitter": {"type": "area", "radiance": 3.0}},
        "camera": {"type": "perspective", "to_world": psdr.Transform.look_at((0, 0, 4), (0, 0, 0), (0, 1, 0)),
                   "film": {"type": "hdrfilm", "width": 16, "height": 16}},
        "integrator": {"type": "path", "max_depth": 1}}
image = psdr.render(psdr.load_dict(node, device="cpu"), spp=1).numpy()
print(compiled, float(image.max()))
"""


@pytest.mark.slow
@pytest.mark.skipif(kernel_cache.fcntl is None, reason="this system has no locks that a process's end frees")
def test_processes_that_start_together_compile_each_module_once(tmp_path: Path) -> None:
    cache, ready = tmp_path / "cache", tmp_path / "ready"
    ready.mkdir()
    command = [sys.executable, "-c", COUNTS, str(ready), "3"]
    environment = os.environ | {"WARP_CACHE_PATH": str(cache)}
    started = [
        subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(3)
    ]
    said = [process.communicate(timeout=300)[0].split() for process in started]
    modules = len(list(cache.rglob("*.o")))
    assert len({brightest for _count, brightest in said}) == 1
    assert sum(int(count) for count, _brightest in said) == modules >= 3
