"""Checkerboards: exact images, Mitsuba's look-ups, and what may move where one is seen."""

import re

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.scene import describe_dict

from .helpers import assert_same_mean

SIZE = 16
T = psdr.Transform


def rgb(*values):
    return {"type": "rgb", "value": list(values)}


def seen(*, size=SIZE, **shape):
    """Return a square that fills the view of a parallel camera, v from the bottom, u from the left of the image."""
    camera = {
        "type": "orthographic",
        "to_world": T.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0)),
        "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
    }
    return {"type": "scene", "camera": camera, "square": {"type": "rectangle", **shape}}


def board(fields=2, **parameters):
    """Return a checkerboard with this many fields along an edge of the square."""
    return {"type": "checkerboard", "to_uv": T.scale([0.5 * fields, 0.5 * fields, 1]), **parameters}


def fields_of_pixels(fields):
    """Return 0 or 1, the field's colour, for every pixel; the first row is at the top, where v is 1."""
    k = (np.arange(SIZE) * fields) // SIZE
    return (k[None, :] + k[::-1][:, None]) % 2


@pytest.mark.parametrize("fields", [2, 4])
def test_an_image_has_the_colours_of_the_fields_exactly(fields):
    texels = np.random.default_rng(0).random((4, 4, 3)).astype(np.float32)
    bitmap = {"type": "bitmap", "bitmap": np.full((2, 2, 3), texels[0, 0])}
    emitter = {"type": "area", "radiance": board(fields, color0=rgb(0.1, 0.2, 0.7), color1=bitmap)}
    image = psdr.render(psdr.load_dict(seen(emitter=emitter)), integrator=psdr.PathIntegrator(max_depth=1), spp=4)
    colors = np.array([[0.1, 0.2, 0.7], texels[0, 0]], np.float32)
    np.testing.assert_allclose(image.numpy(), colors[fields_of_pixels(fields)], rtol=1e-6)


def test_defaults_are_those_of_mitsuba():
    scene = seen(bsdf={"type": "diffuse", "reflectance": {"type": "checkerboard"}})
    first, second = describe_dict(scene).shapes[0].bsdf.textures["reflectance"].nested
    assert (first.value.tolist(), second.value.tolist()) == ([np.float32(0.4)], [np.float32(0.2)])
    lit = scene | {"sky": {"type": "constant"}}
    names = [n for n in psdr.traverse(psdr.load_dict(lit)) if "reflectance" in n]
    assert names == [f"square.bsdf.reflectance.{n}" for n in ("color0.value", "color1.value", "to_uv")]


def test_a_checkerboard_that_is_read_as_a_number_swaps_its_colours():
    metal = {"type": "roughconductor", "alpha": {"type": "checkerboard", "color0": 0.1, "color1": 0.6}}
    first, second = describe_dict(seen(bsdf=metal)).shapes[0].bsdf.textures["alpha_u"].nested
    assert (float(first.value[0]), float(second.value[0])) == (np.float32(0.6), np.float32(0.1))
    assert (first.path, second.path) == ("square.bsdf.alpha.color1", "square.bsdf.alpha.color0")


