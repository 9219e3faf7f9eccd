"""The scenes of the benchmarks, as data: Mitsuba XML that both renderers load, and the files that it names."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import ROOT

from warp_psdr import image_io
from warp_psdr.scene.shapes.primitives import sphere

CORNELL = ROOT / "scenes" / "cornell_box.xml"
#: Triangles of the finely tessellated mesh: 2 * 160 * 256.
ROWS, COLUMNS = 160, 256


@dataclass(frozen=True)
class Case:
    """A scene.

    Attributes:
        xml: Scene text with ``$resolution`` and ``$spp``.
        max_depth: Path vertices.
        exact: Whether both renderers see the same geometry (an analytic sphere is tessellated here).
    """

    xml: str
    max_depth: int = 6
    exact: bool = True

    def write(self, folder: Path, name: str) -> Path:
        """Write the scene file next to the data that it names."""
        file = folder / f"{name.replace(' ', '_')}.xml"
        file.write_text(self.xml.replace('name="max_depth" value="6"', f'name="max_depth" value="{self.max_depth}"'))
        return file


def bumpy_sphere(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, texture coordinates and faces of a displaced sphere, 2 * rows * columns triangles."""
    v, u = np.meshgrid(np.linspace(0.0, 1.0, rows + 1), np.linspace(0.0, 1.0, columns + 1), indexing="ij")
    theta, phi = np.pi * v, 2.0 * np.pi * u
    r = 1.0 + 0.1 * np.sin(7.0 * theta) * np.cos(5.0 * phi) * np.sin(theta)
    xyz = np.stack([r * np.sin(theta) * np.cos(phi), r * np.cos(theta), -r * np.sin(theta) * np.sin(phi)], -1)
    i = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)[None, :]).reshape(-1)
    faces = np.concatenate(
        [np.stack([i, i + columns + 1, i + 1], 1), np.stack([i + 1, i + columns + 1, i + columns + 2], 1)]
    )
    return xyz.reshape(-1, 3), np.stack([u, v], -1).reshape(-1, 2), faces


def write_ply(file: Path, vertices, faces, *, normals=None, texcoords=None) -> None:
    """Write a binary PLY file."""
    parts = [("x", "y", "z"), *([("nx", "ny", "nz")] if normals is not None else [])]
    parts += [("u", "v")] if texcoords is not None else []
    columns = [np.asarray(a, np.float32) for a in (vertices, normals, texcoords) if a is not None]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for part in parts for name in part]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    records = np.zeros(len(faces), dtype=[("n", "u1"), ("i", "<i4", 3)])
    records["n"], records["i"] = 3, faces
    file.write_bytes("\n".join(header).encode() + np.hstack(columns).astype("<f4").tobytes() + records.tobytes())


