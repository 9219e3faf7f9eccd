"""Scenes with the materials that scene files hold, as Mitsuba XML that both renderers load.

Materials have no ids, so that parameters have equal names in both renderers.
"""

from pathlib import Path

import numpy as np

from scenes import CASES as OTHERS
from scenes import SKY, Case, mesh, room, stage
from warp_psdr import image_io

#: Edge of the maps, texels.
TEXELS = 64


def write_maps(folder: Path) -> None:
    """Write the opacity of a leaf and a map of normals."""
    y, x = np.mgrid[0:TEXELS, 0:TEXELS] / (TEXELS - 1.0) - 0.5
    leaf = np.clip(8.0 * (0.45 - np.hypot(2.2 * x, y) - 0.05 * np.sin(40.0 * y)), 0.0, 1.0)
    image_io.write_image(folder / "leaf.exr", np.repeat(leaf[..., None], 3, axis=-1).astype(np.float32))
    slope = 0.25 * np.stack([np.sin(30.0 * x), np.cos(26.0 * y)], -1)
    normal = np.concatenate([slope, np.sqrt(1.0 - (slope**2).sum(-1, keepdims=True))], -1)
    image_io.write_image(folder / "normals.exr", (0.5 * normal + 0.5).astype(np.float32))


def rgb(name: str, *color: float) -> str:
    """Return a colour."""
    return f'<rgb name="{name}" value="{", ".join(f"{c:.3f}" for c in color)}"/>'


def number(name: str, value: float) -> str:
    """Return a number."""
    return f'<float name="{name}" value="{value:.3f}"/>'


def bsdf(kind: str, *inner: str) -> str:
    """Return a material."""
    return f'<bsdf type="{kind}">{"".join(inner)}</bsdf>'


def ball(i: int, count: int, material: str, row: float = 0.0) -> str:
    """Return one of ``count`` balls that stand in a row."""
    x = (i - 0.5 * (count - 1)) * 3.2 / count
    return f"""<shape type="ply" id="ball{i}_{int(10 * row)}"><string name="filename" value="ball.ply"/>
        <transform name="to_world"><scale value="{1.4 / count}"/>
        <translate x="{x}" y="{-1.0 + 1.4 / count}" z="{row}"/></transform>{material}</shape>"""


def sheet(name: str, material: str, transform: str) -> str:
    """Return a rectangle."""
    return f'<shape type="rectangle" id="{name}"><transform name="to_world">{transform}</transform>{material}</shape>'


def plastics() -> str:
    """Twelve balls in three rows: plastic and rough plastic, four colours."""
    found = []
    for i in range(4):
        paint = rgb("diffuse_reflectance", 0.2 + 0.2 * i, 0.4, 0.8 - 0.2 * i)
        found.append(ball(i, 4, bsdf("plastic", paint), -1.2))
        found += [ball(i, 4, bsdf("roughplastic", paint, number("alpha", a)), z) for a, z in ((0.05, 0.0), (0.3, 1.2))]
    return "".join(found)


def principled() -> str:
    """Nine balls in three rows: metalness by roughness."""
    return "".join(
        ball(
            i,
            3,
            bsdf(
                "principled",
                rgb("base_color", 0.7, 0.4, 0.2),
                *(number("roughness", 0.2 + 0.3 * i), number("metallic", 0.1 + 0.4 * k)),
                *(number("clearcoat", 0.5), number("sheen", 0.3), number("specular", 0.5)),
            ),
            1.2 * k - 1.2,
        )
        for i in range(3)
        for k in range(3)
    )


def leaves() -> str:
    """Twenty-four sheets that bitmaps cut out."""
    rng = np.random.default_rng(3)
    opacity = '<texture type="bitmap" name="opacity"><string name="filename" value="leaf.exr"/></texture>'
    leaf = bsdf("mask", opacity, bsdf("twosided", bsdf("diffuse", rgb("reflectance", 0.2, 0.6, 0.2))))
    return "".join(
        sheet(
            f"leaf{i}",
            leaf,
            f'<scale value="0.45"/><rotate x="1" angle="{rng.uniform(-80, 80):.1f}"/>'
            f'<rotate y="1" angle="{rng.uniform(0, 360):.1f}"/>'
            f'<translate x="{rng.uniform(-1.6, 1.6):.3f}" y="{rng.uniform(-0.7, 0.8):.3f}"'
            f' z="{rng.uniform(-1.2, 1.2):.3f}"/>',
        )
        for i in range(24)
    )


NORMALS = """<texture type="bitmap" name="normalmap"><boolean name="raw" value="true"/>
    <string name="filename" value="normals.exr"/></texture>"""
GOLD = bsdf("roughconductor", '<string name="material" value="Au"/><string name="distribution" value="ggx"/>',
            number("alpha", 0.2))  # fmt: skip
FROST = bsdf("roughdielectric", number("alpha", 0.15), number("int_ior", 1.5), number("ext_ior", 1.0))
WAVES = bsdf(
    "normalmap", NORMALS, bsdf("roughplastic", rgb("diffuse_reflectance", 0.3, 0.3, 0.5), number("alpha", 0.1))
)
LYING = '<scale value="2.4"/><rotate x="1" angle="-90"/><translate y="-0.9"/>'


def mixed() -> str:
    """One of each."""
    materials = (
        bsdf("plastic", rgb("diffuse_reflectance", 0.7, 0.2, 0.2)),
        GOLD,
        bsdf("principled", rgb("base_color", 0.2, 0.5, 0.7), number("roughness", 0.4), number("metallic", 0.5)),
        bsdf("blendbsdf", number("weight", 0.4), bsdf("diffuse", rgb("reflectance", 0.6, 0.6, 0.2)), GOLD),
        bsdf("roughplastic", rgb("diffuse_reflectance", 0.2, 0.6, 0.3), number("alpha", 0.2)),
    )
    return "".join(ball(i, 5, m) for i, m in enumerate(materials)) + sheet("waves", WAVES, LYING)


LAMPS = "".join(
    sheet(
        f"lamp{k}",
        f'<emitter type="area">{rgb("radiance", *color)}</emitter>',
        f'<scale value="0.5"/><rotate x="1" angle="90"/><translate x="{x}" y="2.2" z="0.8"/>',
    )
    for k, (x, color) in enumerate(((-1.4, (9.0, 8.0, 6.0)), (1.4, (4.0, 6.0, 9.0))))
)
MATERIALS = {
    "gold under a sky": Case(stage(mesh("ball.ply", GOLD), SKY)),
    "textured mesh under a sky": OTHERS["textured mesh"],
    "twelve plastics": Case(stage(plastics(), LAMPS)),
    "principled spheres": Case(stage(principled(), LAMPS)),
    "masked leaves": Case(stage(leaves(), SKY)),
    "rough glass": Case(room(mesh("ball.ply", FROST, scale=0.45)), 8),
    "normal-mapped floor": Case(stage(sheet("waves", WAVES, LYING), SKY)),
    "mixed": Case(stage(mixed(), LAMPS + SKY)),
    "100 lights": OTHERS["100 lights"],
}