def test_colour_bitmaps_in_slots_of_numbers_are_luminances_decoded_first():
    """Alpha from 8-bit sRGB texels, from raw ones, and from floats, as Mitsuba reads it."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    texels = np.random.default_rng(1).integers(1, 255, (2, 2, 3)).astype(np.uint8)
    at = mi.SurfaceInteraction3f()
    for image, raw in ((texels, False), (texels, True), ((texels / 255.0).astype(np.float32), False)):
        metal = {"type": "roughconductor", "alpha": {"type": "bitmap", "bitmap": image, "raw": raw}}
        ours = describe_dict(seen(bsdf=metal)).shapes[0].bsdf.textures["alpha_u"].value
        bitmap = mi.Bitmap(image)
        bitmap.set_srgb_gamma(image.dtype == np.uint8)
        theirs = mi.load_dict({"type": "bitmap", "bitmap": bitmap, "raw": raw, "filter_type": "nearest"})
        for row, column in np.ndindex(2, 2):
            at.uv = ((column + 0.5) / 2, (row + 0.5) / 2)
            assert ours[row, column, 0] == pytest.approx(theirs.eval_1(at), abs=2e-6)


@pytest.mark.parametrize(
    ("colors", "words"),
    [
        (
            {"color1": {"type": "checkerboard"}},
            r"\['reflectance'\]: a checkerboard inside a checkerboard, as 'color1'; give",
        ),
        ({"color0": 1.5}, r"parameter 'reflectance'.*between 0 and 1"),
        ({"colour": 1.0}, r"no parameter 'colour' \(did you mean 'color"),
    ],
)
def test_what_cannot_be_is_named(colors, words):
    with pytest.raises(ValueError, match=words):
        describe_dict(seen(bsdf={"type": "diffuse", "reflectance": {"type": "checkerboard", **colors}}))


@pytest.mark.slow_rows("reflectance", "alpha")
@pytest.mark.parametrize("read", ["reflectance", "alpha"])
def test_images_equal_mitsubas(read):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    texture = {"type": "checkerboard", "color0": 0.1, "color1": 0.7}
    model = {"reflectance": "diffuse", "alpha": "roughconductor"}[read]

    def scene(transform, size=8):
        square = {"type": "rectangle", "bsdf": {"type": model, read: texture | {"to_uv": transform().scale([3, 2, 1])}}}
        camera = {
            "type": "perspective",
            "fov": 40.0,
            "to_world": transform().look_at([0, -2, 2], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
        }
        lamp = {"type": "point", "position": [0.5, 0.5, 1.5], "intensity": 3.0}
        return {"type": "scene", "integrator": {"type": "path"}, "camera": camera, "square": square, "lamp": lamp}

    theirs = mi.load_dict(scene(mi.ScalarTransform4f))
    ours = psdr.load_dict(scene(lambda: T))
    a = np.stack([psdr.render(ours, spp=64, seed=i).numpy() for i in range(8)]).astype(np.float64)
    b = np.stack([np.array(mi.render(theirs, spp=64, seed=i)) for i in range(8)]).astype(np.float64)
    # The highlight reaches thousands of times the mean in few samples.
    assert_same_mean(a.reshape(8, -1, 3), b.reshape(8, -1, 3), read)


# -- what may move --------------------------------------------------------------------------------------------------


def checkered_room(**metal):
    texture = {"type": "checkerboard"}
    scene = seen(bsdf={"type": "diffuse", "reflectance": texture}, size=4)
    cards = {"card": {"type": "rectangle", "to_world": T.translate([0, 0, 1]), **metal}}
    other = {"type": "bitmap", "bitmap": np.full((2, 2, 3), 0.5)}
    painted = {"type": "rectangle", "to_world": T.translate([3, 0, 0]), "bsdf": {"type": "diffuse"}}
    painted["bsdf"]["reflectance"] = other
    return psdr.load_dict(scene | cards | {"painted": painted, "lamp": {"type": "point", "position": [0, 0, 2]}})


def refusal(scene, name, **options):
    """Return why the plan refuses a derivative; empty: it does not."""
    params = psdr.traverse(scene)
    params.requires_grad_only(name)
    try:
        psdr.plan(scene, params, integrator=psdr.PathIntegrator(max_depth=2, **options))
    except ValueError as problem:
        return str(problem)
    return ""


def test_a_checkerboard_may_move_slide_and_be_seen_in_mirrors():
    """Derivatives are in ``tests/boundary/test_texture_steps.py``."""
    names = ["square.bsdf.reflectance.to_uv", "square.vertex_texcoords", "square.to_world", "square.vertex_positions"]
    names += ["camera.to_world", "card.to_world", "lamp.position", "painted.bsdf.reflectance.to_uv"]
    names += [f"square.bsdf.reflectance.color{i}.value" for i in (0, 1)]
    for metal in ({}, {"bsdf": {"type": "conductor"}}):
        scene = checkered_room(**metal)
        assert [refusal(scene, name) for name in names] == [""] * len(names)


def test_a_checkerboard_that_slides_is_refused_by_what_does_not_know_it():
    scene = checkered_room()
    name = "square.bsdf.reflectance.to_uv"
    message = refusal(scene, name, boundary=psdr.boundary.WarpedArea())
    assert re.search(r"does not know textures with steps; use boundary.PathSpace\(\), or", message)
