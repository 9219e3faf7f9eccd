"""The table of methods tells the truth: papers, options, files and pages exist, and no method is missing."""

import inspect
import re
from pathlib import Path

import pytest

import warp_psdr as psdr
from warp_psdr.options.methods import Method

ROOT = Path(__file__).resolve().parents[1]
FAMILIES = {"interior": psdr.interior, "boundary": psdr.boundary, "guiding": psdr.guiding}


@pytest.mark.parametrize("method", psdr.methods(), ids=lambda m: m.option)
def test_a_method_is_what_and_where_it_says(method: Method) -> None:
    option = eval(method.option, vars(psdr))
    assert isinstance(option, FAMILIES[method.term].Method)
    assert (ROOT / method.file).is_file()
    page = (ROOT / method.page).read_text(encoding="utf-8")
    assert f"```{{about-method}} {method.option}\n" in page
    bibliography = (ROOT / "docs" / "references.bib").read_text(encoding="utf-8")
    assert f"{{{method.key},\n" in bibliography
    source = (ROOT / method.file).read_text(encoding="utf-8")
    assert re.search(rf"\[{re.escape(method.key)}[\],]", source), "the file cites its paper"


def test_no_method_is_missing() -> None:
    listed = {type(eval(method.option, vars(psdr))) for method in psdr.methods()}
    for family in FAMILIES.values():
        for value in vars(family).values():
            if inspect.isclass(value) and issubclass(value, family.Method) and not inspect.isabstract(value):
                assert value in listed or value is family.Method


def test_prints_as_a_table() -> None:
    text = repr(psdr.methods())
    assert len(text.splitlines()) == len(psdr.methods()) + 1
    assert all(method.file in text for method in psdr.methods())
    assert "[ZMY*20]" in text
    assert psdr.methods()._repr_html_().count("<tr>") == len(psdr.methods()) + 1
