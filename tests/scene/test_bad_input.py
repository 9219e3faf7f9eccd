"""Malformed scenes raise an error that names the place and the remedy, whatever is wrong."""

import pytest

from tests.scene import bad_input_cases, bad_material_cases
from warp_psdr.scene import describe_dict, describe_file, describe_string

CASES = [*bad_input_cases.CASES, *bad_material_cases.CASES]


def load(case, folder):
    for name, content in case.files.items():
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    if case.xml:
        (folder / "scene.xml").write_text(case.text())
        return describe_file(folder / "scene.xml")
    plugins = {"sensor": {"type": "perspective"}, "sky": {"type": "constant"}, **case.plugins}
    return describe_dict({"type": "scene", **{k: v for k, v in plugins.items() if v is not None}}, base=folder)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_malformed_scenes_name_place_and_remedy(case, tmp_path):
    with pytest.raises(case.error) as caught:
        load(case, tmp_path)
    assert isinstance(caught.value, (ValueError, FileNotFoundError))
    missing = [word for word in case.words if word not in str(caught.value)]
    assert not missing, f"message lacks {missing}: {caught.value}"


def test_every_case_differs():
    assert len({case.name for case in CASES}) == len(CASES) >= 45


def test_arguments_of_wrong_type_and_missing_files(tmp_path):
    with pytest.raises(TypeError, match="a scene is a dict"):
        describe_dict([])
    with pytest.raises(TypeError, match="text is a str"):
        describe_string(b"<scene/>")
    with pytest.raises(ValueError, match="wrap the scene"):
        describe_dict({"type": "cube"})
    with pytest.raises(FileNotFoundError, match="check the name"):
        describe_file(tmp_path / "none.xml")
    with pytest.raises(FileNotFoundError, match="it is a folder"):
        describe_file(tmp_path)


def test_unused_parameters_of_the_caller():
    xml = '<scene version="3.0.0"><default name="radius" value="1"/><sensor type="perspective"/></scene>'
    with pytest.raises(ValueError, match=r"'radios' \(did you mean 'radius'\?\)"):
        describe_string(xml, radios=3)
