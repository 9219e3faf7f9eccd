"""A scene that cannot be used raises one error with all that is wrong in it."""

import re

import pytest

from warp_psdr.scene import describe_dict, describe_string

HEAD = '<scene version="3.0.0">\n<sensor type="perspective" id="cam"/>\n<emitter type="constant" id="sky"/>\n'


def problems(load):
    """Return the lines of the message."""
    with pytest.raises((ValueError, FileNotFoundError)) as caught:
        load()
    return str(caught.value).splitlines()


def test_all_unsupported_plugins_and_parameters_are_named_with_their_lines():
    body = """<medium type="homogeneous" id="fog"><phase type="mie"/></medium>
<emitter type="collimated"/>
<bsdf type="measured" id="shiny"><texture type="wireframe" name="diffuse_reflectance"/></bsdf>
<shape type="sphere"><ref id="shiny"/><ref id="fog" name="interior"/><float name="radios" value="1"/></shape>
<shape type="cube"><ref id="shiny"/><float name="size" value="1"/><bogus/></shape>
<shape type="cube"><bsdf type="twosided"><bsdf type="hair"/></bsdf></shape>
<shape type="obj"><string name="filename" value="none.obj"/><boolean name="smooth" value="true"/></shape>
<shape type="cube"><bsdf type="diffuse"><rgb name="reflectance" value="5"/><float name="roughness" value="1"/></bsdf>
</shape></scene>"""
    first, *rest = problems(lambda: describe_string(HEAD + body))
    found = sorted(re.findall(r"string:(\d+) <\w+[^>]*>[^:]*: .*?(?:'[\w.]+'|<\w+>)", "\n".join(rest)), key=int)
    assert first == "string: 11 problems:" and len(rest) == 11
    expected = {
        4: "unsupported phase 'mie'",
        5: "unsupported emitter 'collimated'",
        6: "unsupported bsdf 'measured'",
        7: "no parameter 'radios' (did you mean 'radius'?)",
        8: "<bogus> is not supported",
        9: "unsupported bsdf 'hair'",
        10: "no such file: 'none.obj'",
        11: "between 0 and 1",
    }
    text = "\n".join(rest)
    for line, words in expected.items():
        assert re.search(rf"string:{line} [^\n]*{re.escape(words)}", text), (line, words, text)
    for words in ("unsupported texture 'wireframe'", "no parameter 'smooth'", "no parameter 'roughness'"):
        assert words in text
    assert found, text


def test_one_problem_is_its_own_message_and_missing_files_stay_missing_files():
    assert len(problems(lambda: describe_string(f'{HEAD}<shape type="cone"/></scene>'))) == 1
    files = '<shape type="obj"><string name="filename" value="{}.obj"/></shape>'
    with pytest.raises(FileNotFoundError, match=r"2 problems:\n.*'a\.obj'.*\n.*'b\.obj'"):
        describe_string(f"{HEAD}{files.format('a')}{files.format('b')}</scene>")


def test_dictionaries_name_all_of_it_too_and_a_shared_plugin_once():
    shiny = {"type": "measured"}
    scene = {
        "type": "scene",
        "sky": {"type": "timed_sunsky"},
        "shiny": shiny,
        "a": {"type": "cube", "bsdf": {"type": "ref", "id": "shiny"}, "wide": 1},
        "b": {"type": "sphere", "radius": -1.0, "center": "here", "bsdf": {"type": "ref", "id": "shiny"}},
    }
    text = "\n".join(problems(lambda: describe_dict(scene)))
    for words in (
        "unsupported emitter 'timed_sunsky'",
        "'wide'",
        "parameter 'radius'",
        "parameter 'center'",
        "5 problems",
    ):
        assert words in text
    assert text.count("measured") == 1


@pytest.mark.parametrize(
    ("scene", "right", "wrong"),
    [
        ({"type": "collimated"}, "supported emitter plugins: area", "prb_projective"),
        ({"type": "timed_sunsky"}, "give a 'sunsky' for each time", "did you mean"),
        ({"type": "distant"}, "supported sensor plugins: perspective", "did you mean"),
        ({"type": "difuse"}, "did you mean 'diffuse'", "unsupported emitter"),
        ({"type": "cube", "bsdf": {"type": "measured"}}, "supported bsdf plugins", "did you mean"),
    ],
)
def test_suggestions_are_of_the_same_kind(scene, right, wrong):
    text = "\n".join(problems(lambda: describe_dict({"type": "scene", "x": scene})))
    assert right in text and wrong not in text


def test_very_many_problems_end_the_load():
    lines = problems(lambda: describe_string(HEAD + '<shape type="cone"/>\n' * 500 + "</scene>"))
    assert lines[0] == "string: many problems, such as:" and len(lines) == 51


def test_limits_end_the_load_at_once():
    body = '<bsdf type="twosided">' * 100 + "</bsdf>" * 100
    assert "nested more than" in problems(lambda: describe_string(f'{HEAD}<shape type="cone"/>{body}</scene>'))[0]
