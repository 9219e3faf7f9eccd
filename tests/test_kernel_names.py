"""Kernels have the same names, hence the same place in the cache, with a cold and with a warm cache."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PROGRAM = """
import numpy as np
import warp as wp
wp.config.log_level = wp.LOG_WARNING
import warp_psdr as psdr
camera = {"type": "perspective", "to_world": psdr.Transform.look_at((0, 0, 4), (0, 0, 0)),
          "film": {"type": "hdrfilm", "width": 2, "height": 2}}
lamp = {"type": "rectangle", "emitter": {"type": "area", "radiance": 3.0}}
scene = psdr.load_dict({"type": "scene", "camera": camera, "lamp": lamp, "point": {"type": "point"},
                        "card": {"type": "rectangle", "to_world": psdr.Transform.translate((0, 0, -1))}})
params = psdr.traverse(scene)
integrator = psdr.PathIntegrator(max_depth=2, boundary=None)
kernels = []
launch = wp.launch
def recorded(kernel, *arguments, **options):
    kernels.append(kernel.module.name)
    return launch(kernel, *arguments, **options)
wp.launch = recorded
psdr.render(scene, integrator=integrator, spp=1)
params.requires_grad("card.bsdf.reflectance.value", "lamp.emitter.radiance.value")
psdr.render_backward(scene, params, np.ones((2, 2, 3)), integrator=integrator, spp=1)
psdr.render_forward(scene, params, {"card.bsdf.reflectance.value": 1.0}, integrator=integrator, spp=1)
print(*sorted(set(kernels)))
"""


@pytest.mark.slow
def test_names_do_not_depend_on_what_was_cached(tmp_path: Path) -> None:
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path)}
    command = [sys.executable, "-c", PROGRAM]
    cold, warm = (
        subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True).stdout.split()
        for _ in range(2)
    )
    assert [any(part in name for name in cold) for part in ("replay", "forward")] == [True, True]
    assert warm == cold
