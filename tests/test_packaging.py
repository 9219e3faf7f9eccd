"""What is shipped: the wheel holds the library and nothing else, the sdist what is needed to work on it."""

import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

import warp_psdr

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = ["kernels", "warp_psdr", "docs", "tests", "examples", "scenes"]
TOP_FILES = ["pyproject.toml", "MANIFEST.in", "LICENSE", "README.md", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md"]
#: Not part of a distribution, and never copied: what tools leave behind.
LEFTOVERS = shutil.ignore_patterns("__pycache__", "*.py[cod]", "_build", "out", ".*")


@pytest.fixture(scope="module")
def distributions(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """(wheel, sdist), built from a clean copy without a network."""
    checkout = tmp_path_factory.mktemp("checkout")
    for folder in SHIPPED:
        shutil.copytree(ROOT / folder, checkout / folder, ignore=LEFTOVERS)
    for file in TOP_FILES:
        shutil.copy(ROOT / file, checkout / file)
    built = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(built), str(checkout)]
    done = subprocess.run(command, cwd=built, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return next(built.glob("*.whl")), next(built.glob("*.tar.gz"))


@pytest.fixture(scope="module")
def wheel_names(distributions: tuple[Path, Path]) -> set[str]:
    with zipfile.ZipFile(distributions[0]) as archive:
        return set(archive.namelist())


def sources(folder: str) -> set[str]:
    """Python files below a top-level folder, relative to it."""
    return {str(path.relative_to(ROOT / folder)) for path in (ROOT / folder).rglob("*.py")}


def test_wheel_holds_exactly_the_library(wheel_names: set[str]) -> None:
    # kernels/__init__.py is installed in place of the stand-in that finds it in a checkout.
    expected = {f"warp_psdr/kernels/{name}" for name in sources("kernels")}
    expected |= {f"warp_psdr/{name}" for name in sources("warp_psdr")}
    expected |= {f"warp_psdr/scene/lights/sky_tables.{ending}" for ending in ("npz", "LICENSE")}
    expected.add("warp_psdr/scene_files/cornell_box.xml")
    expected.add("warp_psdr/py.typed")  # the annotations are for type checkers of users, too
    assert {name for name in wheel_names if ".dist-info/" not in name} == expected


def test_wheel_ships_licences_version_and_command(distributions: tuple[Path, Path], wheel_names: set[str]) -> None:
    for file in ("LICENSE", "warp_psdr/scene/lights/sky_tables.LICENSE"):
        assert any(name.endswith(f".dist-info/licenses/{file}") for name in wheel_names)
    with zipfile.ZipFile(distributions[0]) as archive:
        metadata = archive.read(next(n for n in wheel_names if n.endswith(".dist-info/METADATA"))).decode()
        entry_points = archive.read(next(n for n in wheel_names if n.endswith("entry_points.txt"))).decode()
    assert "warp-psdr = warp_psdr.cli:main" in entry_points
    assert f"\nVersion: {warp_psdr.__version__}\n" in metadata
    assert "\nLicense-Expression: Apache-2.0 AND BSD-3-Clause\n" in metadata


def test_the_version_stands_in_one_place() -> None:
    """The citation's is a copy, for it is read without Python."""
    assert f"\nversion: {warp_psdr.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert "version" in tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dynamic"]


def test_a_package_index_would_take_both(distributions: tuple[Path, Path]) -> None:
    pytest.importorskip("twine")
    command = [sys.executable, "-m", "twine", "check", "--strict", *map(str, distributions)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert done.stdout.count("PASSED") == 2


def test_wheel_works_away_from_the_checkout(distributions: tuple[Path, Path], tmp_path: Path) -> None:
    with zipfile.ZipFile(distributions[0]) as archive:
        archive.extractall(tmp_path)
    code = "import warp_psdr.kernels.structs as s, warp_psdr as p; print(s.__file__); print(p.__file__)\n"
    code += "scene = p.load_file(p.scenes.cornell_box, resolution=8)\n"
    code += "print(p.scenes.cornell_box); assert p.render(scene, spp=4).numpy().mean() > 0.01"  # the README's kernel
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[:3] == [
        str(tmp_path / "warp_psdr" / "kernels" / "structs.py"),
        str(tmp_path / "warp_psdr" / "__init__.py"),
        str(tmp_path / "warp_psdr" / "scene_files" / "cornell_box.xml"),
    ]


def test_sdist_holds_the_whole_checkout(distributions: tuple[Path, Path]) -> None:
    with tarfile.open(distributions[1]) as archive:
        names = {name.split("/", 1)[1] for name in archive.getnames() if "/" in name}
    files = {
        str(path.relative_to(ROOT))
        for folder in SHIPPED
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and not LEFTOVERS(str(path.parent), path.relative_to(ROOT).parts)
    }
    assert (files | set(TOP_FILES)) - names == set()
    assert any(name.startswith("tests/") for name in names)


def test_every_package_is_listed() -> None:
    configured = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    found = {
        "warp_psdr." + ".".join(path.parent.relative_to(ROOT).parts) for path in (ROOT / "kernels").rglob("__init__.py")
    } | {".".join(path.parent.relative_to(ROOT).parts) for path in (ROOT / "warp_psdr").rglob("__init__.py")}
    found.add("warp_psdr.scene_files")  # the folder scenes, which is no Python
    assert set(configured["packages"]) == found
    assert configured["package-dir"] == {"warp_psdr.kernels": "kernels", "warp_psdr.scene_files": "scenes"}
