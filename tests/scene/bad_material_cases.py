"""Malformed scattering models, lights and textures as data, beside the cases of ``bad_input_cases``."""

import numpy as np

from tests.scene.bad_input_cases import Case, model


def bitmap(value, channels=3):
    """Return a bitmap of one value."""
    return {"type": "bitmap", "raw": True, "bitmap": np.full((2, 2, channels), value)}


CASES = [
    # Materials and lights.
    Case(
        "reflectance above 1",
        ("scene['x']['bsdf'], parameter 'reflectance'", "1.5", "between 0 and 1"),
        plugins=model(type="diffuse", reflectance=1.5),
    ),
    Case(
        "reflectance NaN",
        ("parameter 'reflectance'", "not finite", "give a number"),
        plugins=model(type="diffuse", reflectance=float("nan")),
    ),
    Case(
        "negative alpha",
        ("parameter 'alpha'", "-0.1", "at least 1e-05"),
        plugins=model(type="roughconductor", alpha=-0.1),
    ),
    Case("zero alpha", ("parameter 'alpha'", "at least 1e-05"), plugins=model(type="roughconductor", alpha=0.0)),
    Case(
        "coloured alpha",
        ("parameter 'alpha'", "one number"),
        plugins=model(type="roughconductor", alpha={"type": "rgb", "value": [0.1, 0.2, 0.3]}),
    ),
    Case("unknown metal", ("parameter 'material'", "'Gold'", "Au"), plugins=model(type="conductor", material="Gold")),
    Case(
        "unknown distribution",
        ("parameter 'distribution'", "ggx, beckmann"),
        plugins=model(type="roughconductor", distribution="phong"),
    ),
    Case(
        "unknown glass",
        ("parameter 'int_ior'", "did you mean 'water'"),
        plugins=model(type="dielectric", int_ior="watter"),
    ),
    Case("negative ior", ("parameter 'int_ior'", "-1.5", "above 0"), plugins=model(type="dielectric", int_ior=-1.5)),
    Case("glass with two sides", ("reflects only",), plugins=model(type="twosided", g={"type": "dielectric"})),
    Case(
        "negative radiance",
        ("parameter 'radiance'", "at least 0"),
        plugins={"sky": {"type": "constant", "radiance": -1.0}},
    ),
    Case(
        "spot wider than its cutoff",
        ("scene['x']", "beam_width", "cutoff_angle"),
        plugins={"x": {"type": "spot", "cutoff_angle": 10.0, "beam_width": 20.0}},
    ),
    Case(
        "direction without length",
        ("parameter 'direction'", "non-zero"),
        plugins={"x": {"type": "directional", "direction": [0, 0, 0]}},
    ),
    # Textures.
    Case(
        "unknown wrap mode",
        ("parameter 'wrap_mode'", "repeat, mirror, clamp"),
        plugins=model(
            type="diffuse", reflectance={"type": "bitmap", "bitmap": np.ones((2, 2, 3)), "wrap_mode": "tile"}
        ),
    ),
    Case(
        "missing bitmap",
        ("parameter 'filename'", "a.png", "check the name"),
        error=FileNotFoundError,
        plugins=model(type="diffuse", reflectance={"type": "bitmap", "filename": "a.png"}),
    ),
    Case(
        "bitmap that is no image",
        ("parameter 'filename'", "a.png", "export it again"),
        files={"a.png": "hello"},
        plugins=model(type="diffuse", reflectance={"type": "bitmap", "filename": "a.png"}),
    ),
    Case(
        "bitmap of another format",
        ("a.gif", "use one of .exr"),
        files={"a.gif": "hello"},
        plugins=model(type="diffuse", reflectance={"type": "bitmap", "filename": "a.gif"}),
    ),
    Case(
        "bitmap without an image",
        ("['reflectance']", "no image", "'filename'"),
        plugins=model(type="diffuse", reflectance={"type": "bitmap"}),
    ),
    Case(
        "bitmap of four dimensions",
        ("parameter 'data'", "(2, 2, 2, 2)", "(H, W, 3)"),
        plugins=model(type="diffuse", reflectance={"type": "bitmap", "data": np.ones((2, 2, 2, 2))}),
    ),
    Case(
        "envmap with NaN",
        ("scene['sky']", "NaN", "repair the image"),
        plugins={"sky": {"type": "envmap", "bitmap": np.full((4, 8, 3), np.nan)}},
    ),
    # What is given twice, lacks a part, or is out of range in a texture.
    Case(
        "alpha and alpha_u",
        ("scene['x']['bsdf']", "'alpha' besides 'alpha_u' or 'alpha_v'", "give either alpha or both others"),
        plugins=model(type="roughconductor", alpha=0.1, alpha_u=0.2),
    ),
    Case(
        "alpha_u alone",
        ("scene['x']['bsdf']", "only one of 'alpha_u' and 'alpha_v'", "give both, or 'alpha'"),
        plugins=model(type="roughconductor", alpha_u=0.2),
    ),
    Case(
        "parameter of another model",
        ("scene['x']['bsdf']", "'plastic' has no parameter 'eta'", "its parameters are: diffuse_reflectance, ext_ior"),
        plugins=model(type="plastic", eta=1.2),
    ),
    *(
        Case(
            f"{glass} between equal indices",
            ("scene['x']['bsdf']", "int_ior / ext_ior is 1", "have to differ", "leave the surface out"),
            plugins=model(type=glass, int_ior=1.3, ext_ior=1.3),
        )
        for glass in ("roughdielectric", "roughplastic")
    ),
    Case(
        "roughdielectric between nearly equal indices",
        ("scene['x']['bsdf']", "int_ior / ext_ior is 1.00099", "by a ratio of 0.001 or more"),
        plugins=model(type="roughdielectric", int_ior=1.00099, ext_ior=1.0),
    ),
    Case(
        "map of normals on nothing",
        ("scene['x']['bsdf']", "a 'normalmap' with 0 nested bsdf", "nest exactly one"),
        plugins=model(type="normalmap", normalmap=bitmap(0.5)),
    ),
    Case(
        "two sides of nothing",
        ("scene['x']['bsdf']", "without a nested bsdf", "nest one, or two"),
        plugins=model(type="twosided"),
    ),
    Case(
        "texels below the range",
        ("scene['x']['bsdf'], parameter 'alpha'", "4 of 4 values out of range (from -1.5 to -1.5)", "at least 1e-05"),
        plugins=model(type="roughconductor", alpha=bitmap(-1.5, 1)),
    ),
    Case(
        "texels that are no numbers",
        ("scene['x']['bsdf'], parameter 'reflectance'", "NaN or infinity", "give finite values"),
        plugins=model(type="diffuse", reflectance=bitmap(np.nan)),
    ),
    *(
        Case(
            f"{kind} of Mitsuba 0.x",
            ("scene['x']['bsdf']", f"unsupported bsdf '{kind}'", "of Mitsuba 0.x", remedy),
            plugins=model(type=kind),
        )
        for kind, remedy in {
            "phong": "give 'ashikhminshirley'",
            "ward": "give 'roughconductor' with 'alpha_u' and 'alpha_v'",
            "coating": "give 'plastic'",
            "roughdiffuse": "give 'orennayar'",
        }.items()
    ),
    *(
        Case(f"unsupported {kind}", ("scene['x']['bsdf']", f"'{kind}'", "supported"), plugins=model(type=kind))
        for kind in ("hair", "measured", "polarizer")
    ),
]
