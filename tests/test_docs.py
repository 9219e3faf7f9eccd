"""The documentation keeps its promises: its commands and examples exist, its programs run, its tables are measured."""

import argparse
import ast
import importlib
import importlib.util
import inspect
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr import cli, image_io
from warp_psdr.scene.plugins import PLUGINS

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(path for path in DOCS.rglob("*.md") if "_build" not in path.parts)
METHOD_SECTIONS = ["Option", "How it works", "Covers and refuses", "Cost and accuracy", "Pitfalls"]
#: A device file's header is a title, a paragraph, and where the derivation is.
HEADER_LINES = 15
#: Letters of a line of code that a page shows without scrolling, in a window of 1400 pixels.
CODE_COLUMNS = 90
PAGES_WITH_CODE = [
    *("index.md", "start.md", "from_mitsuba.md", "pytorch.md", "cluster.md", "troubleshooting.md"),
    *("gallery.md", "simulate.md"),
]


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def slug(heading: str) -> str:
    """The anchor that MyST and GitHub give a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def headings(page: Path) -> list[str]:
    """Headings below the title, fenced blocks left out."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    return re.findall(r"^## (.+)$", text, re.MULTILINE)


def python_blocks(page: str) -> list[str]:
    text = (DOCS / page).read_text(encoding="utf-8")
    return re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def is_mitsubas(code: str) -> bool:
    """Whether a program is one of Mitsuba's, beside ours."""
    return re.search(r"\bmi\.", code) is not None


def needs_torch(code: str) -> bool:
    return "torch" in code


@pytest.mark.parametrize(
    "page", [p for p in sorted((DOCS / "methods").glob("*.md")) if p.stem != "index"], ids=lambda p: p.stem
)
def test_method_pages_follow_one_template(page: Path) -> None:
    assert headings(page) == METHOD_SECTIONS


@pytest.mark.parametrize("file", sorted((ROOT / "kernels").rglob("*.py")), ids=name)
def test_headers_of_device_files_are_short(file: Path) -> None:
    header = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
    assert len(header.splitlines()) <= HEADER_LINES, "move the derivation to docs/theory and name its section"


def test_headers_name_sections_that_exist() -> None:
    found = 0
    for folder in ("kernels", "warp_psdr"):
        for file in (ROOT / folder).rglob("*.py"):
            for page, anchor in re.findall(r"``(docs/\S+\.md)#(\S+?)``", file.read_text(encoding="utf-8")):
                assert anchor in map(slug, headings(ROOT / page)), f"{name(file)}: {page}#{anchor}"
                found += 1
    assert found > 10


def test_theory_names_files_that_exist() -> None:
    for page in (DOCS / "theory").glob("*.md"):
        for file in re.findall(r"^\*File: `(\S+)`\*$", page.read_text(encoding="utf-8"), re.MULTILINE):
            assert (ROOT / file).is_file(), f"{name(page)}: {file}"


def test_contributing_names_files_that_exist() -> None:
    for page in [ROOT / "CONTRIBUTING.md", *(DOCS / "contributing").glob("*.md")]:
        text = page.read_text(encoding="utf-8")
        for file in re.findall(r"`((?:kernels|warp_psdr|tests|docs|examples|scenes)/[\w/.*]+)`", text):
            assert list(ROOT.glob(file)), f"{name(page)}: {file}"


@pytest.mark.parametrize("file", sorted((DOCS / "data").glob("*.jsonl")), ids=lambda p: p.stem)
def test_measurements_say_where_they_were_made(file: Path) -> None:
    pages = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert f"```{{measured}} {file.stem}\n" in pages
    columns: dict[str, list[str]] = {}
    for line in file.read_text(encoding="utf-8").splitlines():
        row = json.loads(line)
        if file.stem.startswith("slopes"):  # equal on every machine
            assert re.fullmatch(r"[0-9a-f]{8}", row["commit"])
        else:
            assert {"cpu", "cores", "commit"} <= set(row["machine"])
        assert list(row) == columns.setdefault(row["table"], list(row))


def test_limits_are_one_page() -> None:
    assert len((DOCS / "limits.md").read_text(encoding="utf-8").split()) <= 900, "details go to reference/coverage.md"


@pytest.mark.parametrize("page", ["limits", "choosing", "concepts", "performance"])
def test_first_pages_hold_no_typed_slopes(page: str) -> None:
    assert "±" not in (DOCS / f"{page}.md").read_text(encoding="utf-8"), "slopes are lines of docs/data/slopes_*.jsonl"


def test_every_example_is_listed() -> None:
    text = (DOCS / "start.md").read_text(encoding="utf-8")
    for file in (ROOT / "examples").glob("*.py"):
        assert f"`{file.name}`" in text


