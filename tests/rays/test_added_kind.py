"""A kind of shape is a file on either side and a row for each: what is added so has images and derivatives."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
DEVICE = '''"""The bowl z = x^2 + y^2 <= 1, seen from both sides, in its own coordinates; phi = x^2 + y^2 - z.

A point q is held as its x and y. Normals are (2 x, 2 y, -1), as long as the area over that of the disk below it. From a
point e the silhouette lies above a part of the circle about (e_x, e_y) with the squared radius phi(e); from a direction
it lies above a chord. Its rim, z = 1, is an open edge.
"""

import warp as wp

from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import PI, TWO_PI
from warp_psdr.kernels.math import share_of_turn
from warp_psdr.kernels.primitive.affine_kind import affine_kind
from warp_psdr.kernels.primitive.kind import TINY, Affine, Graze, Outline, Rim
from warp_psdr.kernels.sampling import disk_to_square, square_to_disk


@wp.func
def above(x: wp.float32, y: wp.float32) -> wp.vec3:
    """The point above a point of the disk."""
    return wp.vec3(x, y, x * x + y * y)


@wp.func
def bowl_coordinates(q: wp.vec3) -> wp.vec2:
    return wp.vec2(q[0], q[1])


@wp.func
def bowl_level(q: wp.vec3) -> wp.vec4:
    return wp.vec4(2.0 * q[0], 2.0 * q[1], -1.0, q[0] * q[0] + q[1] * q[1] - q[2])


@wp.func
def bowl_hit(o: wp.vec3, d: wp.vec3, t_max: wp.float32) -> RayHit:
    hit = RayHit()
    hit.t = t_max
    hit.face = -1
    # phi(o + t d) = a t^2 + 2 b t + c.
    a = d[0] * d[0] + d[1] * d[1]
    b = o[0] * d[0] + o[1] * d[1] - 0.5 * d[2]
    c = o[0] * o[0] + o[1] * o[1] - o[2]
    inside = b * b - a * c
    if inside < 0.0:
        return hit
    s = -(b + wp.where(b < 0.0, -1.0, 1.0) * wp.sqrt(inside))
    one = c / wp.where(s == 0.0, 1.0, s)
    other = wp.where(a > 0.0, s / wp.where(a > 0.0, a, 1.0), one)
    t = wp.min(one, other)
    q = o + t * d
    if t <= 0.0 or q[0] * q[0] + q[1] * q[1] > 1.0:
        t = wp.max(one, other)
        q = o + t * d
    if t > 0.0 and t < t_max and q[0] * q[0] + q[1] * q[1] <= 1.0:
        hit.t = t
        hit.u = q[0]
        hit.v = q[1]
        hit.face = 0
    return hit


@wp.func
def bowl_normal(q: wp.vec3) -> wp.vec3:
    return wp.vec3(2.0 * q[0], 2.0 * q[1], -1.0)


@wp.func
def bowl_tangents(q: wp.vec3) -> tuple[wp.vec3, wp.vec3]:
    return wp.vec3(2.0, 0.0, 4.0 * q[0]), wp.vec3(0.0, 2.0, 4.0 * q[1])


@wp.func
def bowl_uv(q: wp.vec3) -> wp.vec2:
    return wp.vec2(0.5 * q[0] + 0.5, 0.5 * q[1] + 0.5)


@wp.func
def bowl_rates(q: wp.vec3, q_dot: wp.vec3) -> tuple[wp.vec3, wp.vec3, wp.vec2]:
    n = wp.vec3(2.0 * q_dot[0], 2.0 * q_dot[1], 0.0)
    return n, wp.vec3(0.0, 0.0, 4.0 * q_dot[0]), wp.vec2(0.5 * q_dot[0], 0.5 * q_dot[1])


@wp.func
def bowl_pull(q: wp.vec3, a_n: wp.vec3, a_tangent: wp.vec3, a_uv: wp.vec2) -> wp.vec3:
    return wp.vec3(2.0 * a_n[0] + 4.0 * a_tangent[2] + 0.5 * a_uv[0], 2.0 * a_n[1] + 0.5 * a_uv[1], 0.0)


@wp.func
def bowl_graze(hit: wp.vec3, o: wp.vec3, d: wp.vec3) -> Graze:
    r = Graze()
    a = d[0] * d[0] + d[1] * d[1]
    m = o - ((o[0] * d[0] + o[1] * d[1] - 0.5 * d[2]) / wp.max(a, TINY)) * d
    f = bowl_level(m)
    r.normal = wp.vec3(f[0], f[1], f[2])
    r.off = wp.abs(f[3]) / wp.length(r.normal)
    r.q = above(m[0], m[1])
    if 1.0 - hit[2] < r.off:
        around = wp.max(wp.sqrt(hit[0] * hit[0] + hit[1] * hit[1]), TINY)
        r.q = wp.vec3(hit[0] / around, hit[1] / around, 1.0)
        r.off = 1.0 - hit[2]
        r.rim = 1
    return r


@wp.func
def bowl_arc(eye: wp.vec3) -> wp.vec2:
    """Radius of the circle below the silhouette from a point, and half of the angle of its part in the disk."""
    away = eye[0] * eye[0] + eye[1] * eye[1]
    squared = away - eye[2]
    radius = wp.sqrt(wp.max(squared, 0.0))
    far = wp.sqrt(away)
    half = wp.acos(wp.clamp((squared + away - 1.0) / wp.max(2.0 * radius * far, TINY), -1.0, 1.0))
    return wp.vec2(radius, wp.where(squared > 0.0, wp.where(radius + far <= 1.0, PI, half), 0.0))


@wp.func
def bowl_chord(way: wp.vec3) -> wp.vec2:
    """Distance of the chord below the silhouette from a direction, and half of its length."""
    h = 0.5 * way[2] / wp.max(wp.sqrt(way[0] * way[0] + way[1] * way[1]), TINY)
    return wp.vec2(h, wp.sqrt(wp.max(1.0 - h * h, 0.0)))


@wp.func
def bowl_silhouette(eye: wp.vec3, distant: wp.bool, u: wp.float32) -> tuple[wp.vec3, wp.bool]:
    length = wp.max(wp.sqrt(eye[0] * eye[0] + eye[1] * eye[1]), TINY)
    ex = eye[0] / length
    ey = eye[1] / length
    chord = bowl_chord(eye)
    y = chord[1] * (2.0 * u - 1.0)
    q = above(chord[0] * ex - y * ey, chord[0] * ey + y * ex)
    arc = bowl_arc(eye)
    if not distant:
        angle = arc[1] * (2.0 * u - 1.0)
        x = length - arc[0] * wp.cos(angle)
        y = arc[0] * wp.sin(angle)
        q = above(x * ex - y * ey, x * ey + y * ex)
    return q, wp.where(distant, chord[1], arc[1]) > 0.0


@wp.func
def bowl_silhouette_rate(eye: wp.vec3, distant: wp.bool, q: wp.vec3) -> wp.vec3:
    length = wp.max(wp.sqrt(eye[0] * eye[0] + eye[1] * eye[1]), TINY)
    x = -2.0 * bowl_chord(eye)[1] * eye[1] / length
    y = 2.0 * bowl_chord(eye)[1] * eye[0] / length
    if not distant:
        half = bowl_arc(eye)[1]
        x = 2.0 * half * (q[1] - eye[1])
        y = -2.0 * half * (q[0] - eye[0])
    return wp.vec3(x, y, 2.0 * (q[0] * x + q[1] * y))


@wp.func
def bowl_outline_near(eye: wp.vec3, q: wp.vec3) -> wp.float32:
    length = wp.max(wp.sqrt(eye[0] * eye[0] + eye[1] * eye[1]), TINY)
    along = length - (q[0] * eye[0] + q[1] * eye[1]) / length
    across = (q[1] * eye[0] - q[0] * eye[1]) / length
    half = wp.max(bowl_arc(eye)[1], TINY)
    return wp.clamp(0.5 + 0.5 * wp.atan2(across, along) / half, 0.0, 0.9999999)


@wp.func
def bowl_outline_seen(eye: wp.vec3) -> wp.bool:
    return bowl_arc(eye)[1] > 0.0


@wp.func
def bowl_place(u: wp.vec2) -> wp.vec3:
    at = square_to_disk(u)
    return above(at[0], at[1])


@wp.func
def bowl_square(q: wp.vec3) -> wp.vec2:
    return disk_to_square(wp.vec2(q[0], q[1]))


@wp.func
def bowl_bend(q: wp.vec3, w: wp.vec3) -> wp.float32:
    return 2.0 * (w[0] * w[0] + w[1] * w[1])


@wp.func
def bowl_rim(u: wp.float32) -> wp.vec3:
    return wp.vec3(wp.cos(TWO_PI * u), wp.sin(TWO_PI * u), 1.0)


@wp.func
def bowl_rim_rate(q: wp.vec3) -> wp.vec3:
    return TWO_PI * wp.vec3(-q[1], q[0], 0.0)


@wp.func
def bowl_into(q: wp.vec3) -> wp.vec3:
    return wp.vec3(-q[0], -q[1], -2.0)


@wp.func
def bowl_rim_near(q: wp.vec3) -> wp.float32:
    return share_of_turn(q[1], q[0])


BOWL = affine_kind(
    8,
    Affine(
        point=above,
        coordinates=bowl_coordinates,
        hit=bowl_hit,
        normal=bowl_normal,
        tangents=bowl_tangents,
        uv=bowl_uv,
        rates=bowl_rates,
        pull=bowl_pull,
        level=bowl_level,
        graze=bowl_graze,
        outline=Outline(
            silhouette=bowl_silhouette,
            rate=bowl_silhouette_rate,
            nearest=bowl_outline_near,
            seen=bowl_outline_seen,
            place=bowl_place,
            square=bowl_square,
            gradient=bowl_normal,
            bend=bowl_bend,
            area=PI,
        ),
        rim=Rim(bowl_rim, bowl_rim_rate, bowl_into, bowl_rim_near),
    ),
)
'''
HOST = '''"""The exact bowl (``kernels/primitive/bowl.py``)."""

from __future__ import annotations

import numpy as np

from warp_psdr.kernels.primitive.bowl import BOWL
from warp_psdr.scene.kinds.affine import Exact, corners_of
from warp_psdr.scene.shapes.primitives import Tessellation


class Bowl(Exact):
    """The paraboloid z = x^2 + y^2 up to z = 1."""

    plugin = name = "bowl"
    device = BOWL
    box = corners_of((-1.0, 1.0), (-1.0, 1.0), (0.0, 1.0))

    @staticmethod
    def tessellate(resolution: int) -> Tessellation:
        """Return rings of quadrilaterals, each cut in two."""
        rings = resolution // 4
        r, turn = (a.ravel() for a in np.meshgrid(np.arange(rings + 1) / rings, np.arange(resolution), indexing="ij"))
        angle = 2.0 * np.pi * turn / resolution
        x, y = r * np.cos(angle), r * np.sin(angle)
        vertices = np.stack([x, y, x * x + y * y], axis=1)
        normals = np.stack([2.0 * x, 2.0 * y, -np.ones_like(x)], axis=1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        i, j = (a.ravel() for a in np.meshgrid(np.arange(rings), np.arange(resolution), indexing="ij"))
        a, b = i * resolution + j, i * resolution + (j + 1) % resolution
        c, d = a + resolution, b + resolution
        halves = np.stack([a, b, d], axis=1)[i > 0], np.stack([a, d, c], axis=1)
        faces = np.concatenate(halves).astype(np.int32)
        return Tessellation(vertices, faces, normals, 0.5 * vertices[:, :2] + 0.5)

    @staticmethod
    def points(u, v) -> np.ndarray:
        """Return the points (..., 3) above those of the disk."""
        return np.stack([u, v, np.square(u) + np.square(v)], axis=-1)
'''
PROGRAM = """
import json, sys
import numpy as np
import warp_psdr as psdr

