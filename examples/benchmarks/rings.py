"""Recovers an object from Middlebury's sparse rings of 16 photographs: shape, albedo and light, with four kept back.

    python examples/benchmarks/rings.py FOLDER [--boundary none] [--mitsuba] [--share 0.25] [--output rings.jsonl]

FOLDER holds ``dinoSparseRing`` or ``templeSparseRing``, unpacked from https://vision.middlebury.edu/mview/data.

The start is the visual hull of the given silhouettes, of one albedo, in even light. Every stage of ``STAGES`` makes a
mesh of even triangles and steps of two photographs each: first the light alone, then light, albedo and shape. The light
is a map around the object that stands still with it: normals of the hull explain the photographs in the object's frame,
and not in the camera's. Codes are taken for linear, which leaves the least residual. Principal points are moved by what
makes the given silhouettes agree. Outside of its silhouette the object is black.

``--boundary none`` leaves the boundary term out. ``--mitsuba`` has Mitsuba's ``prb_projective`` make the same steps;
``--share`` makes a part of them.

Leaves in ``out/rings/NAME/``: ``kept.png`` (photographs that were kept, the same views of the start and of what was
found, and the difference), ``mesh.png`` and ``mesh.ply``.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import rings_data as data
import trimesh
import warp as wp
from common import ROOT, Report, arguments, psdr
from scipy.spatial import cKDTree

from warp_psdr import plots

#: Samples a pixel of the images that judge, of those that are only shown, and the first of their seeds, which no step
#: has.
JUDGE_SPP, SHOWN_SPP, JUDGE_SEED = 512, 128, 2**31
#: A stage's rates are constant for this share of its steps and then fall by this factor.
CONSTANT, FALL = 0.4, 0.1
#: Steps between two lines of output.
TOLD = 50
#: Vertices of an old mesh whose albedo a new vertex takes over.
NEIGHBOURS = 4


class Ours:
    """This renderer.

    Args:
        ring: photographs and cameras.
        model: where it starts.
        stage: steps, rates and weights.
        depth: of paths.
        boundary: whether the boundary term is computed.
    """

    name = "warp_psdr"

    def __init__(self, ring: data.Ring, model: data.Model, stage: data.Stage, *, depth: int, boundary: bool):
        paint = {"type": "mesh_attribute", "name": data.ALBEDO.rpartition(".")[2]}
        shape = {
            "type": "mesh",
            "vertices": np.float32(model.vertices),
            "faces": np.int32(model.faces),
            "face_normals": True,
            paint["name"]: np.float32(model.albedo),
            "bsdf": {"type": "diffuse", "reflectance": paint},
        }
        sky = {"type": "envmap", "data": np.float32(model.light)}
        sensors = {f"view_{i:02}": ring.sensor(i) for i in range(len(ring.views))}
        self._scene = psdr.load_dict({"type": "scene", "object": shape, "sky": sky, **sensors})
        self._params = psdr.traverse(self._scene)
        self._integrator = psdr.PathIntegrator(
            max_depth=depth, hide_emitters=True, boundary="auto" if boundary else None
        )
        self._faces, self._targets = model.faces, ring.linear
        rates = {name: rate for name, rate in stage.rates.items() if rate > 0.0}
        self._params.requires_grad(*rates)
        if data.SHAPE in rates:
            self._optimiser = psdr.optim.LargeSteps(self._params, rates, lambda_=stage.smooth, betas=data.BETAS)
        else:
            self._optimiser = psdr.optim.Adam(self._params, rates, betas=data.BETAS)

    def step(self, views: list[int], seed: int, scale: float) -> float:
        """Make one step and return its loss."""
        total = 0.0
        for k in views:
            tape = wp.Tape()
            with tape:
                image = psdr.render(
                    self._scene, self._params, sensor=k, integrator=self._integrator,
                    spp=data.SPP, spp_grad=data.SPP_GRADIENT, seed=seed + k, tape=tape,
                )  # fmt: skip
                loss = psdr.losses.l2(image, self._targets[k])
            tape.backward(grads={loss: wp.full(1, 1.0 / len(views), dtype=wp.float32, device=loss.device)})
            total += float(loss) / len(views)
        self._optimiser.step(scale=scale)
        return total

    def image(self, view: int, spp: int, seed: int) -> np.ndarray:
        """Return what a camera sees, (H, W, 3)."""
        return psdr.render(self._scene, sensor=view, integrator=self._integrator, spp=spp, seed=seed).numpy()

    def model(self) -> data.Model:
        """Return what has been found."""
        found = [self._params[name].numpy().copy() for name in (data.SHAPE, data.ALBEDO, data.LIGHT)]
        return data.Model(found[0].astype(np.float64), self._faces, found[1], found[2])


def remeshed(model: data.Model, spacing: float) -> data.Model:
    """Return a model of even triangles, with edges of about ``spacing``, m; the albedo is that of the nearest."""
    vertices, faces = data.remesh.remesh(model.vertices, model.faces, spacing)
    distance, nearest = cKDTree(model.vertices).query(vertices, k=NEIGHBOURS)
    weights = 1.0 / (distance + 0.01 * spacing)
    albedo = np.einsum("nk,nkc->nc", weights / weights.sum(axis=1, keepdims=True), model.albedo[nearest])
    return data.Model(vertices, faces, albedo, model.light)


def fit(ring: data.Ring, make, stages: tuple[data.Stage, ...]):
    """Make all steps.

    Args:
        ring: photographs and cameras.
        make: (model, stage) -> a renderer.
        stages: in turn.

    Returns:
        The last renderer, and what all cameras see after the first stage, of the hull in the light that was found.
    """
    model = data.start(ring)
    rng, done, queue, start = np.random.default_rng(0), 0, [], []
    began = time.perf_counter()
    for stage in stages:
        model = remeshed(model, stage.spacing)
        renderer = make(model, stage)
        for i in range(stage.steps):
            if len(queue) < data.VIEWS:
                queue += rng.permutation(ring.given).tolist()
            views, queue = queue[: data.VIEWS], queue[data.VIEWS :]
            falling = max(i / stage.steps - CONSTANT, 0.0) / (1.0 - CONSTANT)
            # Two seeds a view and step: of the image, and of its derivatives.
            loss = renderer.step(views, 2 * len(ring.views) * done, FALL**falling)
            done += 1
            if done % TOLD == 0:
                print(f"step {done}: loss {loss:.5f}, {time.perf_counter() - began:.0f} s", flush=True)
        model = renderer.model()
        start = start or images(renderer, ring, SHOWN_SPP)
        print(f"{len(model.faces)} triangles, {time.perf_counter() - began:.0f} s", flush=True)
    return renderer, start


def images(renderer, ring: data.Ring, spp: int) -> list[np.ndarray]:
    """Return what all cameras see; ``spp`` samples a pixel for those that were kept."""
    samples = [spp if k in ring.kept else min(spp, SHOWN_SPP) for k in range(len(ring.views))]
    return [renderer.image(k, n, JUDGE_SEED + k) for k, n in enumerate(samples)]


def kept_decibels(ring: data.Ring, seen: list[np.ndarray]) -> list[float]:
    """Return the decibels of the views that were kept."""
    return [ring.decibels(seen[k], k) for k in ring.kept]


def draw(folder: Path, ring: data.Ring, start: list, found: list, model: data.Model) -> None:
    """Write the pictures and the mesh."""
    folder.mkdir(parents=True, exist_ok=True)
    apart = [4.0 * np.abs(image - photograph) for image, photograph in zip(found, ring.linear, strict=True)]
    rows = {"photograph, kept": ring.linear, "hull": start, "found": found, "4 |difference|": apart}
    titles = [name for name in rows for _k in ring.kept]
    pictures = [shown[k] for shown in rows.values() for k in ring.kept]
    plots.side_by_side(folder / "kept.png", pictures, titles, columns=len(ring.kept))
    trimesh.Trimesh(model.vertices, model.faces, process=False).export(folder / "mesh.ply")
    plain = data.Model(model.vertices, model.faces, np.full_like(model.albedo, 0.7), data.lamp())
    still = data.Stage(steps=0, spacing=0.0, smooth=1.0, rates={data.SHAPE: 0.0, data.ALBEDO: 0.0, data.LIGHT: 1.0})
    renderer = Ours(ring, plain, still, depth=2, boundary=False)
    shapes = [renderer.image(k, SHOWN_SPP, JUDGE_SEED + k) for k in ring.kept]
    plots.side_by_side(folder / "mesh.png", shapes, ["shape found"] * len(shapes), columns=len(shapes))


def main() -> None:
    """Recover an object and report how near it comes to the photographs that were kept."""
    parser = arguments(__doc__)
    parser.add_argument("folder", type=Path, help="dinoSparseRing or templeSparseRing, unpacked")
    parser.add_argument("--boundary", choices=["auto", "none"], default="auto", help="none: leave its term out")
    parser.add_argument("--mitsuba", action="store_true", help="let Mitsuba render and differentiate")
    parser.add_argument("--depth", type=int, default=3, help="most vertices of a path behind the camera")
    parser.add_argument("--share", type=float, default=1.0, help="of the steps of all stages that are made")
    options = parser.parse_args()
    boundary = options.boundary != "none"
    ring = data.Ring(options.folder)
    print(f"principal points {ring.offset:.2f} pixels lower", flush=True)
    if options.mitsuba:
        from rings_mitsuba import Theirs

        fixed = {"depth": options.depth, "boundary": boundary, "threads": options.threads}
        make = lambda model, stage: Theirs(ring, model, stage, **fixed)  # noqa: E731
    else:
        make = lambda model, stage: Ours(ring, model, stage, depth=options.depth, boundary=boundary)  # noqa: E731
    stages = data.QUICK if options.quick else data.STAGES
    stages = tuple(replace(stage, steps=max(round(options.share * stage.steps), 1)) for stage in stages)
    began = time.process_time()
    renderer, start = fit(ring, make, stages)
    found, seconds = images(renderer, ring, JUDGE_SPP), time.process_time() - began
    decibels = kept_decibels(ring, found)
    row = {
        "object": options.folder.name,
        "renderer": renderer.name,
        "boundary": boundary,
        "given views [dB]": float(np.mean([ring.decibels(found[k], k) for k in ring.given])),
        "kept views [dB]": float(np.mean(decibels)),
        "least of them [dB]": min(decibels),
        "kept views, hull [dB]": float(np.mean(kept_decibels(ring, start))),
        "triangles": len(renderer.model().faces),
        "steps": sum(stage.steps for stage in stages),
        "processor time [s]": seconds,
    }
    name = "-".join([options.folder.name, renderer.name, "boundary" if boundary else "interior"])
    draw(ROOT / "out" / "rings" / name, ring, start, found, renderer.model())
    Report("rings", options.output).table("Shape, albedo and light from 12 photographs; four kept back", [row])


if __name__ == "__main__":
    main()