def test_pictures_of_the_gallery_are_small_and_have_a_command() -> None:
    sections = (DOCS / "gallery.md").read_text(encoding="utf-8").split("\n## ")[1:]
    assert len(sections) > 10
    for section in sections:
        (script,) = re.findall(r"^python (\S+\.py)$", section, re.MULTILINE)
        assert (ROOT / script).is_file()
        pictures = re.findall(r"\]\((\.\./examples/pictures/\S+\.png)\)", section)
        assert pictures and "](" in section
        assert [name for name in pictures if (DOCS / name).stat().st_size >= 300_000] == []


def test_commands_exist() -> None:
    text = (DOCS / "start.md").read_text(encoding="utf-8")
    lines = re.findall(r"^warp-psdr .+$", text, re.MULTILINE)
    assert {"render", "gradient", "plan", "accuracy", "fit", "compile", "view"} <= {
        shlex.split(line, comments=True)[1] for line in lines
    }
    for line in lines:
        parsed = cli._parser().parse_args(
            shlex.split(line, comments=True)[1:]
        )  # ends the process where an option is unknown
        assert isinstance(parsed, argparse.Namespace)
        for argument in ("scene", "config"):
            assert (ROOT / getattr(parsed, argument, ".")).exists()


def test_first_program_runs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    monkeypatch.chdir(ROOT)
    code = python_blocks("start.md")[0]
    names: dict = {}
    exec(compile(code, "start.md", "exec"), names)
    assert np.abs(names["gradient"]).min() > 0.0
    assert np.abs(names["derivative"].numpy()).max() > 0.0
    assert "differentiated" in capsys.readouterr().out


