"""Bits of images and derivatives of every kind of shape without triangles, for changes that are to leave them alone.

``python examples/benchmarks/bits.py write FILE`` renders 40 rows (image, gradient, derivative image) and writes their
SHA-256; ``... compare FILE`` renders them again and names what differs. The bits depend on the processor's vectors.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from pathlib import Path

import numpy as np

import warp_psdr as psdr

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from tests.boundary.random_shapes import shape
from tests.boundary.scenes import diffuse, floor

T = psdr.Transform
KINDS = ("sphere", "disk", "cylinder", "linear", "cubic", "network", "linearcurve", "bsplinecurve")
#: Parameter of each kind that is differentiated.
PARAMETERS = {
    **dict.fromkeys(KINDS[:3], "body.to_world"),
    **dict.fromkeys(("linear", "cubic"), "body.grid"),
    "network": "body.layer1.weight",
    **dict.fromkeys(KINDS[6:], "body.control_points"),
}
LIGHTS = {
    "sky": lambda: {"sky": {"type": "constant", "radiance": 1.0}},
    "lamp": lambda: {
        "lamp": {
            "type": "rectangle",
            "to_world": T.look_at((1.5, -1.0, 3.0), (0.0, 0.0, 0.5), (0, 1, 0)) @ T.scale((0.5, 0.5, 1.0)),
            "emitter": {"type": "area", "radiance": 8.0},
        }
    },
    "point": lambda: {"lamp": {"type": "point", "position": [1.5, -1.0, 3.0], "intensity": 12.0}},
}
MIRROR = {
    "type": "rectangle",
    "to_world": T.look_at((0.0, 2.0, 1.0), (0.0, -2.0, 0.8), (0, 0, 1)) @ T.scale((1.5, 1.5, 1.0)),
    "bsdf": {"type": "conductor"},
}
SIZE, SPP, SEED = 16, 8, 5


def rows() -> dict[str, tuple[str, str, str]]:
    """Name -> kind, light, and what is special."""
    found = {f"{kind}, {light}": (kind, light, "") for kind in KINDS for light in LIGHTS}
    found |= {
        f"{kind}, lamp, guided": (kind, "lamp", "guided") for kind in ("sphere", "linear", "cubic", "bsplinecurve")
    }
    found |= {f"{kind}, lamp, in a mirror": (kind, "lamp", "in a mirror") for kind in KINDS[:1] + KINDS[3:]}
    found |= {f"{kind}, lamp, as a mirror": (kind, "lamp", "as a mirror") for kind in KINDS[:1] + KINDS[3:]}
    return found


def scene_of(kind: str, light: str, special: str) -> psdr.Scene:
    """Return a scene with one shape of a kind over a floor."""
    body = shape(np.random.default_rng(7), kind, np.array([0.0, 0.0, 0.8]), 0.5)
    if special == "as a mirror":
        body["bsdf"] = {"type": "conductor"}
    view = {
        "type": "perspective",
        "fov": 40.0,
        "to_world": T.look_at((0.5, -3.5, 2.2), (0.0, 0.0, 0.7), (0, 0, 1)),
        "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}},
    }
    node = {"type": "scene", "sensor": view, "body": body, "floor": floor(0.0, 2.5, diffuse(0.6, 0.5, 0.4))}
    if special == "in a mirror":
        node["mirror"] = MIRROR
    return psdr.load_dict({**node, **LIGHTS[light]()})


def bits_of(kind: str, light: str, special: str) -> dict[str, str]:
    """Return the digests of a row, or why it is refused."""
    scene, name = scene_of(kind, light, special), PARAMETERS[kind]
    params = psdr.traverse(scene)
    params.requires_grad(name)
    guiding = psdr.guiding.KdTree(max_leaves=128) if special == "guided" else None
    integrator = psdr.PathIntegrator(max_depth=3, boundary=psdr.boundary.PathSpace(guiding=guiding))
    options = {"integrator": integrator, "spp": SPP, "seed": SEED}
    random = np.random.default_rng(3)

    def gradient() -> np.ndarray:
        adjoint = random.normal(size=(SIZE, SIZE, 3)).astype(np.float32)
        psdr.render_backward(scene, params, adjoint, **options)
        return params[name].grad.numpy()

    def derivative() -> np.ndarray:
        tangent = random.normal(size=params[name].numpy().shape)
        return psdr.render_forward(scene, params, {name: tangent}, **options).numpy()

    found = {}
    for part, draw in (
        ("image", lambda: psdr.render(scene, **options).numpy()),
        ("gradient", gradient),
        ("derivative image", derivative),
    ):
        try:
            values = draw()
            found[part] = hashlib.sha256(values.tobytes()).hexdigest() if values.any() else "zero"
        except ValueError as error:
            found[part] = f"refused: {error}"
    return found


def main() -> int:
    """Write or compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("do", choices=("write", "compare"))
    parser.add_argument("file", type=Path)
    parser.add_argument("--only", default="", help="rows whose names contain this")
    arguments = parser.parse_args()
    before = json.loads(arguments.file.read_text()) if arguments.do == "compare" else {}
    found, differs = {}, 0
    for name, row in rows().items():
        if arguments.only not in name:
            continue
        found[name] = bits_of(*row)
        said = " ".join(value[:8] for value in found[name].values())
        if before:
            wrong = [part for part, value in found[name].items() if before.get(name, {}).get(part) != value]
            differs += len(wrong)
            said = f"DIFFERS: {', '.join(wrong)}" if wrong else "equal"
        print(f"{name:<34} {said}", flush=True)
    if arguments.do == "write":
        arguments.file.write_text(json.dumps(found, indent=1))
    return 1 if differs else 0


if __name__ == "__main__":
    sys.exit(main())
