"""A model is one file and one row: what is added as ``docs/contributing/walks.md`` says has images and derivatives."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
MODEL = '''"""Minnaert's law of limb darkening: f_s = reflectance (k + 1) / (2 pi) (cos cos)^(k - 1)."""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.diffuse import diffuse_pdf
from warp_psdr.kernels.bsdf.model import Color, Functions, Model, Number
from warp_psdr.kernels.constants import INV_TWO_PI, LOBE_NONE, LOBE_SMOOTH
from warp_psdr.kernels.math import where3
from warp_psdr.kernels.sampling import square_to_cosine_hemisphere
from warp_psdr.kernels.structs import BsdfSample


@functools.cache
def make_minnaert(record: type, _variant: str) -> Functions:
    @wp.func
    def minnaert_eval(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        above = not (wi[2] <= 0.0 or wo[2] <= 0.0)
        both = wp.where(above, wi[2] * wo[2], 1.0)
        size = INV_TWO_PI * (mat.k + 1.0) * wp.pow(both, mat.k - 1.0) * wo[2]
        return where3(above, size * mat.reflectance, wp.vec3(0.0, 0.0, 0.0))

    @wp.func
    def minnaert_pdf(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        return diffuse_pdf(wi, wo)

    @wp.func
    def minnaert_sample(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> BsdfSample:
        s = BsdfSample()
        s.eta = 1.0
        s.wo = square_to_cosine_hemisphere(v)
        s.pdf = diffuse_pdf(wi, s.wo)
        s.value = minnaert_eval(mat, wi, s.wo)
        s.lobe = wp.where(s.pdf > 0.0, LOBE_SMOOTH, LOBE_NONE)
        return s

    return Functions(minnaert_sample, minnaert_eval, minnaert_pdf)


MINNAERT = Model(
    "minnaert", (Color("reflectance", 0.5), Number("k", 0.0, 10.0, default=1.0)), (LOBE_SMOOTH,), make_minnaert
)
'''
PROGRAM = """
import json, sys
import numpy as np
import warp_psdr as psdr

film = {"type": "hdrfilm", "width": 2, "height": 2, "rfilter": {"type": "box"}}
view = psdr.Transform.look_at([0, 0, 2], [0, 0, 0], [0, 1, 0])
plane = {"type": "rectangle", "bsdf": {"type": "minnaert", "k": 1.7, "reflectance": 0.4}}
sun = {"type": "directional", "direction": [0.6, 0.0, -0.8], "irradiance": 2.0}
sensor = {"type": "orthographic", "to_world": view, "film": film}
scene = psdr.load_dict({"type": "scene", "sensor": sensor, "plane": plane, "sun": sun})
params = psdr.traverse(scene)
names = [name for name in params if name.startswith("plane.bsdf")]
params.requires_grad(*names)
options = {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 1}
image = psdr.render(scene, **options).numpy()
psdr.render_backward(scene, params, np.full((2, 2, 3), 1.0 / 12.0, np.float32), **options)
slopes = {name: float(params[name].grad.numpy().sum()) for name in names}
json.dump({"image": float(image.mean()), "slopes": slopes}, sys.stdout)
"""


def test_a_file_and_a_row_add_a_model(tmp_path: Path) -> None:
    for folder in ("kernels", "warp_psdr"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    (tmp_path / "kernels/bsdf/minnaert.py").write_text(MODEL)
    dispatch = tmp_path / "kernels/bsdf/dispatch.py"
    table = "MODELS: tuple[Model, ...] = ("
    text = dispatch.read_text()
    assert text.count(table) == 1
    first, rest = text.split(table)
    row = "from warp_psdr.kernels.bsdf.minnaert import MINNAERT\n"
    dispatch.write_text(f"{first}{table}\n    MINNAERT,{rest}".replace("\nfrom warp_psdr", f"\n{row}from warp_psdr", 1))
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout.splitlines()[-1])
    k, cosine = 1.7, 0.8
    radiance = 2.0 * 0.4 * (k + 1.0) / (2.0 * np.pi) * cosine**k
    by_k = radiance * (1.0 / (k + 1.0) + np.log(cosine))
    assert np.isclose(found["image"], radiance, rtol=1e-5)
    slopes = found["slopes"]
    assert set(slopes) == {"plane.bsdf.reflectance.value", "plane.bsdf.k.value"}
    assert np.isclose(slopes["plane.bsdf.reflectance.value"], radiance / 0.4, rtol=1e-4)
    assert np.isclose(slopes["plane.bsdf.k.value"], by_k, rtol=1e-4)