def test_program_with_a_mesh_of_ones_own_runs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    corners = [(x, y, z) for z in (0.5, -0.5) for x, y in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))]
    sides = [(1, 2, 3, 4), (6, 5, 8, 7), (4, 3, 7, 8), (5, 6, 2, 1), (2, 6, 7, 3), (5, 1, 4, 8)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"]
    lines += [f"f {a}/1 {b}/2 {c}/3 {d}/4" for a, b, c, d in sides]
    Path("vase.obj").write_text("\n".join(lines) + "\n", encoding="utf-8")
    image_io.write_image("vase.png", (np.indices((8, 8)).sum(axis=0) // 2 % 2)[..., None] * [0.6, 0.3, 0.1] + 0.1)
    (code,) = [block for block in python_blocks("start.md") if "vase.obj" in block]
    for full, quick in (("range(40)", "range(12)"), ("spp=256", "spp=64"), ("96", "24"), ("72", "18")):
        assert full in code
        code = code.replace(full, quick)
    exec(compile(code, "start.md", "exec"), {})
    losses = [float(x) for x in re.findall(r"loss (\S+)", capsys.readouterr().out)]
    assert losses[-1] < 0.5 * losses[0]
    assert image_io.read_image("vase_texture.png").shape[:2] == (8, 8)


def test_program_with_a_pool_runs(tmp_path: Path) -> None:
    code = python_blocks("cluster.md")[0].replace("spp=256", "spp=8").replace('"local"', '"local", processes=2')
    (tmp_path / "program.py").write_text(code, encoding="utf-8")
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    command = [sys.executable, str(tmp_path / "program.py")]
    done = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert re.search(r"jobs +16, ", done.stdout)


@pytest.mark.slow
def test_commands_against_divergence_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    scene = psdr.load_file("scenes/cornell_box.xml", resolution=32)
    params = psdr.traverse(scene)
    params.requires_grad("red.reflectance.value", "small-box.vertex_positions")
    image, target = (psdr.render(scene, spp=4, seed=seed).numpy() for seed in (0, 1))
    names = {"np": np, "psdr": psdr, "scene": scene, "params": params, "image": image, "target": target, "step": 3}
    names |= {"adjoint": 2.0 * (image - target) / image.size, "integrator": psdr.PathIntegrator(max_depth=3)}
    names["optimizer"] = psdr.optim.Adam(params, lr=0.01)
    for code in python_blocks("troubleshooting.md"):
        for full, quick in (("spp=1024", "spp=64"), ("spp=256", "spp=16")):
            code = code.replace(full, quick)
        if "interior.compare" not in code:  # it compiles every method
            exec(compile(code, "troubleshooting.md", "exec"), names)
    assert np.isfinite(names["change"]).all()


@pytest.mark.parametrize("page", PAGES_WITH_CODE)
def test_code_is_not_wider_than_the_page(page: str) -> None:
    text = (DOCS / page).read_text(encoding="utf-8")
    for block in re.findall(r"^```(?:python|bash)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        assert [line for line in block.splitlines() if len(line) > CODE_COLUMNS] == []


@pytest.mark.parametrize("category", [c for c in PLUGINS if c != "scene"])
def test_every_plugin_is_listed(category: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # The site loads a scene with each; one that needs a parameter has it in ``docs/_ext/plugin_parameters.py``.
    monkeypatch.syspath_prepend(str(DOCS / "_ext"))
    plugins = importlib.import_module("plugin_parameters").plugins(category)
    assert [plugin.name for plugin in plugins] == list(PLUGINS[category])


@pytest.mark.parametrize("kind", ["bsdf", "texture", "emitter"])
def test_every_material_texture_and_light_has_a_small_picture(kind: str) -> None:
    """``python docs/_ext/swatches.py`` makes them; spectra are colours, and have none."""
    spectra = ("rgb", "srgb", "spectrum", "uniform", "rawconstant", "d65", "blackbody", "regular", "irregular")
    files = {file.stem: file for file in (DOCS / "swatches").glob(f"{kind}_*.png")}
    assert set(files) == {f"{kind}_{name}" for name in PLUGINS[kind] if name not in spectra}
    for file in files.values():
        assert file.stat().st_size < 24000
        picture = image_io.read_image(file, raw=True)
        assert picture.shape[:2] == (160, 160) and picture.std() > 0.02


def test_formulas_have_a_font_and_its_licence() -> None:
    """Without a MATH table integral signs have the size of text, and underbraces are dots."""
    static = DOCS / "_static"
    (font,) = re.findall(r'url\("(\S+\.woff2)"\)', (static / "site.css").read_text(encoding="utf-8"))
    assert (static / font).read_bytes().startswith(b"wOF2") and (static / font).stat().st_size < 500_000
    assert "SIL OPEN FONT LICENSE" in (static / font).with_suffix(".LICENSE").read_text(encoding="utf-8")


def test_the_api_lists_all_public_names_most_called_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(DOCS / "_ext"))
    api = importlib.import_module("api_names")
    modules = {name for name in psdr.__all__ if inspect.ismodule(getattr(psdr, name))}
    assert modules | {"torch"} == set(api.MODULES)
    names = [name for group in api.grouped(n for n in psdr.__all__ if n not in modules).values() for name in group]
    assert sorted(names) == sorted(set(psdr.__all__) - modules)
    assert names[:6] == ["load_file", "load_dict", "traverse", "render", "render_backward", "render_forward"]
    page = (DOCS / "reference" / "api.md").read_text(encoding="utf-8")
    assert re.findall(r"^```{api} (.+)$", page, re.MULTILINE) == [
        *api.GROUPS,
        *(f"psdr.{name}" for name in api.MODULES),
    ]


def test_the_api_shows_names_of_arguments_and_no_paths(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = inspect.signature(psdr.Transform.look_at)
    assert list(shown.parameters) == ["origin", "target", "up"]
    assert inspect.signature(psdr.Transform().rotate).return_annotation is psdr.Transform
    # What autodoc asks: of methods that are not static it drops the first argument.
    assert isinstance(vars(psdr.Transform)["look_at"], staticmethod)
    pytest.importorskip("sphinx")
    monkeypatch.syspath_prepend(str(DOCS / "_ext"))
    generated = importlib.import_module("generated")
    lines = generated._directive("warp_psdr.scenes", "cornell_box", psdr.scenes.cornell_box)
    assert "   :no-value:" in lines


def test_citation_has_the_fields_of_its_file() -> None:
    page = (DOCS / "reference" / "bibliography.md").read_text(encoding="utf-8")
    (entry,) = re.findall(r"^```bibtex\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    plain = entry.replace("{", "").replace("}", "")
    text = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    for field in re.findall(r"^(?:title|version|license|  - name): (.+)$", text, re.MULTILINE):
        assert field.strip('"') in plain


@pytest.mark.slow
def test_programs_beside_mitsubas_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    names: dict = {}
    for code in python_blocks("from_mitsuba.md"):
        if is_mitsubas(code) or needs_torch(code):
            continue
        names.pop("gradient", None)
        exec(compile(code, "from_mitsuba.md", "exec"), names)
        if "gradient =" in code:
            assert np.abs(names["gradient"]).max() > 0.0


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # PyTorch's compiler warns of what it does itself
def test_programs_with_pytorch_run(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch")
    monkeypatch.chdir(ROOT)
    names: dict = {}
    for code in python_blocks("pytorch.md"):
        exec(compile(code, "pytorch.md", "exec"), names)
    assert np.abs(names["gradient"].numpy()).max() > 0.0
    assert names["color"].grad.abs().max() > 0.0
    assert names["pose"].grad[0, 3].abs() > 0.0


@pytest.mark.slow
def test_programs_of_mitsuba_run() -> None:
    pytest.importorskip("mitsuba")
    # In a process of its own, which Dr.Jit ends where the system's LLVM is none that it works with.
    blocks = [code for code in python_blocks("from_mitsuba.md") if is_mitsubas(code)]
    if importlib.util.find_spec("torch") is None:
        blocks = [code for code in blocks if not needs_torch(code)]
    code = "\n".join(blocks)
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    if "LLVM ERROR" in done.stderr or "libLLVM" in done.stderr:
        pytest.skip("Mitsuba's variant llvm_ad_rgb does not work with this machine's LLVM")
    assert done.returncode == 0, done.stderr[-2000:]
