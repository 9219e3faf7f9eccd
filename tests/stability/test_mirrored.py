"""Hard meshes seen in a mirror, against the mirrored mesh seen directly: the search along lines, where rims are close.

A mirror in the plane z = 0 that reflects all, and what shines above it; its image is that of a mesh below, without it.
"""

import math

import numpy as np
import pytest
import trimesh

import warp_psdr as psdr

from .record import Case, parameters

FILM, BATCHES, SPP = 16, 8, 128
VELOCITY, CENTER = np.array([0.3, -0.2, 0.5]), np.array([0.05, 0.3, 0.8])
BELOW = np.array([1.0, 1.0, -1.0])
EYE = np.array([0.0, -2.0, 1.0])
#: Weights of the pixels: the sum of a derivative does not tell where an edge is.
WEIGHT = np.linspace(0.5, 1.5, FILM * FILM).reshape(FILM, FILM)
#: Two-sided quantile of Student's t with 7 degrees of freedom at 1e-3, and the largest standard error over the value.
Z_LIMIT, LARGEST_NOISE = 5.4, 0.03


def scene(size: float, meshes: dict[str, tuple[np.ndarray, np.ndarray, float]], mirror: bool) -> dict:
    """Return meshes (vertices, faces, radiance) above a mirror, or their images; the film spans 3.2 ``size``."""
    target = CENTER * BELOW
    fov = 2.0 * math.degrees(math.atan(1.6 * size / float(np.linalg.norm(target - EYE))))
    film = {"type": "hdrfilm", "width": FILM, "height": FILM, "rfilter": {"type": "box"}}
    view = {"type": "perspective", "fov": fov, "film": film,
            "to_world": psdr.Transform.look_at(EYE, target, (0, 0, 1))}  # fmt: skip
    found: dict = {"type": "scene", "camera": view}
    if mirror:
        metal = {"type": "conductor", "material": "none"}
        found["mirror"] = {"type": "rectangle", "to_world": psdr.Transform.scale(2.0), "bsdf": metal}
    for name, (vertices, faces, radiance) in meshes.items():
        found[name] = {
            "type": "mesh", "face_normals": True,
            "vertices": vertices if mirror else vertices * BELOW,
            "faces": faces if mirror else faces[:, ::-1],
            "bsdf": {"type": "diffuse", "reflectance": 0.0},
            "emitter": {"type": "area", "radiance": radiance},
        }  # fmt: skip
    return found


def derivatives(description: dict, name: str, velocity: np.ndarray, spp: int) -> np.ndarray:
    """Return weighted sums of the image's derivative, one a batch, as a mesh moves."""
    loaded = psdr.load_dict(description)
    params = psdr.traverse(loaded)
    tangents = {f"{name}.vertex_positions": np.tile(np.float32(velocity), (len(description[name]["vertices"]), 1))}
    options = {"integrator": psdr.PathIntegrator(max_depth=2 if "mirror" in description else 1), "spp": spp}
    images = [psdr.render_forward(loaded, params, tangents, seed=s, **options).numpy() for s in range(BATCHES)]
    assert not any(psdr.invalid_samples(loaded).values())
    return np.array([(image[..., 0] * WEIGHT).sum(dtype=np.float64) for image in images])


def ball(size: float) -> tuple[np.ndarray, np.ndarray, float]:
    mesh = trimesh.creation.icosphere(subdivisions=3)
    return np.asarray(mesh.vertices) * size + CENTER, np.asarray(mesh.faces), 1.0


def fine(size: float) -> float:
    """Return |z|, over its limit, of the derivative in the mirror and seen directly; infinite if too noisy."""
    meshes = {"ball": ball(size)}
    expected = derivatives(scene(size, meshes, False), "ball", VELOCITY * BELOW, 16 * SPP)
    found = derivatives(scene(size, meshes, True), "ball", VELOCITY, SPP)
    sigma = math.sqrt((found.var(ddof=1) + expected.var(ddof=1)) / BATCHES)
    apart = float(found.mean() - expected.mean())
    return math.inf if not 0.0 < sigma < LARGEST_NOISE * abs(expected.mean()) else abs(apart) / sigma / Z_LIMIT


CASES = (
    Case(
        family="mirrored", name="balls of 1,280 triangles, 0.1 and 0.01 large (|z| over its limit)", bound=1.0,
        quantile=True, slow=True, measure=lambda: max(fine(0.1), fine(0.01)),
        hard="triangles are as small as a few ray epsilons, by which a ray misses an edge",
        naive="an edge is looked for within a share of its triangle: 0.7 of the derivative at 0.01",
    ),
)  # fmt: skip


@pytest.mark.parametrize("case", parameters(CASES))
def test_mirrored(case, check) -> None:
    check(case)


@pytest.mark.slow
@pytest.mark.parametrize("gap", [0.0, 3e-5])
def test_faces_over_one_another_in_a_mirror(gap: float) -> None:
    """A plate that moves, and within its outline a brighter one that rests.

    In one plane, which of the two is met is up to rounding: where that changes is no discontinuity, so that the
    derivative is that of the larger plate alone. Its naive estimate has 10^4 times the variance.
    """
    square = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    turn = psdr.Transform.rotate((0.28221627, 0.94072091, 0.18814418), 170.0).matrix[:3, :3]
    faces = np.array([[0, 1, 2], [0, 2, 3]])

    def plate(size: float, z: float, radiance: float) -> tuple[np.ndarray, np.ndarray, float]:
        return (size * square + [0.0, 0.0, z]) @ turn.T + CENTER, faces, radiance

    one, other = plate(0.11, 0.0, 1.0), plate(0.1, gap, 3.0)
    expected = derivatives(scene(0.1, {"one": one}, True), "one", turn[:, 0], SPP)
    found = derivatives(scene(0.1, {"one": one, "other": other}, True), "one", turn[:, 0], SPP)
    np.testing.assert_allclose(found, expected, rtol=1e-5)
