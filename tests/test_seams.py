"""The doors: who may assemble what a path meets, ask what a ray meets, and step off a surface."""

import ast
import re
from pathlib import Path

import pytest

KERNELS = Path(__file__).resolve().parents[1] / "kernels"
#: What is called -> the only files that may, the one that defines it among them. Paths side by side are a closed
#: extension, which takes the steps of an interaction one by one.
DOORS = {
    "make_material": {"material.py", "interaction.py"},
    "make_surface_of": {"surface.py", "primitive/dispatch.py"},
    "make_surface_at": {"primitive/dispatch.py", "interaction.py"},
    "make_framing": {"interaction.py", "lanes/sweep_lanes.py"},
    "make_intersect": {"bvh/wide.py", "bvh/bundle.py", "visibility.py"},
}
#: Most parameters of a kernel that takes a job.
MOST_PARAMETERS = 8
FILES = {str(path.relative_to(KERNELS)): path.read_text() for path in sorted(KERNELS.rglob("*.py"))}


@pytest.mark.parametrize("name", DOORS)
def test_only_its_door_asks_for_it(name: str) -> None:
    assert {file for file, text in FILES.items() if re.search(rf"\b{name}\(", text)} == DOORS[name]


def test_models_are_named_in_their_folder_alone() -> None:
    for file, text in FILES.items():
        if not file.startswith("bsdf/"):
            assert not re.search(r"\b(BSDF_[A-Z]|DELTA_MODELS)", text), file


def test_rays_step_off_surfaces_in_one_place() -> None:
    # ``where(dot(n, d) >= 0, step, -step) * n``, however the step is called.
    pattern = re.compile(r"wp\.where\(wp\.dot\([^()]*\) >= 0\.0, (?P<step>[\w.]+), -(?P=step)\)")
    assert [file for file, text in FILES.items() if pattern.search(text)] == ["step.py"]


def test_kernels_take_jobs() -> None:
    found = 0
    for file, text in FILES.items():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef) and any("kernel" in ast.unparse(d) for d in node.decorator_list):
                names = [argument.arg for argument in node.args.args]
                assert "rr_depth" not in names or file in ("trace.py", "boundary/guiding/projective.py"), (file, names)
                if "job" in names:
                    found += 1
                    # Time bins are what a transient film asks for beside the job.
                    assert len(names) - ("gates" in names) <= MOST_PARAMETERS, (file, names)
    assert found >= 14
