"""How many loops over lanes become SIMD, by kernel, on eight lanes, too; ``test_simd.py`` names those that do not."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from warp_psdr.scene import acceleration

ROOT = Path(__file__).resolve().parents[2]
BOX = ROOT / "scenes" / "cornell_box.xml"
#: Loops over lanes in a kernel: camera rays, random numbers, surfaces, places, lights, estimates, directions, sums and
#: what is found out on the way; what is kept, and the sweep over it. Of eight lanes short loops are unrolled instead.
LOOPS = {
    **{"primal": {8: 10, 16: 12}, "replay": {8: 15, 16: 18}},
    **{"gold": {8: 10, 16: 12}, "coat": {8: 9, 16: 11}, "principled": {8: 11, 16: 15}},
    # Under a constant sky and without a bitmap they are 11 and 14: a map adds its own, a bitmap is read lane by lane.
    **{"sky": {8: 12, 16: 17}, "texture": {8: 10, 16: 13}},
}
COMPILE = """
import sys
import numpy as np
import warp as wp
wp.config.log_level = wp.LOG_ERROR
wp.config.kernel_cache_dir = sys.argv[2]
wp.config.cpu_compiler_flags += " -Rpass=loop-vectorize"
import warp_psdr as psdr
from warp_psdr.estimate import passes
from warp_psdr.kernels.primal import make_primal_kernel
scene = psdr.load_file(sys.argv[1], resolution=16)
if sys.argv[3] == "gold":
    gold = {"type": "roughconductor", "material": "Au", "distribution": "ggx"}
    lamp = {"type": "sphere", "emitter": {"type": "area"}, "bsdf": {"type": "diffuse"}}
    scene = psdr.load_dict({"type": "scene", "sensor": {"type": "perspective"}, "lamp": lamp,
                            "floor": {"type": "rectangle", "bsdf": gold}})
if sys.argv[3] == "principled":
    lamp = {"type": "sphere", "emitter": {"type": "area"}, "bsdf": {"type": "diffuse"}}
    scene = psdr.load_dict({"type": "scene", "sensor": {"type": "perspective"}, "lamp": lamp,
                            "floor": {"type": "rectangle", "bsdf": {"type": "principled"}},
                            "ball": {"type": "sphere", "bsdf": {"type": "roughdielectric"}}})
if sys.argv[3] in ("sky", "texture"):
    texels = np.full((4, 8, 3), 0.5, np.float32)
    light = {"type": "envmap", "bitmap": texels} if sys.argv[3] == "sky" else {"type": "constant"}
    paint = {"type": "bitmap", "data": texels} if sys.argv[3] == "texture" else 0.5
    scene = psdr.load_dict({"type": "scene", "sensor": {"type": "perspective"}, "light": light,
                            "floor": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": paint}}})
if sys.argv[3] == "coat":
    texels = np.full((2, 2, 3), 0.5, np.float32)
    waves = {"type": "normalmap", "normalmap": {"type": "bitmap", "data": texels, "raw": True},
             "bsdf": {"type": "roughplastic"}}
    lamp = {"type": "sphere", "emitter": {"type": "area"}, "bsdf": {"type": "diffuse"}}
    scene = psdr.load_dict({"type": "scene", "sensor": {"type": "perspective"}, "lamp": lamp,
                            "floor": {"type": "rectangle", "bsdf": waves},
                            "ball": {"type": "sphere", "bsdf": {"type": "plastic"}}})
names = [name for name in scene.parameters if name.endswith(("reflectance.value", "vertex_positions"))]
plan = psdr.plan(scene, names=names, integrator=psdr.PathIntegrator(max_depth=6, boundary=None))
replay = sys.argv[3] == "replay"
kernel = passes.camera_gradient_kernels(plan, "reverse")[0] if replay else make_primal_kernel(plan.config)
wp.load_module(kernel.module, device="cpu")
"""


@pytest.mark.slow
@pytest.mark.skipif(acceleration.host_width() < 8, reason="narrow vectors: the compiler may find SIMD not worth it")
@pytest.mark.parametrize("kernel", LOOPS)
def test_loops_over_lanes_become_simd(kernel, tmp_path):
    """Without it nothing would be wrong, and all of it slow; a refusal's reason is told by ``-Rpass-analysis``."""
    result = subprocess.run(
        [sys.executable, "-c", COMPILE, str(BOX), str(tmp_path), kernel], capture_output=True, text=True, cwd=ROOT
    )
    assert result.returncode == 0, result.stderr[-2000:]
    name = "replay" if kernel == "replay" else "primal"
    found = re.findall(rf"{name}\w*\.cpp:(\d+):\d+: remark: vectorized loop", result.stderr)
    assert len(found) >= LOOPS[kernel][acceleration.host_width()], result.stderr[-2000:]
