"""The README keeps its promises: its commands exist, its pictures are there, its code runs, its table is the code's."""

import re
from pathlib import Path

import numpy as np
import pytest

import warp_psdr as psdr

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
#: Pictures that everyone downloads with the repository stay small, bytes.
PICTURE_BYTES = 300_000
#: One screen, more or less: numbers belong to docs/performance.md, exceptions to docs/limits.md.
MOST_LINES = 112
#: Noise of sixty steps of Adam on images of 32 samples a pixel, reflectance.
FOUND = 0.05
SECOND_BLOCK = "python3 -m venv .venv && .venv/bin/pip install -e '.[test]' && .venv/bin/python -m pytest -n 2"


def section(title: str) -> str:
    """Text below a heading, up to the next of its level; there is exactly one such heading."""
    found = re.findall(rf"^## {re.escape(title)}$\n(.*?)(?=^## |\Z)", README, re.MULTILINE | re.DOTALL)
    assert len(found) == 1
    return found[0]


def fences(text: str) -> list[tuple[str, str]]:
    """(language, content) of every fenced block."""
    return re.findall(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def test_says_what_it_is_and_shows_it() -> None:
    first, second = [line for line in README.splitlines() if line][:2]
    assert "physics-based differentiable renderer for inverse rendering" in first
    assert re.fullmatch(r"!\[.+\]\(examples/pictures/\S+\.png\)", second)
    assert len(README.splitlines()) <= MOST_LINES


def test_quick_start_has_two_blocks_of_commands() -> None:
    blocks = fences(section("Quick start"))
    assert [language for language, _ in blocks] == ["bash", "bash"]
    # .ci/run takes its command from here.
    assert blocks[1][1].strip() == SECOND_BLOCK


def test_quick_start_names_what_exists() -> None:
    first = fences(section("Quick start"))[0][1]
    scripts = re.findall(r"\S+\.py\b", first)
    assert scripts
    for script in scripts:
        assert (ROOT / script).is_file()


@pytest.mark.parametrize("target", sorted(set(re.findall(r"\]\((?!https?://)([^)#]+)\)", README))))
def test_links_lead_somewhere(target: str) -> None:
    file = ROOT / target
    assert file.is_file()
    if file.suffix == ".png":
        assert file.stat().st_size < PICTURE_BYTES


def test_methods_are_those_of_the_code() -> None:
    assert psdr.methods().markdown() in section("Methods")


def test_loop_finds_what_it_forgot(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)  # it needs no checkout
    (code,) = [code for language, code in fences(README) if language == "python"]
    names: dict = {}
    exec(compile(code, "README.md", "exec"), names)
    printed = capsys.readouterr().out
    losses = [float(x) for x in re.findall(r"loss (\S+)", printed)]
    # Half: the noise of the two images is a fifth of the loss at the start.
    assert np.mean(losses[-5:]) < 0.5 * np.mean(losses[:3])
    # All walls, and what is printed at the end is what is there.
    truth = psdr.traverse(psdr.load_file(psdr.scenes.cornell_box))
    for name in names["params"].requested:
        np.testing.assert_allclose(names["params"][name].numpy(), truth[name].numpy(), atol=FOUND)
    found, true = (np.fromstring(x, sep=" ") for x in re.findall(r"\[(.*?)\]", printed)[-2:])
    np.testing.assert_allclose(found, true, atol=FOUND)
