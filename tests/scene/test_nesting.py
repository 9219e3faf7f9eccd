"""Plugins nested without bound, by references or in dictionaries, are refused with their place, at once."""

import pytest

from warp_psdr.scene import describe_dict, describe_string

CAMERA = {"type": "perspective"}


def scene(inner: str):
    return describe_string(f'<scene version="3.0.0"><sensor type="perspective"/>\n{inner}</scene>')


def masks(count: int) -> str:
    """Return materials, each a mask of the one before, and a sphere of the last."""
    one = '<bsdf type="mask" id="b{}"><float name="opacity" value=".5"/><ref id="b{}"/></bsdf>\n'
    nested = "".join(one.format(k, k - 1) for k in range(1, count + 1))
    return f'<bsdf type="diffuse" id="b0"/>\n{nested}<shape type="sphere"><ref id="b{count}"/></shape>'


def blends(count: int) -> str:
    """Return materials, each a blend of the one before with itself."""
    one = '<bsdf type="blendbsdf" id="b{0}"><float name="weight" value=".5"/><ref id="b{1}"/><ref id="b{1}"/></bsdf>\n'
    nested = "".join(one.format(k, k - 1) for k in range(1, count + 1))
    return f'<bsdf type="diffuse" id="b0"/>\n{nested}<shape type="sphere"><ref id="b{count}"/></shape>'


def test_a_chain_of_references_through_materials() -> None:
    assert scene(masks(10)).shapes
    with pytest.raises(
        ValueError, match=r'string:66 <bsdf type="mask" id="b64">: plugins are nested more than 64 deep'
    ):
        scene(masks(320))


def test_references_that_double_at_every_level() -> None:
    assert scene(blends(4)).shapes
    with pytest.raises(ValueError, match=r'string:8 <bsdf type="blendbsdf" id="b6">: more than 64 bsdf plugins'):
        scene(blends(30))


def test_merged_shapes_that_double_at_every_level() -> None:
    inner = "".join(
        f'<shape type="merge" id="m{k}"><ref id="m{k - 1}"/><ref id="m{k - 1}"/></shape>' for k in range(1, 40)
    )
    with pytest.raises(ValueError, match=r'id="m19">: more than 1000000 shape plugins'):
        scene(f'<shape type="cube" id="m0"/>{inner}')


@pytest.mark.parametrize(
    "inner",
    [
        '<shape type="merge" id="m"><ref id="m"/></shape>',
        '<integrator type="moment" id="m"><ref id="m"/></integrator>',
        '<bsdf type="mask" id="a"><ref id="m"/></bsdf><bsdf type="mask" id="m"><ref id="a"/></bsdf>'
        '<shape type="cube"><ref id="a"/></shape>',
    ],
)
def test_plugins_that_contain_themselves(inner: str) -> None:
    with pytest.raises(ValueError, match=r"circular reference: this '(merge|moment|mask)' contains itself"):
        scene(inner)


def test_deep_dictionaries() -> None:
    node: dict = {"type": "diffuse"}
    for _level in range(20_000):
        node = {"type": "mask", "opacity": 0.5, "bsdf": node}
    with pytest.raises(ValueError, match="dictionaries are nested more than 64 deep; nest fewer"):
        describe_dict({"type": "scene", "s": {"type": "sphere", "bsdf": node}, "c": CAMERA})


def test_one_dictionary_in_many_places(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("warp_psdr.scene.files.dictionary.DICTIONARIES_MAX", 1000)
    node: dict = {"type": "diffuse"}
    for _level in range(30):
        node = {"type": "blendbsdf", "weight": 0.5, "a": node, "b": node}
    with pytest.raises(ValueError, match="more than 1000 dictionaries, each counted wherever it stands"):
        describe_dict({"type": "scene", "s": {"type": "sphere", "bsdf": node}, "c": CAMERA})
