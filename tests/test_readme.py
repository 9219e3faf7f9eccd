"""The README keeps its promises: its commands exist, its pictures are there, its code runs."""

import argparse
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from warp_psdr import cli

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
#: Pictures that everyone downloads with the repository stay small, bytes.
PICTURE_BYTES = 300_000
SECOND_BLOCK = "python3 -m venv .venv && .venv/bin/pip install -e '.[test]' && .venv/bin/python -m pytest -n 2"


def section(title: str) -> str:
    """Text below a heading, up to the next of its level; there is exactly one such heading."""
    found = re.findall(rf"^## {re.escape(title)}$\n(.*?)(?=^## |\Z)", README, re.MULTILINE | re.DOTALL)
    assert len(found) == 1
    return found[0]


def fences(text: str) -> list[tuple[str, str]]:
    """(language, content) of every fenced block."""
    return re.findall(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def test_opens_with_a_picture_of_the_project() -> None:
    first = README.lstrip().splitlines()[0]
    assert re.fullmatch(r"!\[.+\]\(examples/pictures/\S+\.png\)", first)


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


def test_every_example_is_listed() -> None:
    for file in (ROOT / "examples").glob("*.py"):
        assert f"`{file.name}`" in README


def test_code_runs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    monkeypatch.chdir(ROOT)
    blocks = [code for language, code in fences(README) if language == "python"]
    assert blocks
    for code in blocks:
        names: dict = {}
        exec(compile(code, "README.md", "exec"), names)
        assert np.abs(names["gradient"]).min() > 0.0
        assert np.abs(names["derivative"].numpy()).max() > 0.0
        assert "differentiated" in capsys.readouterr().out


def test_commands_exist() -> None:
    lines = [line for _, text in fences(section("On the command line")) for line in text.splitlines() if line]
    assert {shlex.split(line)[1] for line in lines} == {"render", "gradient", "plan", "accuracy", "fit", "view"}
    for line in lines:
        program, *arguments = shlex.split(line)
        assert program == "warp-psdr"
        parsed = cli._parser().parse_args(arguments)  # ends the process where an option is unknown
        assert isinstance(parsed, argparse.Namespace)
        for name in ("scene", "config"):
            assert (ROOT / getattr(parsed, name, ".")).exists()
