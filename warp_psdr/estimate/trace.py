"""The path of one sample, drawn again: ``psdr.trace_sample``."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import html
from warp_psdr.device import launch
from warp_psdr.estimate.arguments import sample_count
from warp_psdr.estimate.boundary.trace import BoundaryTrace, numbers, trace_boundary
from warp_psdr.estimate.guiding import automatic
from warp_psdr.estimate.passes import STREAM_INTERIOR, STREAM_PRIMAL, filter_margin, splats
from warp_psdr.invalid import KINDS, NUMBERED, TRACED
from warp_psdr.kernels.constants import RFILTER_BOX
from warp_psdr.kernels.interior.factors.media_sweep import explores_density
from warp_psdr.kernels.path_media import MediaVertex
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.kernels.trace import make_media_trace_kernel, make_trace_kernel
from warp_psdr.kernels.vertex import PathVertex
from warp_psdr.options import interior
from warp_psdr.options.integrator import Integrator, PathIntegrator
from warp_psdr.plan.integrator import integrator_of
from warp_psdr.plan.motion import moves_in_media
from warp_psdr.plan.plan import decide
from warp_psdr.scene.kinds.records import position_of
from warp_psdr.scene.loaded import check_loaded

if TYPE_CHECKING:
    from warp_psdr.plan.record import Plan
    from warp_psdr.scene.parameters import Parameters
    from warp_psdr.scene.scene import Scene

#: Vertices that are kept of a path: far more than any that is not endless.
MOST_VERTICES = 1024


@dataclass(frozen=True)
class TracedVertex:
    """A path vertex: where a ray meets a surface, or what scatters it in a medium.

    Attributes:
        shape: name of the shape that the ray meets; "": it leaves the scene, or is scattered before.
        bsdf: its scattering model.
        face: number of the triangle, -1 outside and on shapes without triangles.
        position: (3,) world units.
        direction: (3,) of the ray that arrives.
        throughput: (3,) product of scattering values over densities in front of it.
        direct: (3,) radiance of what the ray hits and of next-event estimation there, with their weights.
        beta: (3,) scattering value over density towards the next vertex; 0 at the last.
        medium: name of the medium that the ray arrives through; "": none.
        collides: whether it is scattered there.
        emitted: (3,) radiance of that medium along the ray, seen from its start.
    """

    shape: str
    bsdf: str
    face: int
    position: np.ndarray
    direction: np.ndarray
    throughput: np.ndarray
    direct: np.ndarray
    beta: np.ndarray
    medium: str = ""
    collides: bool = False
    emitted: np.ndarray = field(default_factory=lambda: np.zeros(3, np.float32))


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
        lines = [f"radiance {numbers(self.radiance)}"]
        for i, v in enumerate(self.vertices):
            face = f", triangle {v.face}" if v.face >= 0 else ""
            where = f"{v.shape} ({v.bsdf}){face}" if v.shape else "leaves the scene"
            if v.medium:
                where = f"in {v.medium}" if v.collides else f"through {v.medium}, {where}"
            lines.append(f"{i + 1}. {where}: position {numbers(v.position)}, ray {numbers(v.direction)}")
            emitted = f", emitted {numbers(v.emitted)}" if v.emitted.any() else ""
            beta = numbers(v.beta)
            lines.append(f"   throughput {numbers(v.throughput)}, direct {numbers(v.direct)}, beta {beta}{emitted}")
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return html.preformatted(str(self))


def trace_sample(
    scene: Scene,
    *,
    sample: int,
    pixel: tuple[int, int] | None = None,
    seed: int = 0,
    sensor: int | str = 0,
    integrator: Integrator | None = None,
    kind: str = "image",
    spp: int | None = None,
    params: Parameters | None = None,
    adjoint=None,
    tangents: dict | None = None,
) -> Trace | BoundaryTrace:
    """Draw the path of one sample again, and return its vertices.

    With the arguments of the rendering that it belongs to, whose warning about samples that are not finite names them.
    (Not of a budget's batches, which have seeds of their own.)

    Args:
        scene: a loaded scene, unchanged since.
        sample: its number, within the pixel or within the boundary term.
        pixel: (x, y) in the crop window; under a filter that is wider than a pixel also next to it. Samples of a
            boundary term belong to none.
        seed: of the rendering.
        sensor: of the rendering, its number or its id.
        integrator: of the rendering.
        kind: "image", "interior" for the path of a gradient, or the name of a boundary term, "secondary" for example.
        spp: of the rendering; default: the sensor's. It and ``adjoint`` are read for boundary terms only.
        params: of the rendering, after the same ``requires_grad``; also for "interior" in media, where flights are made
            to collide for the density, and in grids for what moves (that path is drawn if both are requested).
        adjoint: of ``render_backward``; default: ones. What nobody asks for is not traced.
        tangents: of ``render_forward``, in place of requests and adjoint.

    Returns:
        A ``Trace``; of a boundary term a ``BoundaryTrace``: its edge or point, the direction through it, and the
        vertices of the paths to either side.

    Raises:
        ValueError: another kind, a pixel that is not sampled, or arguments that its kind needs or does not take.
    """
    if kind not in KINDS or kind in NUMBERED:
        expected = tuple(k for k in KINDS if k not in NUMBERED)
        raise ValueError(
            f"kind: got {kind!r}, expected one of {expected}; what guiding evaluates is no path, and paths from the "
            "lights are not drawn again"
        )
    check_loaded(scene)
    integrator = integrator_of(scene, integrator)
    sensor = scene.description.camera_number(sensor)
    if kind not in TRACED:
        if params is None or pixel is not None:
            raise ValueError(f"kind {kind!r} takes the params of the gradient (or of its tangents) and no pixel")
        names = None if tangents is None else list(tangents)
        plan = decide(scene, params, integrator=integrator, sensor=sensor, names=names)
        if integrator.boundary == "auto" and plan.boundary is not None:
            plan = automatic.follow(scene, plan, params.requested if names is None else names, sensor, seed)
        return trace_boundary(
            scene, plan, params, kind, sample,
            adjoint=adjoint, tangents=tangents, sensor=sensor, spp=sample_count(scene, sensor, spp), seed=seed,
        )  # fmt: skip
    if pixel is None:
        raise ValueError(f"kind {kind!r} takes the pixel of the sample, (x, y)")
    plan = decide(scene, integrator=integrator, sensor=sensor)
    among_media = plan.config.media is not None
    if among_media and kind == "interior":
        if params is None:
            raise ValueError(f"kind {kind!r} takes the params of the gradient in a scene with media")
        plan = decide(
            scene, params, integrator=integrator, sensor=sensor, names=None if tangents is None else list(tangents)
        )
    camera = scene.camera(sensor)
    splatted = kind == "image" and splats(camera)
    margin = filter_margin(camera) if splatted else 0
    x, y = pixel
    width, height = camera.crop_width + 2 * margin, camera.crop_height + 2 * margin
    if not (0 <= x + margin < width and 0 <= y + margin < height and sample >= 0):
        raise ValueError(
            f"pixel {pixel}, sample {sample}: expected a non-negative sample and a pixel from "
            f"({-margin}, {-margin}) to ({width - margin - 1}, {height - margin - 1})"
        )
    stream = STREAM_PRIMAL if kind == "image" else STREAM_INTERIOR
    filter_kind = RFILTER_BOX if splatted else None
    if among_media:
        kernel = _media_kernel(plan, integrator, kind, filter_kind)
    else:
        kernel = make_trace_kernel(plan.seen, kind == "interior", filter_kind)
    vertices = wp.zeros(MOST_VERTICES, dtype=MediaVertex if among_media else PathVertex, device=scene.device)
    count = wp.zeros(1, dtype=wp.int32, device=scene.device)
    launch(
        kernel,
        dim=1,
        inputs=[
            scene.data(compensated=True), camera, x, y, (y + margin) * width + x + margin, sample,
            mix_seed(seed, stream), plan.max_depth, plan.rr_depth,
        ],
        outputs=[vertices, count],
        device=scene.device,
    )  # fmt: skip
    records = vertices.numpy()[: min(int(count.numpy()[0]), MOST_VERTICES)]
    found = tuple(_step(scene, r) if among_media else _vertex(scene, r) for r in records)
    radiance = sum((v.throughput * v.direct for v in found), np.zeros(3, np.float32))
    if among_media:
        radiance = sum((r["before"] * r["emitted"] for r in records), radiance)
    return Trace(found, radiance)


def _media_kernel(plan: Plan, integrator: PathIntegrator, kind: str, filter_kind: int | None) -> wp.Kernel:
    """Return the kernel that draws paths through media as the image, or the interior term of a plan, does."""
    config, wanted = plan.config, plan.wanted
    assert config.media is not None
    if kind == "image":
        return make_media_trace_kernel(config, False, False, True, filter_kind)
    moves = wanted is not None and moves_in_media(wanted)
    explores = config.media.grids if moves else wanted is not None and explores_density(wanted)
    clocked = not isinstance(integrator.interior, interior.DifferentialRatioTracking)
    return make_media_trace_kernel(config, True, explores, clocked, filter_kind)


def _step(scene: Scene, record: np.void) -> TracedVertex:
    """Return the vertex at the end of a flight; of those that leave the scene and collide not, the position is NaN."""
    vertex = _vertex(scene, record["surface"])
    through = int(record["medium"])
    medium = scene.builder.medium_names[through] if through >= 0 else ""
    if not record["collides"]:
        return replace(vertex, medium=medium, emitted=record["emitted"])
    position = record["surface"]["o"] + record["t"] * record["surface"]["d"] + scene.origin
    return replace(
        vertex, shape="", bsdf="", face=-1, position=position, medium=medium, collides=True, emitted=record["emitted"]
    )


def _vertex(scene: Scene, record: np.void) -> TracedVertex:
    face = int(record["face"])
    rest = (record["d"], record["throughput"], record["direct"], record["beta"])
    if face < 0:
        return TracedVertex("", "", face, np.full(3, np.nan, np.float32), *rest)
    tri = scene.triangles.numpy()[face]
    u, v = record["u"], record["v"]
    position = position_of(scene, tri, u, v) + scene.origin
    shape = scene.description.shapes[int(tri["shape"])]
    return TracedVertex(shape.path, shape.bsdf.model, face if shape.geometry is None else -1, position, *rest)
