"""Views as pages for browsers, and what notebooks show of a view."""

import html
import io
import re
import shutil
import subprocess
import sys
from importlib.util import find_spec

import numpy as np
import pytest
from PIL import Image

import warp_psdr as psdr
from warp_psdr.cli import main
from warp_psdr.view.viewer import view

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
needs_vtk_js = pytest.mark.skipif(find_spec("trame_vtk") is None, reason="needs trame-vtk: pip install -e '.[html]'")
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium")
SIZE = (320, 240)


@pytest.fixture(scope="module")
def scene():
    return psdr.load_dict(
        {
            "type": "scene",
            "ball": {"type": "cube", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8] * 3}}},
            "sky": {"type": "constant"},
            "camera": {
                "type": "perspective",
                "to_world": psdr.Transform.look_at(origin=[4, 5, 6], target=[0, 0, 0], up=[0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 8, "height": 6},
            },
        }
    )


@pytest.fixture(scope="module")
def drawn(scene):
    """A view of gradients: 0.026 along x on one half, less on the other."""
    name = "ball.vertex_positions"
    values = psdr.traverse(scene)[name].numpy()
    gradient = np.where(values[:, :1] > 0, [[0.026, 0.0, 0.0]], [[0.0, -0.013, 0.0]])
    return view(scene, fields={name: gradient}, screenshot=None, window_size=SIZE, percentile=100.0)


def in_chromium(page, *options: str) -> str:
    """Open a page without a network, and return what Chromium prints."""
    command = [CHROMIUM, "--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader"]
    command += ["--enable-unsafe-swiftshader", "--hide-scrollbars", "--virtual-time-budget=8000"]
    command += ["--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={page.parent / 'profile'}"]
    done = subprocess.run([*command, *options, page.as_uri()], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@needs_vtk_js
@needs_chromium
def test_a_page_shows_the_scene_and_its_true_range(drawn, tmp_path) -> None:
    page = tmp_path / "view.html"
    drawn.html(page)
    shot = tmp_path / "shot.png"
    in_chromium(page, "--window-size=800,600", f"--screenshot={shot}")
    tree = in_chromium(page, "--dump-dom")
    tree = tree[tree.index("<body>") : tree.index("<script>")]
    texts = [html.unescape(text) for text in re.findall(r"<(?:span|figcaption|div)[^>]*>([^<>]+)<", tree)]
    assert "ball.vertex_positions" in texts and {"0.026", "0.013", "0", "-0.013", "-0.026"} <= set(texts)
    assert any("per world unit" in text for text in texts) and "null" not in texts
    assert tree.count("<canvas") == 1
    pixels = np.asarray(Image.open(shot).convert("RGB")).astype(int)
    canvas = pixels[40:500, 20:600]
    # The cube is there: its faces, red where they grow outwards, on the grey of the page.
    background = np.abs(canvas - canvas[5, 5]).max(axis=2) < 8
    assert 0.2 < background.mean() < 0.95
    assert ((canvas[..., 0] - canvas[..., 2]) > 30).mean() > 0.02
    # The colour bar beside it: red above, blue below.
    bar = pixels[:, 640:].reshape(len(pixels), -1, 3)
    red, blue = (np.argwhere((sign * (bar[..., 0] - bar[..., 2])) > 60)[:, 0] for sign in (1, -1))
    assert len(red) and len(blue) and red.max() < blue.min()


@needs_vtk_js
def test_pages_hold_all_that_they_need(scene, drawn, tmp_path) -> None:
    page = tmp_path / "view.html"
    drawn.html(page)
    text = page.read_text(encoding="utf-8")
    assert not re.search(r"<(?:script|link|img|iframe)[^>]+(?:src|href)=", text)
    assert text.count('class="scene"') == 1 and "0.026" in text
    plain = view(scene, window_size=SIZE)
    plain.html(tmp_path / "plain.html")
    assert "figcaption>" not in (tmp_path / "plain.html").read_text(encoding="utf-8")
    assert plain._repr_html_().startswith("<iframe")
    plain.close()
    with pytest.raises(ValueError, match=r"does not end in \.html"):
        drawn.html(tmp_path / "view.txt")


@needs_vtk_js
def test_the_command_writes_a_page(tmp_path, capsys) -> None:
    page = tmp_path / "box.html"
    assert main(["view", "scenes/cornell_box.xml", "--html", str(page)]) == 0
    assert f"wrote {page}" in capsys.readouterr().out and page.stat().st_size > 100_000
    assert main(["view", "scenes/cornell_box.xml", "--html", str(tmp_path / "box.png")]) == 2
    assert "expected .html" in capsys.readouterr().err


def test_without_vtk_js_notebooks_get_a_picture(drawn, tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "trame_vtk", None)
    assert drawn._repr_html_() is None
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'warp-psdr\[html\]'"):
        drawn.html(tmp_path / "view.html")
    assert not list(tmp_path.iterdir())
    picture = Image.open(io.BytesIO(drawn._repr_png_()))
    assert picture.width > SIZE[0] and len(np.unique(np.asarray(picture).reshape(-1, 3), axis=0)) > 50
    assert drawn.renderers is drawn.plotter.renderers
