"""Kernels are compiled side by side, told of in one line, and named by ``psdr.compile``."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from warp_psdr import compiler
from warp_psdr.quiet import quiet
from warp_psdr.rows import table as interior
from warp_psdr.scene.acceleration import Accelerator

ROOT = Path(__file__).resolve().parents[2]
#: A process with an empty cache: emission alone, so that its kernels are few and small.
PROGRAM = """
import numpy as np
import warp_psdr as psdr
camera = {"type": "perspective", "to_world": psdr.Transform.look_at((0, 0, 4), (0, 0, 0), (0, 1, 0)),
          "film": {"type": "hdrfilm", "width": 2, "height": 2}}
lamp = {"type": "rectangle", "emitter": {"type": "area", "radiance": 3.0}}
scene = psdr.load_dict({"type": "scene", "camera": camera, "lamp": lamp,
                        "integrator": {"type": "path", "max_depth": 1}})
params = psdr.traverse(scene)
params.requires_grad("lamp.emitter.radiance.value")
report = psdr.compile(scene, params)
image = psdr.render(scene, spp=1)
psdr.render_backward(scene, params, np.ones((2, 2, 3)), spp=1)
print(len(report.compiled), float(image.numpy().mean()), params["lamp.emitter.radiance.value"].grad.numpy().sum())
print(len(psdr.compile(scene, params).compiled))
"""


def run(cache: Path) -> tuple[list[str], list[str]]:
    """Run the program, and return the lines that it writes to standard output and to standard error."""
    environment = os.environ | {"WARP_CACHE_PATH": str(cache)}
    command = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
    return done.stdout.splitlines(), [line for line in done.stderr.splitlines() if "CUDA" not in line]


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def cold_and_warm(cache):
    return run(cache), run(cache)


@pytest.mark.slow
def test_results_do_not_depend_on_the_cache(cold_and_warm) -> None:
    (cold, _), (warm, _) = cold_and_warm
    assert cold[0].split()[1:] == warm[0].split()[1:]


@pytest.mark.slow
def test_compile_names_what_it_has_compiled_and_leaves_nothing_to_do(cold_and_warm) -> None:
    (cold, _), (warm, _) = cold_and_warm
    assert int(cold[0].split()[0]) >= 2 and cold[1] == "0"
    assert int(warm[0].split()[0]) == 0


@pytest.mark.slow
def test_warp_writes_nothing_to_standard_output(cold_and_warm) -> None:
    assert [len(out) for out, _err in cold_and_warm] == [2, 2]  # the program's own lines


@pytest.mark.slow
def test_a_line_says_what_is_compiled_and_only_then(cold_and_warm) -> None:
    (_, cold), (_, warm) = cold_and_warm
    assert cold and all(line.startswith("warp_psdr: compiling ") for line in cold) and warm == []


@pytest.mark.slow
def test_headers_are_parsed_once_for_all_threads_and_processes(cold_and_warm, cache) -> None:
    (parsed,) = cache.rglob("*.pch")
    before = parsed.stat().st_mtime_ns
    for binary in cache.rglob("*.o"):
        binary.unlink()
    run(cache)
    assert [p.stat().st_mtime_ns for p in cache.rglob("*.pch")] == [before]


class Recorder:
    """A logger of the program's own."""

    def __init__(self):
        self.lines: list[str] = []

    def info(self, message: str) -> None:
        self.lines.append(message)

    debug = error = info

    def warning(self, message: str, category=None, stacklevel: int = 1) -> None:
        self.lines.append(message)


def test_the_program_s_logger_comes_back_and_hears_of_warnings(monkeypatch) -> None:
    monkeypatch.setattr(wp.config, "log_level", wp.LOG_INFO)
    before, recorder = wp.get_logger(), Recorder()
    wp.set_logger(recorder)
    try:
        with quiet():
            wp.get_logger().info("Module x load")
            wp.get_logger().warning("a warning")
        assert wp.get_logger() is recorder
        wp.get_logger().info("the program's own")
    finally:
        wp.set_logger(before)
    assert recorder.lines == ["a warning", "the program's own"]


def test_an_error_surfaces_where_the_kernel_is_needed() -> None:
    @wp.kernel(module="unique")
    def broken(values: wp.array(dtype=wp.float32)):
        values[wp.tid()] = undefined(1.0)  # noqa: F821

    device = wp.get_device("cpu")
    for _ in range(2):
        compiler.begin([broken], device)
        with pytest.raises(Exception, match="undefined"):
            compiler.ensure([broken], device)


@pytest.mark.parametrize(
    ("depth", "block", "blocks"), [(1, 4, 1), (4, 4, 1), (5, 8, 1), (8, 8, 1), (9, 8, 2), (17, 8, 4)]
)
def test_few_numbers_of_kept_vertices(depth: int, block: int, blocks: int) -> None:
    method = psdr.interior.Replay()
    kept = interior.row_of(method, None).keep(method, depth, 5)
    assert (kept.block, kept.blocks) == (block, blocks)


def test_the_kernels_of_a_ray_structure_share_a_module() -> None:
    points = wp.array(np.eye(3, dtype=np.float32), dtype=wp.vec3, device="cpu")
    kernels = Accelerator(points, wp.array(np.arange(3, dtype=np.int32), device="cpu"), "cpu", "wide").kernels()
    assert len(kernels) == 4 and len({k.module for k in kernels}) == 1


def test_the_line_says_how_many_kernels_why_and_about_how_long() -> None:
    with compiler.because("to try guiding for this repeated gradient"):
        line = compiler._line(3)
    assert line.startswith("warp_psdr: compiling 3 kernels to try guiding for this repeated gradient (first use; kept")
    assert re.search(r"about \d+ s$", line)
    assert compiler._line(1).startswith("warp_psdr: compiling 1 kernel (first use")
