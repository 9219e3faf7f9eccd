"""Scenes that are rendered and differentiated at every step of a sweep, and how far two results are apart."""

import functools
from dataclasses import dataclass

import numpy as np

import warp_psdr as psdr

FILM = 16
#: Samples a pixel of everything; both sides of a comparison draw the same random numbers.
SPP = 16
SEED = 7
#: The tilted box below moves along it (units of its size).
VELOCITY = np.array([0.6, -0.3, 0.5])


@dataclass(frozen=True)
class Result:
    """What the passes returned, float64: the image, and its derivative with a boundary term and without."""

    image: np.ndarray
    interior: np.ndarray
    full: np.ndarray


def box(center, size, turn: float = 25.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the 8 vertices, float64, and the 12 triangles of a turned box."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64) * size
    matrix = psdr.Transform.rotate((0.28221627, 0.18814418, 0.94072091), turn).matrix[:3, :3]
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
             [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]  # fmt: skip
    return corners @ matrix.T + center, np.array(faces)


def rectangle(center, half, turn) -> tuple[np.ndarray, np.ndarray]:
    """Return the 4 vertices and the 2 triangles of a turned rectangle that faces +z before it is turned."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float64) * half
    return corners @ psdr.Transform(turn).matrix[:3, :3].T + center, np.array([[0, 1, 2], [0, 2, 3]])


def room(scale: float = 1.0, offset=(0.0, 0.0, 0.0), *, film: int = FILM, extra: dict | None = None) -> dict:
    """Return a floor with a box above it under an area light, seen from the side, ``scale`` large and ``offset`` away.

    Everything is a mesh given in place, in float64.
    """

    def mesh(parts, **more) -> dict:
        vertices, faces = parts
        return {"type": "mesh", "vertices": scale * vertices + np.asarray(offset), "faces": faces} | more

    gray = {"bsdf": {"type": "diffuse", "reflectance": 0.6}, "face_normals": True}
    down = psdr.Transform.rotate((1, 0, 0), 180.0)
    view = psdr.Transform.look_at((0.0, -5.0, 3.0), (0.0, 0.0, 0.5), (0, 0, 1)).matrix.copy()
    view[:3, 3] = scale * view[:3, 3] + offset
    return {
        "type": "scene",
        "camera": {
            "type": "perspective", "to_world": view, "fov": 40.0,
            "near_clip": 0.01 * scale, "far_clip": 100.0 * scale,
            "film": {"type": "hdrfilm", "width": film, "height": film, "rfilter": {"type": "box"}},
        },
        "floor": mesh(rectangle((0, 0, 0), 3.0, np.eye(4)), **gray),
        "box": mesh(box((0.2, 0.1, 1.0), 0.5), **gray),
        "lamp": mesh(rectangle((0.5, 0.0, 3.5), 0.5, down), emitter={"type": "area", "radiance": 8.0}),
    } | (extra or {})  # fmt: skip


def passes(
    scene,
    velocity: np.ndarray,
    *,
    name: str = "box.vertex_positions",
    depth: int = 3,
    spp: int = SPP,
    boundary: bool = True,
) -> Result:
    """Return image and derivatives of a loaded scene as one shape moves with a velocity, world units a unit of time."""
    params = psdr.traverse(scene)
    tangents = {name: np.broadcast_to(velocity, params[name].numpy().shape).astype(np.float32)}

    def derivative(method):
        integrator = psdr.PathIntegrator(max_depth=depth, boundary=method)
        image = psdr.render_forward(scene, params, tangents, integrator=integrator, spp=spp, seed=SEED)
        return image.numpy().astype(np.float64)

    image = psdr.render(scene, integrator=psdr.PathIntegrator(max_depth=depth), spp=spp, seed=SEED).numpy()
    interior = derivative(None)
    return Result(image.astype(np.float64), interior, derivative("auto") if boundary else interior)


def apart(a: np.ndarray, b: np.ndarray) -> float:
    """Return the relative difference of two arrays, in the mean absolute value; infinite where either is not finite."""
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return np.inf
    return float(np.abs(a - b).mean() / np.abs(b).mean())


def worst(a: Result, b: Result) -> float:
    """Return the largest relative difference of image, interior derivative and whole derivative."""
    return max(apart(a.image, b.image), apart(a.interior, b.interior), apart(a.full, b.full))


#: Batches of a statistical comparison, the reference's, and samples a pixel of each.
BATCHES, REFERENCE_BATCHES, BATCH_SPP = 8, 16, 256


def derivatives(
    description: dict,
    batches: int = BATCHES,
    first_seed: int = 0,
    spp: int = BATCH_SPP,
    *,
    velocity: np.ndarray = VELOCITY,
) -> np.ndarray:
    """Return derivative images of ``room``'s box as it moves, one a batch, all terms together."""
    scene = psdr.load_dict(description)
    params = psdr.traverse(scene)
    name = "box.vertex_positions"
    tangents = {name: np.broadcast_to(velocity, params[name].numpy().shape).astype(np.float32)}
    options = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": spp}
    images = (psdr.render_forward(scene, params, tangents, seed=first_seed + b, **options) for b in range(batches))
    return np.array([image.numpy().astype(np.float64) for image in images])


@functools.cache
def reference() -> tuple[Result, np.ndarray]:
    """Return what the passes give for ``room``, and the mean of its derivatives over independent batches."""
    return passes(psdr.load_dict(room()), VELOCITY), derivatives(room(), REFERENCE_BATCHES, 100).mean(axis=0)


def slope_error(found: np.ndarray, expected: np.ndarray) -> float:
    """Return how far the regression of batches of images on the expected one is from 1; infinite if not finite."""
    if not np.isfinite(found).all():
        return np.inf
    return float(abs((found.mean(axis=0) * expected).sum() / (expected * expected).sum() - 1.0))
