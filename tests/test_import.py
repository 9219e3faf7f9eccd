"""``import warp_psdr`` is light: Warp and NumPy, and everything else where it is used."""

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
HEAVY = ["matplotlib", "OpenEXR", "PIL", "pyvista", "rich", "scipy", "torch", "trimesh", "vtkmodules", "mitsuba"]


def test_importing_the_package_loads_none_of_its_modules() -> None:
    """Nor Warp: what a program uses is loaded when it uses it, and a wrong file name costs nothing."""
    code = "import sys; before = set(sys.modules); import warp_psdr; print(*sorted(set(sys.modules) - before))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = done.stdout.split()
    assert [m for m in loaded if m.startswith(("warp_psdr.", "warp."))] == []
    assert "warp_psdr" in loaded and "warp" not in loaded and "numpy" not in loaded


def test_public_names_are_functions_where_modules_have_the_same_name() -> None:
    code = "import warp_psdr.plan.plan, warp_psdr.render, warp_psdr.view.viewer, warp_psdr.accuracy.pilot\n"
    code += "import warp_psdr as psdr\nprint([callable(f) for f in (psdr.plan, psdr.render, psdr.view, psdr.accuracy)])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[True, True, True, True]"


def test_import_is_light() -> None:
    """That of the library, which all of these import, and of what draws and shows."""
    code = "import warp_psdr.cli, warp_psdr.plots, warp_psdr.view.viewer, json, sys\n"
    code += "print(json.dumps(sorted({m.split('.')[0] for m in sys.modules})))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    # Initialising Warp takes time and prints a banner; only the first use of a device should.
    line, *more = done.stdout.splitlines()
    assert (more, done.stderr) == ([], "")
    loaded = json.loads(line)
    assert "warp_psdr" in loaded
    assert [package for package in HEAVY if package in loaded] == []


def test_dir_lists_what_is_public() -> None:
    import warp_psdr as psdr

    assert dir(psdr) == sorted(psdr.__all__) and len(set(psdr.__all__)) == len(psdr.__all__)
    missing = [name for name in psdr.__all__ if not hasattr(psdr, name)]
    assert missing == []
    assert isinstance(psdr.load_dict(psdr.cornell_box()), psdr.Scene)


def test_rendering_needs_no_vtk_pyvista_or_torch(tmp_path: Path) -> None:
    code = f"""
import sys
for name in ("vtk", "vtkmodules", "pyvista", "torch"):
    sys.modules[name] = None  # an import of it fails
import warp_psdr as psdr
scene = psdr.load_dict(psdr.cornell_box())
params = psdr.traverse(scene)
params.requires_grad("white.reflectance.value")
print(psdr.plan(scene, params), params, scene)
image = psdr.render(scene, integrator={{"type": "path", "max_depth": 1}}, spp=1)
psdr.write_image({str(tmp_path / "box.png")!r}, image)
psdr.torch
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (tmp_path / "box.png").stat().st_size > 0, done.stderr[-2000:]
    assert done.returncode != 0 and "pip install torch" in done.stderr  # the last line's error says what to do
