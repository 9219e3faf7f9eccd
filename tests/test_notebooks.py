"""What notebooks show of images, plans, parameters and reports."""

import io
import json
import math
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from PIL import Image as Picture

import warp_psdr as psdr
from warp_psdr.accuracy.report import Report, TermReport
from warp_psdr.estimate.compile import Compilation
from warp_psdr.fit.run import FitResult
from warp_psdr.image import Image
from warp_psdr.image_io import linear_to_srgb

NAME = "white.reflectance.value"


@pytest.fixture(scope="module")
def box():
    scene = psdr.cornell_box()
    scene["sensor"]["film"] |= {"width": 6, "height": 4}
    scene = psdr.load_dict(scene)
    params = psdr.traverse(scene)
    params.requires_grad("*.reflectance.value")  # the kernels of docs/start.md
    return scene, params


class Cells(HTMLParser):
    """Collects the texts of cells, and whether every tag is closed."""

    def __init__(self, text: str):
        super().__init__()
        self.texts: list[str] = []
        self.open: list[str] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)


def test_an_image_is_a_warp_array_that_shows_itself(box) -> None:
    scene, params = box
    image = psdr.render(scene, spp=4)
    assert isinstance(image, psdr.Image) and isinstance(image, wp.array)
    assert image.shape == (4, 6) and image.dtype is wp.vec3
    shown = np.asarray(Picture.open(io.BytesIO(image._repr_png_())))
    factor = shown.shape[0] // 4
    assert factor > 1 and shown.shape == (4 * factor, 6 * factor, 3), "small images are enlarged"
    expected = 255.0 * linear_to_srgb(image.numpy())
    np.testing.assert_allclose(shown[::factor, ::factor], expected, atol=0.51)
    change = psdr.render_forward(scene, params, {NAME: 1.0}, spp=1)
    signed = Picture.open(io.BytesIO(change._repr_png_()))
    assert signed.width > 6 * factor / 2 and change.signed and not image.signed


def test_kernels_and_tapes_take_images(box) -> None:
    scene, _params = box
    image = psdr.render(scene, spp=1)
    image.requires_grad = True
    target = Image((4, 6), scene.device)
    assert not target.numpy().any()
    with wp.Tape() as tape:
        loss = psdr.losses.l2(image, target)
    tape.backward(loss)
    np.testing.assert_allclose(image.grad.numpy(), 2.0 * image.numpy() / image.numpy().size, rtol=1e-5)


def test_a_loss_shows_its_value(box) -> None:
    scene, _params = box
    image = psdr.render(scene, spp=1)
    loss = psdr.losses.l2(image, np.zeros((4, 6, 3), np.float32))
    value = float(np.mean(image.numpy().astype(np.float64) ** 2))
    assert isinstance(loss, wp.array) and loss.shape == (1,)
    assert float(loss) == pytest.approx(value, rel=1e-5)
    assert f"{loss:.3f}" == f"{value:.3f}" and repr(loss) == f"<loss {float(loss):.6g}, wp.array of shape (1,)>"
    assert float(psdr.losses.total(loss, (1.0, loss))) == pytest.approx(2.0 * value, rel=1e-5)


def test_a_derivative_picture_shows_itself(tmp_path) -> None:
    path = tmp_path / "derivative.png"
    shown = psdr.plots.derivative_image(path, np.linspace(-1.0, 2.0, 12).reshape(3, 4), limit=1.5)
    assert shown == 1.5 and shown._repr_png_() == path.read_bytes()
    assert psdr.plots.derivative_image(io.BytesIO(), np.ones((3, 4)), limit=1.5)._repr_png_() is None


def test_scenes_are_tables(box) -> None:
    scene, _params = box
    texts = Cells(scene._repr_html_()).texts
    assert repr(scene) == texts[0]
    assert {"red-wall", "rectangle", "light", "area", "sensor", "6 x 4", "64"} <= set(texts)


def test_fits_show_their_outcome_and_their_pictures(tmp_path) -> None:
    result = FitResult(
        parameters={"<red>": np.array([0.25, 0.75])},
        losses=np.array([0.5, 0.25]),
        completed=True,
        output=tmp_path,
        psnr=(30.0, 31.5),
        invalid={"image": 0, "gradient": 2},
    )
    line = "2 steps; loss 0.5 -> 0.25; PSNR of the views 30.0, 31.5 dB; 2 samples were not finite; results in"
    assert repr(result) == f"<FitResult: {line} {tmp_path}>"
    assert Cells(result._repr_html_()).texts[1:] == [
        *("parameter", "shape", "least", "mean", "most"),
        *("<red>", "2", "0.25", "0.5", "0.75"),
    ]
    (tmp_path / "views.png").write_bytes(b"picture")
    assert "data:image/png;base64,cGljdHVyZQ==" in result._repr_html_()


def test_compilations_and_comparisons_keep_their_columns() -> None:
    done = Compilation((), 0.5)
    assert Cells(done._repr_html_()).texts == [str(done)]


def test_plans_and_parameters_are_tables(box) -> None:
    scene, params = box
    plan = psdr.plan(scene, params)
    texts = Cells(plan._repr_html_()).texts
    assert texts == ["decision", "reason", *(text for line in plan.lines for text in line)]
    texts = Cells(params._repr_html_()).texts
    assert all(name in texts for name in params) and texts.count("requested") == len(params.requested) > 1


def test_reports_keep_their_columns() -> None:
    term = TermReport(
        name="interior <a>", spp=4, samples=96, seconds=0.2, seconds_error=0.01, fixed_seconds=0.1,
        sample_seconds=0.01, setup_seconds=0.0, variance={"image": 1.0}, variance_error={"image": 0.1},
        exponent=math.nan, exponent_error=math.nan, largest=0.1, kurtosis=3.0,
    )  # fmt: skip
    report = Report(
        role="primal", clock="wall", batches=4, pilot_seconds=1.0, terms=(term,), norm2={"image": 2.0},
        norm2_error={"image": 0.1}, seen=("image",), spread=0.1,
    )  # fmt: skip
    assert "".join(Cells(report._repr_html_()).texts) == str(report)


NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "docs" / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_notebooks_are_kept_without_outputs(file: Path) -> None:
    """The documentation's build runs them: what is shown was computed by the code of that build."""
    notebook = json.loads(file.read_text(encoding="utf-8"))
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert len(code) >= 4
    for cell in code:
        assert cell["outputs"] == [] and cell["execution_count"] is None
        compile("".join(cell["source"]), file.name, "exec")
        # Longer lines do not fit the page.
        assert max(map(len, "".join(cell["source"]).splitlines())) <= 90
    index = (file.parents[1] / "index.md").read_text(encoding="utf-8")
    assert f"notebooks/{file.stem}\n" in index
    assert f"{{nb-download}}`{file.name}`" in "".join(notebook["cells"][0]["source"])
