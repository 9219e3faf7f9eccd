"""The path of one sample, drawn again: ``psdr.trace_sample``."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.device import launch
from warp_psdr.invalid import TRACED
from warp_psdr.kernels.constants import RFILTER_BOX
from warp_psdr.kernels.path import PathVertex
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.kernels.trace import make_trace_kernel
from warp_psdr.options import PathIntegrator, from_description
from warp_psdr.passes import STREAM_INTERIOR, STREAM_PRIMAL
from warp_psdr.plan import decide

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Vertices that are kept of a path: far more than any that is not endless.
MOST_VERTICES = 1024


@dataclass(frozen=True)
class TracedVertex:
    """A path vertex.

    Attributes:
        shape: name of the shape that the ray meets; "": it leaves the scene.
        bsdf: its scattering model.
        face: number of the triangle, -1 outside.
        position: (3,) world units.
        direction: (3,) of the ray that arrives.
        throughput: (3,) product of scattering values over densities in front of it.
        direct: (3,) radiance of what the ray hits and of next-event estimation there, with their weights.
        beta: (3,) scattering value over density towards the next vertex; 0 at the last.
    """

    shape: str
    bsdf: str
    face: int
    position: np.ndarray
    direction: np.ndarray
    throughput: np.ndarray
    direct: np.ndarray
    beta: np.ndarray


@dataclass(frozen=True)
class Trace:
    """A sample's path; ``str`` is a table of its vertices.

    Attributes:
        vertices: in the order in which light is collected, camera first.
        radiance: (3,) what the sample adds to its pixel.
    """

    vertices: tuple[TracedVertex, ...]
    radiance: np.ndarray

    def __str__(self) -> str:
        lines = [f"radiance {_numbers(self.radiance)}"]
        for i, v in enumerate(self.vertices):
            where = f"{v.shape} ({v.bsdf}), triangle {v.face}" if v.shape else "leaves the scene"
            lines.append(f"{i + 1}. {where}: position {_numbers(v.position)}, ray {_numbers(v.direction)}")
            lines.append(
                f"   throughput {_numbers(v.throughput)}, direct {_numbers(v.direct)}, beta {_numbers(v.beta)}"
            )
        return "\n".join(lines)


def _numbers(v: np.ndarray) -> str:
    return "(" + ", ".join(f"{x:.6g}" for x in v) + ")"


def trace_sample(
    scene: Scene,
    *,
    pixel: tuple[int, int],
    sample: int,
    seed: int = 0,
    sensor: int = 0,
    integrator: PathIntegrator | None = None,
    kind: str = "image",
) -> Trace:
    """Draw the path of one sample of a pixel again, and return its vertices.

    With the arguments of the rendering that it belongs to, whose warning about samples that are not finite names them.

    Args:
        scene: a loaded scene, unchanged since.
        pixel: (x, y) in the crop window; under a filter that is wider than a pixel also next to it.
        sample: its number within the pixel.
        seed: of the rendering.
        sensor: of the rendering.
        integrator: of the rendering.
        kind: "image", or "interior" for the path of a gradient.

    Raises:
        ValueError: another kind, or a pixel that is not sampled.
    """
    if kind not in TRACED:
        raise ValueError(f"kind: got {kind!r}, expected one of {TRACED}; other samples have no path of their own")
    integrator = integrator or from_description(scene.description.integrator)
    plan = decide(scene, integrator=integrator, sensor=sensor)
    camera = scene.camera(sensor)
    splatted = kind == "image" and plan.config.filter != RFILTER_BOX
    margin = math.ceil(camera.filter_radius - 0.5) if splatted else 0
    x, y = pixel
    width, height = camera.crop_width + 2 * margin, camera.crop_height + 2 * margin
    if not (0 <= x + margin < width and 0 <= y + margin < height and sample >= 0):
        raise ValueError(
            f"pixel {pixel}, sample {sample}: expected a non-negative sample and a pixel from "
            f"({-margin}, {-margin}) to ({width - margin - 1}, {height - margin - 1})"
        )
    stream = STREAM_PRIMAL if kind == "image" else STREAM_INTERIOR
    vertices = wp.zeros(MOST_VERTICES, dtype=PathVertex, device=scene.device)
    count = wp.zeros(1, dtype=wp.int32, device=scene.device)
    launch(
        make_trace_kernel(plan.config, kind == "interior", RFILTER_BOX if splatted else None),
        dim=1,
        inputs=[
            scene.data(), camera, x, y, (y + margin) * width + x + margin, sample, mix_seed(seed, stream),
            plan.max_depth, plan.rr_depth,
        ],
        outputs=[vertices, count],
        device=scene.device,
    )  # fmt: skip
    records = vertices.numpy()[: min(int(count.numpy()[0]), MOST_VERTICES)]
    radiance = sum((r["throughput"] * r["direct"] for r in records), np.zeros(3, np.float32))
    return Trace(tuple(_vertex(scene, r) for r in records), radiance)


def _vertex(scene: Scene, record: np.void) -> TracedVertex:
    face = int(record["face"])
    rest = (record["d"], record["throughput"], record["direct"], record["beta"])
    if face < 0:
        return TracedVertex("", "", face, np.full(3, np.nan, np.float32), *rest)
    tri = scene.triangles.numpy()[face]
    u, v = record["u"], record["v"]
    position = (1.0 - u - v) * tri["p0"] + u * tri["p1"] + v * tri["p2"] + scene.origin
    shape = scene.description.shapes[int(tri["shape"])]
    return TracedVertex(shape.path, shape.bsdf.model, face, position, *rest)