SIZE, SPP, STEP = 16, 8192, 0.01
T = psdr.Transform
film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
view = T.look_at([0.4, -4.0, 2.4], [0.0, 0.2, 0.6], [0, 0, 1])
pose = T.translate([0.1, 0.0, 1.2]) @ T.rotate([1, 0.3, 0], 150.0) @ T.scale([0.7, 0.8, 0.6])


def load(move=0.0, **options):
    bowl = {"type": "bowl", "to_world": T.translate([move, 0.0, 0.0]) @ pose, **options}
    bowl["bsdf"] = {"type": "twosided", "below": {"type": "diffuse", "reflectance": 0.7}}
    return psdr.load_dict({
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 40.0, "to_world": view, "film": film},
        "bowl": bowl,
        "floor": {"type": "rectangle", "to_world": T.scale([3.0, 3.0, 1.0]), "bsdf": {"type": "diffuse"}},
        "lamp": {"type": "point", "position": [1.5, -1.0, 3.0], "intensity": 12.0},
    })


options = {"integrator": psdr.PathIntegrator(max_depth=2), "seed": 3}


def draw(scene, spp=SPP):
    return psdr.render(scene, **options, spp=spp).numpy()


ramp = np.linspace(-1.0, 1.0, SIZE, dtype=np.float32)
weight = np.broadcast_to(ramp[None, :, None], (SIZE, SIZE, 3)).copy()
scene = load(exact=True)
params = psdr.traverse(scene)
params.requires_grad("bowl.to_world")
tangent = np.zeros((4, 4), np.float32)
tangent[0, 3] = 1.0
image = draw(scene)
psdr.render_backward(scene, params, weight, **options, spp=2048)
forward = psdr.render_forward(scene, params, {"bowl.to_world": tangent}, **options, spp=2048).numpy()
difference = (draw(load(STEP, exact=True)) - draw(load(-STEP, exact=True))) / (2.0 * STEP)
inside = psdr.PathIntegrator(max_depth=2, boundary=None)
rest = psdr.render_forward(scene, params, {"bowl.to_world": tangent}, integrator=inside, spp=2048).numpy()
triangles = draw(load(resolution=96))
sunk = psdr.load_dict({"type": "scene", "sensor": {"type": "perspective", "to_world": view, "film": film},
                       "bowl": {"type": "bowl", "exact": True},
                       "floor": {"type": "rectangle", "to_world": T.translate([0, 0, 0.5]) @ T.scale(3.0)}})
