"""One sample of a boundary term, drawn again: the result of ``psdr.trace_sample``.

The term's own kernel runs over that one sample, compiled so that it writes down what it meets (``kernels/notes.py``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import html
from warp_psdr.device import launch, shared_copy
from warp_psdr.estimate.arguments import adjoint_array, flat_tangents
from warp_psdr.estimate.boundary.terms import TERMS, Request, Term, launches
from warp_psdr.estimate.passes import STREAM_BOUNDARY
from warp_psdr.kernels import notes
from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.kernels.invalid import COUNTER_SIZE
from warp_psdr.kernels.rng import mix_seed
from warp_psdr.plan.motion import motion
from warp_psdr.plan.transient import require_steady
from warp_psdr.scene.kinds.records import position_of

if TYPE_CHECKING:
    from warp_psdr.plan.plan import Plan
    from warp_psdr.scene.parameters import Parameters
    from warp_psdr.scene.scene import Scene

#: Rows that are kept: far more than any sample writes that is not endless.
MOST_NOTES = 4096
#: What a place is called (``kernels/notes.py``), in the words of [ZMY*20].
WHAT = {
    notes.NOTE_EDGE: "edge",
    notes.NOTE_POINT: "point",
    notes.NOTE_SENSOR: "x_1",
    notes.NOTE_SOURCE: "x_2",
    notes.NOTE_WALK: "walk",
    notes.NOTE_VERTEX: "path",
}


@dataclass(frozen=True)
class TracedPlace:
    """Where a boundary sample touches the scene.

    Attributes:
        what: "edge" or "point": the discontinuity; "x_1" and "x_2": ends of its segment towards the sensor and the
            source; "walk": a vertex on the way from x_1 to the camera; "path": one of any other light path, among them
            the paths that bring the radiance.
        shape: name of the shape; "": outside of the scene, or a light without a surface.
        bsdf: its scattering model.
        faces: numbers of the triangle, or of those that the edge borders; empty outside.
        edge: the edge's vertices, as numbered in ``shape``; (): no edge, or a curve in which two shapes run through
            each other.
        position: (3,) world units; NaN outside.
        direction: (3,) through the edge or point, along the segment, or of the ray that arrives.
        values: (3, 3) "path": throughput in front of it, radiance from it, scattering value over density; else in the
            first row what the sample carries there (weight, radiance or scale, by its kind).
    """

    what: str
    shape: str
    bsdf: str
    faces: tuple[int, ...]
    edge: tuple[int, ...]
    position: np.ndarray
    direction: np.ndarray
    values: np.ndarray

    def __str__(self) -> str:
        where = f"{self.shape} ({self.bsdf})" if self.shape else "outside"
        if self.faces:
            where += f", triangle{'s' if len(self.faces) > 1 else ''} {', '.join(map(str, self.faces))}"
        if self.edge:
            where += f", between its vertices {self.edge[0]} and {self.edge[1]}"
        labels = ("throughput", "direct", "beta") if self.what == "path" else ("carries",)
        values = ", ".join(f"{name} {numbers(row)}" for name, row in zip(labels, self.values, strict=False))
        return f"{self.what}: {where}: position {numbers(self.position)}, ray {numbers(self.direction)}; {values}"


@dataclass(frozen=True)
class BoundaryTrace:
    """A sample of a boundary term; ``str`` is a list of its places.

    Attributes:
        kind: name of the term.
        sample: its number.
        places: in the order in which they are met. Empty: the sample ends before any light is looked for.
        dropped: how many of its contributions are not finite.
    """

    kind: str
    sample: int
    places: tuple[TracedPlace, ...]
    dropped: int

    def __str__(self) -> str:
        head = f"{self.kind}, sample {self.sample}: {self.dropped} of its contributions are not finite"
        return "\n".join([head, *(f"{i + 1}. {place}" for i, place in enumerate(self.places))])

    def _repr_html_(self) -> str:
        return html.preformatted(str(self))


def numbers(v: np.ndarray) -> str:
    """Return a vector in six digits."""
    return "(" + ", ".join(f"{x:.6g}" for x in v) + ")"


def trace_boundary(
    scene: Scene,
    plan: Plan,
    params: Parameters,
    kind: str,
    sample: int,
    *,
    adjoint,
    tangents: dict | None,
    sensor: int,
    spp: int,
    seed: int,
) -> BoundaryTrace:
    """Draw a sample of a boundary term again (arguments as ``psdr.trace_sample``'s).

    Raises:
        ValueError: the method has no such term for this scene and these parameters, or not as many samples.
    """
    names = params.requested if tangents is None else list(tangents)
    role = "reverse" if tangents is None else "forward"
    if plan.boundary is None:
        raise ValueError(f"kind: got {kind!r}, but there is no boundary term: nothing named moves a discontinuity")
    require_steady(scene, sensor, f"kind={kind!r}")
    noted = replace(plan, config=replace(plan.config, noted=True))
    stream = mix_seed(seed, STREAM_BOUNDARY)
    request = Request(scene, noted, motion(scene, names), role, sensor, spp, stream)
    found = [t for term in TERMS[type(plan.boundary)] if term.name == kind for t in launches(term, request)]
    if not found:
        raise ValueError(f"kind: got {kind!r}, which {plan.boundary.label} does not estimate for {', '.join(names)}")
    term = found[0]
    if not 0 <= sample < term.samples:
        raise ValueError(f"sample: got {sample}, expected one of the {term.samples} of {kind!r}; is spp the call's?")
    camera = scene.camera(sensor)
    shape = (camera.crop_height, camera.crop_width)
    if tangents is None:
        asked = adjoint_array(np.ones((*shape, 3)) if adjoint is None else adjoint, shape, scene.device)
        # Room for float64 sums (``kernels/sink.py``).
        target = wp.zeros(2 * scene.values.shape[0], dtype=wp.float32, device=scene.device)
    else:
        asked = wp.zeros((1, 1), dtype=wp.vec3, device=scene.device)
        target = flat_tangents(scene, params, tangents)
    image = wp.zeros(shape if tangents is not None else (1, 1), dtype=wp.vec3, device=scene.device)
    size = COUNTER_SIZE + 1 + notes.NOTE_WORDS * MOST_NOTES
    data, *rest = term.inputs(sample, asked)
    record = shared_copy(data)
    record.invalid = wp.zeros(size, dtype=wp.int64, device=scene.device)
    launch(term.kernel, dim=1, inputs=[record, *rest], outputs=[target, image], device=scene.device)
    words = record.invalid.numpy()
    count = min(int(words[COUNTER_SIZE]), MOST_NOTES)
    rows = words[COUNTER_SIZE + 1 :][: notes.NOTE_WORDS * count].reshape(count, notes.NOTE_WORDS)
    return BoundaryTrace(kind, sample, tuple(_place(scene, _edges(term, rest), row) for row in rows), int(words[0]))


def _edges(term: Term, inputs: list) -> Edges | None:
    return next((x for x in inputs if isinstance(x, Edges.cls)), None)


def _place(scene: Scene, edges, row: np.ndarray) -> TracedPlace:
    what, number = WHAT[int(row[0])], int(row[1])
    values = row[2:].astype(np.int32).view(np.float32)
    u, v, vectors = values[0], values[1], values[2:].reshape(5, 3)
    position = vectors[0] + scene.origin
    ends: tuple[int, ...] = ()
    faces: tuple[int, ...] = ()
    if what == "edge":
        first = edges.first.numpy()
        faces = tuple(int(f) for f in edges.faces.numpy()[first[number] : first[number + 1]])
        ends = tuple(int(i) for i in edges.ends.numpy()[number] if i >= 0)
    elif number >= 0:
        faces = (number,)
    if not faces:
        position = np.full(3, np.nan)
        return TracedPlace(what, "", "", faces, ends, position, vectors[1], vectors[2:])
    tri = scene.triangles.numpy()[faces[0]]
    index = int(tri["shape"])
    shape = scene.description.shapes[index]
    if what != "edge":
        position = position_of(scene, tri, u, v) + scene.origin
    if shape.geometry is not None:
        faces = ()
    ends = tuple(i - scene.builder.shapes[index].first_vertex for i in ends)
    return TracedPlace(what, shape.path, shape.bsdf.model, faces, ends, position, vectors[1], vectors[2:])
