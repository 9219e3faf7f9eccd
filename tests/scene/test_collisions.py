"""Media whose flights take too many tentative collisions are refused, on load and after edits, unless asked for."""

import struct
from pathlib import Path

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr import image_io
from warp_psdr.cli import main
from warp_psdr.fit.config import FitConfig
from warp_psdr.fit.run import load_problem

pytestmark = pytest.mark.filterwarnings("ignore:'camera' names no medium", "ignore:.* has an optical thickness")
DATA = "smoke.interior_medium.sigma_t.data"
SCALE = "smoke.interior_medium.scale"
POSE = "smoke.interior_medium.sigma_t.to_world"


def voxels(brightest: float, count: int = 5) -> np.ndarray:
    """Return thin smoke with one dense voxel."""
    values = np.full((count,) * 3, 0.1, np.float32)
    values[2, 2, 2] = brightest
    return values


def scene(values: np.ndarray, **medium) -> dict:
    box = np.diag([2.0, 2.0, 2.0, 1.0])
    box[:3, 3] = -1.0
    inside = {"type": "heterogeneous", "sigma_t": {"type": "gridvolume", "data": values, "to_world": box}, **medium}
    cube = {"type": "cube", "bsdf": {"type": "null"}, "interior": inside}
    return {"type": "scene", "camera": {"type": "perspective"}, "sky": {"type": "constant"}, "smoke": cube}


def test_one_dense_voxel_is_refused_with_its_cost() -> None:
    with pytest.raises(
        ValueError,
        match=r"'smoke.interior_medium': a ray through it takes up to 2.4e\+19 tentative collisions, some 2.4e\+11 s "
        r"for each path, which nothing interrupts: 'smoke.*sigma_t.data' reaches an extinction of 1.2e\+19 .*"
        r"max_collisions=5e\+19",
    ):
        psdr.load_dict(scene(voxels(1.2e19)))
    assert psdr.load_dict(scene(voxels(1.2e19)), max_collisions=1e20)
    for wrong in (0.0, -1.0, float("nan"), "1e8", True):
        with pytest.raises(ValueError, match=r"max_collisions: got .*, expected a positive number"):
            psdr.load_dict(scene(voxels(1.0)), max_collisions=wrong)


def test_only_the_cell_of_a_voxel_counts() -> None:
    # 40 voxels along an axis of length 2: a cell of 8 of them is 0.4 long, and the medium five times as much.
    assert psdr.load_dict(scene(voxels(2e7, 40)))
    with pytest.raises(ValueError, match=r"up to 1.2e\+07 tentative"):
        psdr.load_dict(scene(voxels(3e7, 40)))


@pytest.mark.parametrize("scale", [1.0, 1e9])
def test_what_is_as_dense_everywhere_costs_nothing(scale: float) -> None:
    assert psdr.load_dict(scene(np.ones((4, 4, 4), np.float32), scale=scale))


def test_edits_are_refused_too() -> None:
    held = psdr.load_dict(scene(voxels(1.0)))
    params = psdr.traverse(held)
    for name, value in ((DATA, voxels(1e8)[..., None]), (SCALE, 1e8), (POSE, np.diag([1e9, 1e9, 1e9, 1.0]))):
        before = params[name].numpy().copy()
        params[name] = value
        if name == POSE:  # no flight is longer than the scene
            params.update()
        else:
            with pytest.raises(ValueError, match=r"tentative collisions after an edit, .* max_collisions="):
                params.update()
        params[name] = before
        params.update()
    patient = psdr.load_dict(scene(voxels(1.0)), max_collisions=1e9)
    params = psdr.traverse(patient)
    params[DATA] = voxels(1e8)[..., None]
    params.update()


def test_microflakes_multiply_the_extinction() -> None:
    wide = {"type": "sggx", "S": [1e4, 1e4, 1e4, 0.0, 0.0, 0.0]}
    assert psdr.load_dict(scene(voxels(4e5)))
    with pytest.raises(ValueError, match="tentative collisions"):
        psdr.load_dict(scene(voxels(4e5), phase=wide))


FILE = """<scene version="3.0.0"><emitter type="constant"/><sensor type="perspective"><film type="hdrfilm">
<integer name="width" value="4"/><integer name="height" value="4"/></film></sensor>
<shape type="cube" id="smoke"><bsdf type="null"/><medium type="heterogeneous" name="interior">
<volume type="gridvolume" name="sigma_t"><string name="filename" value="smoke.vol"/></volume></medium></shape>
</scene>"""


@pytest.mark.filterwarnings("ignore:.* names no medium", "ignore:.* is not 0 at the border of its box")
def test_the_command_line_and_fits_may_wait(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "scene.xml").write_text(FILE)
    header = b"VOL" + struct.pack("<Biiiii6f", 3, 1, 5, 5, 5, 1, 0, 0, 0, 1, 1, 1)
    (tmp_path / "smoke.vol").write_bytes(header + voxels(1e9).tobytes())
    assert main(["plan", str(tmp_path / "scene.xml")]) != 0
    assert "--max-collisions" in capsys.readouterr().err
    assert main(["plan", str(tmp_path / "scene.xml"), "--max-collisions", "1e10"]) == 0
    image_io.write_image(tmp_path / "target.exr", np.zeros((4, 4, 3), np.float32))
    values = {"scene": "scene.xml", "targets": ["target.exr"], "output": "out", "parameters": {SCALE: {"lr": 0.1}}}
    with pytest.raises(ValueError, match="tentative collisions"):
        load_problem(FitConfig.from_mapping(values, folder=tmp_path))
    assert load_problem(FitConfig.from_mapping({**values, "max_collisions": 1e10}, folder=tmp_path))
    with pytest.raises(ValueError, match="max_collisions: got -1, expected a positive number"):
        FitConfig.from_mapping({**values, "max_collisions": -1}, folder=tmp_path)