def write_data(folder: Path) -> None:
    """Write the meshes, the texture and the environment map that the scenes name."""
    ball = sphere(64)
    write_ply(folder / "ball.ply", ball.vertices, ball.faces, normals=ball.normals)
    vertices, texcoords, faces = bumpy_sphere(ROWS, COLUMNS)
    corner = vertices[faces]
    keep = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) > 1e-12
    write_ply(folder / "bumpy.ply", vertices, faces[keep], normals=smooth_normals(vertices, faces), texcoords=texcoords)
    y, x = np.mgrid[0:64, 0:128]
    checks = np.where((x // 8 + y // 8) % 2 == 0, 0.8, 0.2)
    texture = np.stack([checks, 0.5 + 0.4 * np.sin(x / 10.0), 0.5 + 0.4 * np.cos(y / 5.0)], -1)
    image_io.write_image(folder / "texture.png", texture.astype(np.float32))
    image_io.write_image(folder / "paint.exr", texture.astype(np.float32))
    y, x = np.mgrid[0:32, 0:64]
    sky = np.stack([0.3 + 0.2 * y / 32, 0.4 + 0.1 * y / 32, 0.9 - 0.6 * y / 32], -1)
    sky[6:9, 20:23] = [60.0, 50.0, 30.0]
    image_io.write_image(folder / "sky.exr", sky.astype(np.float32))


def smooth_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return normals of a closed mesh whose seam and poles share positions."""
    _, group = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)
    corner = vertices[faces]
    n = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    sums = np.zeros((group.max() + 1, 3))
    for k in range(3):
        np.add.at(sums, group.reshape(-1)[faces[:, k]], n)
    normals = sums[group.reshape(-1)]
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _box() -> str:
    # The box filter: each pixel is a plain average, in which the two films do not differ.
    return CORNELL.read_text(encoding="utf-8").replace('<rfilter type="gaussian"/>', '<rfilter type="box"/>')


def room(objects: str) -> str:
    """Return the Cornell box with other things in it."""
    head, mark, _ = _box().partition('<shape type="cube" id="small-box">')
    if not mark:
        raise ValueError(f"{CORNELL}: expected the shape 'small-box' after the room")
    return head + objects + "\n</scene>\n"


def stage(objects: str, lights: str) -> str:
    """Return a floor with things on it under other lights."""
    head, _, _ = _box().partition('<bsdf type="diffuse" id="white">')
    head = head.replace('origin="0, 0, 3.9"', 'origin="0, 2.2, 5"').replace('target="0, 0, 0"', 'target="0, -0.3, 0"')
    floor = """<shape type="rectangle" id="floor"><transform name="to_world"><scale value="4"/>
        <rotate x="1" angle="-90"/><translate y="-1"/></transform>
        <bsdf type="diffuse" id="ground"><rgb name="reflectance" value="0.6, 0.5, 0.4"/></bsdf></shape>"""
    return head + floor + objects + lights + "\n</scene>\n"


def mesh(name: str, bsdf: str, *, scale: float = 0.7, y: float = -0.25) -> str:
    """Return a PLY shape."""
    return f"""<shape type="ply" id="object"><string name="filename" value="{name}"/><transform name="to_world">
        <scale value="{scale}"/><translate y="{y}"/></transform>{bsdf}</shape>"""


def _many_lights() -> str:
    rng = np.random.default_rng(5)
    text = []
    for k in range(100):
        (x, z), y, strength = rng.uniform(-2.0, 2.0, 2), rng.uniform(0.6, 1.2), 10.0 ** rng.uniform(-1.0, 1.5)
        r, g, b = strength * rng.uniform(0.3, 1.0, 3)
        text.append(
            f'<shape type="rectangle" id="light{k}"><transform name="to_world"><scale value="0.03"/>'
            f'<rotate x="1" angle="90"/><translate x="{x:.4f}" y="{y:.4f}" z="{z:.4f}"/></transform>'
            f'<emitter type="area"><rgb name="radiance" value="{r:.4f}, {g:.4f}, {b:.4f}"/></emitter></shape>'
        )
    return "".join(text)


GLASS = '<bsdf type="dielectric" id="glass"><float name="int_ior" value="1.5"/><float name="ext_ior" value="1"/></bsdf>'
GOLD = """<bsdf type="roughconductor" id="gold"><string name="material" value="Au"/><float name="alpha" value="0.2"/>
    <string name="distribution" value="ggx"/></bsdf>"""
TEXTURED = """<bsdf type="diffuse" id="painted"><texture type="bitmap" name="reflectance">
    <string name="filename" value="texture.png"/></texture></bsdf>"""
BLUE = '<bsdf type="diffuse" id="blue"><rgb name="reflectance" value="0.2, 0.4, 0.7"/></bsdf>'
SKY = '<emitter type="envmap" id="sky"><string name="filename" value="sky.exr"/></emitter>'
DELTA = """<emitter type="point"><point name="position" x="1.2" y="0.8" z="1"/><rgb name="intensity" value="3, 2, 1"/>
    </emitter>
    <emitter type="spot"><transform name="to_world">
    <lookat origin="-1.5, 1.5, 1.5" target="0, -0.5, 0" up="0, 1, 0"/>
    </transform><rgb name="intensity" value="4, 6, 8"/><float name="cutoff_angle" value="30"/></emitter>
    <emitter type="directional"><vector name="direction" x="0.3" y="-1" z="-0.4"/>
    <rgb name="irradiance" value="1, 1, 1"/></emitter>"""

CASES = {
    "Cornell box": Case(_box()),
    "glass ball": Case(room(mesh("ball.ply", GLASS, scale=0.45)), 8),
    "glass ball, analytic": Case(
        room(
            '<shape type="sphere"><point name="center" x="0" y="-0.25" z="0"/><float name="radius" value="0.45"/>'
            f"{GLASS}</shape>"
        ),
        8,
        exact=False,
    ),
    "rough gold under a sky": Case(stage(mesh("ball.ply", GOLD), SKY)),
    "textured mesh": Case(stage(mesh("bumpy.ply", TEXTURED), SKY)),
    "100 lights": Case(stage(mesh("ball.ply", BLUE, scale=0.5), _many_lights())),
    "point, spot and sun": Case(stage(mesh("ball.ply", BLUE), DELTA)),
    "82k triangles": Case(room(mesh("bumpy.ply", BLUE, scale=0.6))),
}
