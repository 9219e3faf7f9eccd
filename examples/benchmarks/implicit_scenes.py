"""The scenes of ``implicit.py``: a shape without triangles above a floor, under a lamp, in files for both renderers."""

import struct
from pathlib import Path

import numpy as np

from scenes import write_ply
from warp_psdr.scene.shapes.primitives import sphere as tessellated

DEPTH = 4
RADIUS = 0.33
#: Nodes of the cubic grid that a network is compared with, and hidden layers of the networks.
NODES, SMALL, LARGE = 33, (32, 32), (64, 64, 64, 64)
#: Control points of a curve: five segments.
POINTS = 8
SCENE = """<scene version="3.0.0">
<default name="resolution" value="128"/>
<sensor type="perspective"><float name="fov" value="45"/>
    <transform name="to_world"><lookat origin="0, -3, 1.5" target="0, 0, 0.4" up="0, 0, 1"/></transform>
    <film type="hdrfilm"><integer name="width" value="$resolution"/><integer name="height" value="$resolution"/>
        <rfilter type="box"/></film></sensor>
<shape type="rectangle" id="floor"><transform name="to_world"><scale value="3"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.6, 0.5, 0.4"/></bsdf></shape>
<shape type="rectangle" id="lamp"><transform name="to_world"><scale value="0.5"/><rotate x="1" angle="180"/>
    <translate x="1" y="-1" z="3"/></transform>
    <emitter type="area"><rgb name="radiance" value="8, 8, 8"/></emitter></shape>
<shape type="{type}" id="body">{inside}
    <bsdf type="diffuse"><rgb name="reflectance" value="0.3, 0.6, 0.7"/></bsdf></shape>
</scene>"""
#: Of the box [0, 1]^3 of grids and networks.
POSE = """<transform name="to_world"><translate x="-0.5" y="-0.5" z="0.1"/></transform>"""
BALL = f"""<point name="center" x="0" y="0" z="0.6"/><float name="radius" value="{RADIUS}"/>"""


def blob(x: np.ndarray) -> np.ndarray:
    """Return signed distances to a ball with bumps, at points (..., 3) of [0, 1]^3."""
    bumps = 0.06 * np.sin(9.0 * x[..., 0]) * np.sin(8.0 * x[..., 1] + 1.0) * np.sin(10.0 * x[..., 2])
    return np.linalg.norm(x - 0.5, axis=-1) - RADIUS + bumps


def nodes(count: int) -> np.ndarray:
    """Return the places of a grid's nodes, (Z, Y, X, 3), columns x, y, z."""
    at = np.linspace(0.0, 1.0, count)
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    return np.stack([x, y, z], axis=-1)


def network(widths: tuple[int, ...]) -> dict[str, np.ndarray]:
    """Return layers, softplus with beta 10, of which all but the last are random and that is fitted to the blob."""
    rng = np.random.default_rng(0)
    x = rng.random((20000, 3))
    layers, given = {}, x
    for n, width in enumerate(widths):
        weight = rng.standard_normal((width, given.shape[1])) * (1.0 if n else 3.0) / np.sqrt(given.shape[1])
        bias = 0.3 * rng.standard_normal(width) if n else -(weight * rng.random((width, 3))).sum(axis=1)
        layers |= {f"layer{n}.weight": np.float32(weight), f"layer{n}.bias": np.float32(bias)}
        given = np.logaddexp(0.0, 10.0 * (given @ weight.T + bias)) / 10.0
    # Next to the surface errors count more.
    given, near = np.concatenate([given, np.ones((len(x), 1))], axis=1), 1.0 / (0.05 + np.abs(blob(x)))
    a = given * near[:, None]
    last = np.linalg.solve(a.T @ a + 1e-6 * len(x) * np.eye(a.shape[1]), a.T @ (blob(x) * near))
    n = len(widths)
    return layers | {f"layer{n}.weight": np.float32(last[None, :-1]), f"layer{n}.bias": np.float32(last[-1:])}


def hair(curves: int) -> np.ndarray:
    """Return control points (curves, POINTS, 4), (x, y, z, radius), of curves side by side that do not touch."""
    rng = np.random.default_rng(1)
    side = int(np.ceil(np.sqrt(curves)))
    space = 2.0 / side
    place = space * (np.stack(np.divmod(np.arange(curves), side), axis=1) + 0.5) - 1.0
    turns = 2.0 * np.pi * rng.random((curves, 1)) + np.linspace(0.0, 5.0, POINTS)
    lean = 0.25 * space * np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    z = np.broadcast_to(np.linspace(0.05, 1.0, POINTS), turns.shape)
    radius = np.broadcast_to(np.linspace(0.12, 0.05, POINTS) * space, turns.shape)
    return np.concatenate([place[:, None] + lean, z[..., None], radius[..., None]], axis=-1)


def write(folder: Path) -> dict[str, Path]:
    """Write the scenes and their data; name -> file."""
    shapes = {}
    for count in (NODES, 64, 128):
        values = blob(nodes(count)).astype("<f4")
        head = b"VOL\x03" + struct.pack("<5i6f", 1, count, count, count, 1, 0, 0, 0, 1, 1, 1)
        (folder / f"grid{count}.vol").write_bytes(head + values.tobytes())
        named = f'<string name="filename" value="grid{count}.vol"/>{POSE}'
        shapes[f"grid {count}"] = "sdfgrid", f'{named}<string name="normals" value="smooth"/>'
        shapes[f"grid {count}, analytic"] = "sdfgrid", f'{named}<string name="normals" value="analytic"/>'
        shapes[f"grid {count}, cubic"] = "sdfgrid", f'{named}<string name="interpolation" value="cubic"/>'
    for name, widths in (("network", SMALL), ("large network", LARGE)):
        np.savez(folder / f"{name}.npz", **network(widths))
        beta = '<float name="beta" value="10"/>'
        shapes[name] = "neuralsdf", f'<string name="filename" value="{name}.npz"/>{beta}{POSE}'
    for segments in (10_000, 50_000):
        lines = [" ".join(f"{x:.7g}" for x in point) for curve in hair(segments // 5) for point in (*curve, ())]
        (folder / f"hair{segments}.txt").write_text("\n".join(lines) + "\n")
        shapes[f"hair {segments}"] = "bsplinecurve", f'<string name="filename" value="hair{segments}.txt"/>'
    shapes["sphere, exact"] = "sphere", f'{BALL}<boolean name="exact" value="true"/>'
    shapes["sphere, tessellated"] = "sphere", f'{BALL}<integer name="resolution" value="64"/>'
    ball = tessellated(64)
    write_ply(folder / "ball.ply", RADIUS * ball.vertices + [0.0, 0.0, 0.6], ball.faces)
    shapes["mesh"] = "ply", '<string name="filename" value="ball.ply"/><boolean name="face_normals" value="true"/>'
    files = {}
    for name, (plugin, inside) in shapes.items():
        files[name] = folder / f"{name.replace(', ', '_').replace(' ', '_')}.xml"
        files[name].write_text(SCENE.format(type=plugin, inside=inside))
    return files