try:
    psdr.plan(sunk, integrator=options["integrator"], names=["bowl.to_world"])
    refused = ""
except ValueError as error:
    refused = str(error)
json.dump({
    "image": float(image.mean()),
    "off": float(np.abs(image - triangles).mean()),
    "reverse": float(params["bowl.to_world"].grad.numpy().reshape(4, 4)[0, 3]),
    "forward": float((weight * forward).sum()),
    "difference": float((weight * difference).sum()),
    "interior": float((weight * rest).sum()),
    "refused": refused,
}, sys.stdout)
"""


def _add_row(file: Path, table: str, name: str, row: str) -> None:
    """Import a name in a file, and put it first in a table."""
    text = file.read_text()
    assert text.count(table) == 1
    text = text.replace(table, f"{table}\n    {name},")
    file.write_text(text.replace("\nfrom warp_psdr", f"\n{row}\nfrom warp_psdr", 1))


def test_a_file_and_a_row_on_either_side_add_a_kind(tmp_path: Path) -> None:
    for folder in ("kernels", "warp_psdr"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    (tmp_path / "kernels/primitive/bowl.py").write_text(DEVICE)
    (tmp_path / "warp_psdr/scene/kinds/bowl.py").write_text(HOST)
    device, host = tmp_path / "kernels/primitive/table.py", tmp_path / "warp_psdr/scene/kinds/table.py"
    _add_row(device, "KINDS: tuple[Kind, ...] = (", "BOWL", "from warp_psdr.kernels.primitive.bowl import BOWL")
    _add_row(host, "KINDS: tuple[type[Geometry], ...] = (", "Bowl", "from warp_psdr.scene.kinds.bowl import Bowl")
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["off"] < 0.01 * found["image"]
    assert "'floor' reaches into the box around 'bowl'" in found["refused"]
    # Without silhouettes and shadows the slope is another one.
    assert abs(found["interior"] - found["difference"]) > 0.2 * abs(found["difference"])
    assert np.isclose(found["forward"], found["difference"], rtol=0.05)
    assert np.isclose(found["reverse"], found["difference"], rtol=0.05)
