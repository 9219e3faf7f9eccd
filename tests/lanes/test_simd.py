"""Loops over lanes become SIMD: those that the compiler refuses are listed here by name, and no other may be.

A refusal makes nothing wrong, and all of it slow. Its reason is told by ``-Rpass-analysis=loop-vectorize``.
"""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from warp_psdr.scene import acceleration

ROOT = Path(__file__).resolve().parents[2]
BENCHMARKS = ROOT / "examples" / "benchmarks"
#: What goes lane by lane, and why.
SCALAR = {
    "make_lane_paths.start": "samples are counted one after the other",
    "make_lane_paths.trace": "a ray walks a tree",
    "make_lane_paths.look": "the same",
    "make_place_lanes.collect": "few rays meet a light",
    "make_kept_lanes.put": "a vertex is a record of its own",
    "make_passage.passage": "a shadow ray passes surfaces",
    "make_chosen.chosen": "a path meets what matters, or not",
    "make_sweep_of_each.sweep_all": "paths are swept one by one",
    "make_forward_of_each.begin": "what travels with a path is a record of its own",
    "make_forward_of_each.differentiate": "paths are differentiated one by one",
    "make_transmittance_sink.accumulate_transmittance": "surfaces are crossed one by one",
    "make_material_forward.move": "a vertex looks its own values up",
}
#: Not loops over lanes: queries in C++, and what calls the kernels.
OTHERS = re.compile(r".*(_wide\d+$|_cpu_)")
CASES = (
    "Cornell box",
    "gold under a sky",
    "textured mesh under a sky",
    "twelve plastics",
    "principled spheres",
    "masked leaves",
    "rough glass",
    "normal-mapped floor",
    "mixed",
    "100 lights",
)
COMPILE = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
import warp as wp
wp.config.log_level = wp.LOG_ERROR
wp.config.kernel_cache_dir = sys.argv[2]
wp.config.cpu_compiler_flags += " -Rpass-missed=loop-vectorize -Rpass=loop-vectorize"
import warp_psdr as psdr
from common import ROOT
from material_scenes import MATERIALS, write_maps
from scenes import write_data
from warp_psdr.estimate import passes
from warp_psdr.kernels.primal import make_primal_kernel
folder = Path(sys.argv[2])
write_data(folder)
write_maps(folder)
case, what = sys.argv[3:]
file = MATERIALS[case].write(folder, case) if case in MATERIALS else ROOT / "scenes" / "cornell_box.xml"
scene = psdr.load_file(file, resolution=16)
ends = ("vertex_positions",) if what == "motion" else ()
names = [n for n in scene.parameters if n.endswith(ends) or (not ends and ".bsdf." in n and not n.endswith("to_uv"))]
integrator = psdr.PathIntegrator(max_depth=6, sampler="sobol", boundary=None, interior=psdr.interior.Replay())
plan = psdr.plan(scene, names=names, integrator=integrator)
role = "forward" if what == "forward" else "reverse"
kernel = make_primal_kernel(plan.config) if what == "image" else passes.camera_gradient_kernels(plan, role)[0]
wp.load_module(kernel.module, device="cpu")
"""


def remarks(case: str, what: str, folder: Path) -> tuple[set[str], set[str]]:
    """Return the functions that have a loop over lanes as SIMD, and those that have one which is refused."""
    command = [sys.executable, "-c", COMPILE, str(BENCHMARKS), str(folder), case, what]
    result = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert result.returncode == 0, result.stderr[-2000:]
    found, lines = (set(), set()), {}
    for name, line, refused in re.findall(
        r"/(\w+\.cpp):(\d+):\d+: remark: (?:vectorized loop|(loop not vectorized) \[)", result.stderr
    ):
        if name not in lines:
            lines[name] = next(folder.glob(f"*/*/{name}")).read_text().split("\n")
        # A refusal may stand at a branch of a function that the loop calls.
        heads = (re.match(r"static .*?(\w+)\(", text) for text in reversed(lines[name][: int(line)]))
        function = re.sub(r"_\d+$", "", next((head[1] for head in heads if head), "")).replace("__locals__", ".")
        if function and not OTHERS.match(function):
            found[bool(refused)].add(function)
    return found


@pytest.mark.slow
@pytest.mark.skipif(acceleration.host_width() < 16, reason="narrow vectors: the compiler may find SIMD not worth it")
@pytest.mark.parametrize(
    ("case", "what"),
    [
        *((case, "image") for case in CASES),
        ("Cornell box", "motion"),
        *((case, what) for case in CASES[1:] for what in ("gradient", "forward")),
    ],
)
def test_no_other_loop_is_refused(case: str, what: str, tmp_path: Path) -> None:
    simd, refused = remarks(case, what, tmp_path)
    assert {"make_place_lanes.stand", "make_lane_paths.advance"} <= simd
    assert not refused - set(SCALAR)
