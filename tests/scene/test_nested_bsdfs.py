"""Models made of models: how files give them, their names, their sides, their keys."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.peer import for_mitsuba
from warp_psdr.kernels.bsdf.composite import split_key
from warp_psdr.kernels.bsdf.dispatch import MODELS, declaration_of, make_bsdf, models_of, ordered
from warp_psdr.kernels.bsdf.model import key_of

RED, BLUE = (
    {"type": "diffuse", "reflectance": {"type": "rgb", "value": c}} for c in ([0.8, 0.1, 0.1], [0.1, 0.1, 0.8])
)
BRUSHED = {"type": "roughconductor", "alpha_u": 0.1, "alpha_v": 0.3}


def blend(a=RED, b=BLUE, weight=0.25):
    return {"type": "blendbsdf", "weight": weight, "z": a, "a": b}


def load(bsdf: dict):
    return psdr.load_dict({
        "type": "scene", "camera": {"type": "perspective"}, "sky": {"type": "constant"},
        "x": {"type": "rectangle", "bsdf": bsdf},
    })  # fmt: skip


def test_keys_are_read_as_they_are_written() -> None:
    inner = key_of("blendbsdf", children=("diffuse", "roughconductor (ggx)"))
    for key in (inner, key_of("blendbsdf", "some variant", (inner, "plastic (nonlinear)"))):
        assert key_of(*split_key(key)) == key
    assert split_key(inner) == ("blendbsdf", "", ("diffuse", "roughconductor (ggx)"))
    assert ordered([inner, "plastic", "diffuse", inner]) == ("diffuse", "plastic", inner)
    for bad in ("diffuse", "blendbsdf(diffuse", "blendbsdf(diffuse))", "plastic (nonlinear)", ""):
        with pytest.raises(ValueError, match="is no key"):
            split_key(bad)
    with pytest.raises(ValueError, match="no scattering model"):
        declaration_of("wood(diffuse)")


def test_every_model_with_delta_lobes_tells_their_probability() -> None:
    from warp_psdr.kernels.bsdf.record import make_material_record

    for model in MODELS:
        record = make_material_record(tuple((value.name, value.type) for value in model.values))
        assert (model.make(record, model.variants[0]).probability is not None) == model.has_delta, model.plugin


def bitmap(values=0.5, shape=(2, 2, 3), **more):
    return {"type": "bitmap", "raw": True, "bitmap": np.full(shape, values, np.float32), **more}


def normal_map(nested=RED, **more):
    return {"type": "normalmap", "normalmap": bitmap(), "nested": nested, **more}


def bump_map(nested=RED, **more):
    return {"type": "bumpmap", "anything": bitmap(shape=(2, 2, 1)), "nested": nested, **more}


NAMED = {
    "blend": blend(),
    "blend of a blend": blend(blend(), BRUSHED),
    "twosided": {"type": "twosided", "b": blend()},
    "normal map": {"type": "twosided", "b": normal_map(blend())},
    "bump map": bump_map(BRUSHED),
}


@pytest.mark.parametrize("bsdf", NAMED.values(), ids=NAMED)
def test_names_are_mitsubas(bsdf: dict) -> None:
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    theirs = {name for name, _ in mi.traverse(mi.load_dict(for_mitsuba(mi, bsdf)))}
    ours = [name.removeprefix("x.bsdf.") for name in psdr.traverse(load(bsdf)) if name.startswith("x.bsdf.")]
    # Mitsuba leaves out a reflectance that is not given.
    assert {name for name in ours if "specular_reflectance" not in name} == theirs


def test_children_keep_their_order_and_share_their_textures() -> None:
    scene = psdr.load_dict({
        "type": "scene", "camera": {"type": "perspective"}, "sky": {"type": "constant"}, "red": RED,
        "x": {"type": "rectangle", "bsdf": blend({"type": "ref", "id": "red"})},
        "y": {"type": "rectangle", "bsdf": {"type": "ref", "id": "red"}},
    })  # fmt: skip
    x, y = (shape.bsdf for shape in scene.description.shapes)
    assert x.textures["first_reflectance"] is y.textures["reflectance"]
    assert x.textures["second_reflectance"].value.tolist() == pytest.approx([0.1, 0.1, 0.8])
    assert scene.builder.models == ("diffuse", "blendbsdf(diffuse, diffuse)")
    assert scene.parameters["red.reflectance.value"].uses == {"material:first_reflectance", "material:reflectance"}


def test_sides_of_children_are_sides_of_the_whole() -> None:
    both = {"type": "twosided", "front": RED, "behind": BRUSHED}
    scene = load(blend(both, {"type": "twosided", "both": BLUE}))
    bsdf = scene.description.shapes[0].bsdf
    assert bsdf.two_sided and bsdf.children == ("diffuse", "diffuse")
    assert bsdf.back.children == ("roughconductor (beckmann)", "diffuse")
    assert bsdf.back.textures["second_reflectance"] is bsdf.textures["second_reflectance"]
    # The back alone is anisotropic.
    assert scene.builder.anisotropic == {1}
    assert "x.bsdf.bsdf_0.brdf_1.alpha_u.value" in psdr.traverse(scene)


def test_values_of_children_have_a_prefix() -> None:
    (model,) = models_of(["blendbsdf(blendbsdf(diffuse, conductor), dielectric)"])
    names = [value.name for value in model.values]
    assert names[:3] == ["weight", "first_weight", "first_first_reflectance"]
    assert model.turned_by == ("second_ior",) and model.transmits and model.has_smooth


def test_texels_beyond_the_range_of_a_weight_count_as_its_end() -> None:
    bitmap = {"type": "bitmap", "raw": True, "bitmap": np.full((2, 2), 1.5, np.float32)}
    with pytest.warns(psdr.SceneWarning, match="which count as 1"):
        load(blend(weight=bitmap))


def test_moving_things_before_glass_paint_and_mirror_at_once_are_refused() -> None:
    scene = load(blend(RED, {"type": "dielectric"}))
    params = psdr.traverse(scene)
    params.requires_grad("x.vertex_positions")
    with pytest.raises(ValueError, match=r"blendbsdf\(diffuse, dielectric\).*split it up"):
        psdr.plan(scene, params, integrator=psdr.PathIntegrator(max_depth=3))


GLASS = {"type": "dielectric"}
#: What is wrong -> the scattering model, and words of the message: the place and the remedy.
BAD = {
    "no weight": ({"type": "blendbsdf", "a": RED, "b": BLUE}, "without 'weight'; give a number or a texture"),
    "one model": ({"type": "blendbsdf", "weight": 0.5, "a": RED}, "1 nested bsdf; nest exactly two"),
    "three models": (blend() | {"c": RED}, "3 bsdf plugins .* give at most 2"),
    "a weight beyond 1": (blend(weight=1.5), "parameter 'weight'.* between 0 and 1"),
    "two refractions": (blend(GLASS, GLASS), "both refract"),
    "one is two-sided": (blend(RED, {"type": "twosided", "c": BLUE}), "the other is not; put 'twosided' around both"),
    "no normals": ({"type": "normalmap", "a": RED}, "without 'normalmap'"),
    "no heights": ({"type": "bumpmap", "a": RED}, "no texture; nest exactly one"),
    "two textures of heights": (bump_map() | {"more": bitmap()}, r"2 textures .* nest exactly one"),
    "heights without slopes": ({"type": "bumpmap", "a": RED, "b": bitmap(filter_type="nearest")}, "use 'bilinear'"),
    "heights on a checkerboard": ({"type": "bumpmap", "a": RED, "b": {"type": "checkerboard"}}, "give a bitmap"),
    "thin glass in a map": (normal_map({"type": "thindielectric"}), "put what lets it pass around the map"),
    "a map in a map": (normal_map(bump_map()), "inside another"),
    "a masked model under a normal map": (
        normal_map({"type": "mask", "c": RED}),
        "put what lets it pass around the map",
    ),
    "a mask in twosided": ({"type": "twosided", "c": {"type": "mask", "d": RED}}, r"\['c'\].* inside 'twosided'"),
    "a mask of nothing": ({"type": "mask"}, "0 nested bsdf; nest exactly one"),
    "glass in twosided": ({"type": "twosided", "c": blend(RED, GLASS)}, r"\['c'\].* inside 'twosided'"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_nested_is_named(name: str) -> None:
    bsdf, words = BAD[name]
    with pytest.raises(ValueError, match=rf"\['x'\]\['bsdf'\].*{words}"):
        load(bsdf)


def test_a_map_on_a_shape_without_texture_coordinates_is_refused() -> None:
    shape = {"type": "mesh", "vertices": np.eye(3), "faces": [[0, 1, 2]], "bsdf": blend(normal_map())}
    with pytest.raises(ValueError, match="turns normals by dp/du, and the shape has no texture coordinates"):
        psdr.load_dict({"type": "scene", "camera": {"type": "perspective"}, "sky": {"type": "constant"}, "x": shape})


def test_normals_that_are_decoded_as_colours_are_warned_of() -> None:
    colours = {"type": "bitmap", "bitmap": np.full((2, 2, 3), 128, np.uint8)}
    with pytest.warns(psdr.SceneWarning, match="decoded as sRGB colours; say raw = true"):
        load({"type": "normalmap", "normalmap": colours, "nested": RED})


def test_the_back_of_a_two_sided_model_in_a_map_is_seen_from_below() -> None:
    inside = load(normal_map({"type": "twosided", "a": RED})).description.shapes[0].bsdf
    assert inside.back.variant == "seen_from_below" and inside.back.textures == inside.textures
    assert load({"type": "twosided", "a": normal_map()}).description.shapes[0].bsdf.back is None


#: What slides a bump map -> parameters that are requested.
SLIDING = {
    "shape": ("x.vertex_positions",),
    "normals": ("x.vertex_normals",),
    "pose": ("x.to_world",),
    "texture coordinates": ("x.vertex_texcoords",),
    "their transformation": ("x.bsdf.nested_texture.to_uv",),
    "camera": ("camera.to_world",),
}


@pytest.mark.parametrize("boundary", ["auto", None])
@pytest.mark.parametrize("what", SLIDING)
def test_sliding_a_bump_map_is_refused_and_a_normal_map_is_not(what: str, boundary) -> None:
    integrator = psdr.PathIntegrator(max_depth=3, boundary=boundary)
    with pytest.raises(ValueError, match=r"bump map.*hold the shape and the camera still"):
        psdr.plan(load(bump_map()), integrator=integrator, names=list(SLIDING[what]))
    names = [name.replace("nested_texture", "normalmap") for name in SLIDING[what]]
    plan = psdr.plan(load(normal_map()), integrator=integrator, names=names)
    assert "leave out the jump where a normal turns away" in str(plan)


def test_a_bump_map_may_stand_beside_what_moves() -> None:
    scene = psdr.load_dict({
        "type": "scene", "camera": {"type": "perspective"}, "sky": {"type": "constant"},
        "x": {"type": "rectangle", "bsdf": bump_map()}, "y": {"type": "cube", "bsdf": BLUE},
    })  # fmt: skip
    names = ["y.vertex_positions", "x.bsdf.nested_texture.data", "x.bsdf.scale"]
    plan = psdr.plan(scene, integrator=psdr.PathIntegrator(max_depth=3), names=names)
    assert plan.boundary is not None and plan.config.surfaces.tangent


def test_normals_of_a_mirror_bend_what_is_seen_in_it() -> None:
    for bsdf in (
        normal_map({"type": "conductor"}),
        {"type": "twosided", "a": RED, "b": normal_map({"type": "conductor"})},
    ):
        scene = load(bsdf)
        (name,) = [name for name in psdr.traverse(scene) if name.endswith("normalmap.data")]
        plan = psdr.plan(scene, integrator=psdr.PathIntegrator(max_depth=3), names=[name])
        assert plan.wanted.bends and "in a surface with turned normals" in str(plan)


def test_the_index_of_a_blend_is_that_of_the_model_that_refracts() -> None:
    for children in (("null", "dielectric"), ("dielectric", "null")):
        assert make_bsdf((key_of("blendbsdf", children=children),)).relative_eta is not None
