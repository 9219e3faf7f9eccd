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


def test_loop_runs_and_its_loss_falls(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    monkeypatch.chdir(ROOT)
    (code,) = [code for language, code in fences(README) if language == "python"]
    assert "range(30)" in code
    exec(compile(code.replace("range(30)", "range(14)"), "README.md", "exec"), {})
    losses = [float(x) for x in re.findall(r"loss (\S+)", capsys.readouterr().out)]
    assert len(losses) > 10
    # Half: the noise of the two images is a fifth of the loss at the start.
    assert np.mean(losses[-3:]) < 0.5 * np.mean(losses[:3])
