"""The lobes of glass in derivatives: what is transmitted at grazing angles is drawn often enough."""

import numpy as np
import pytest

import warp_psdr as psdr

#: Relative index; cosine at which glass is seen; least probability of the transmitted lobe (``kernels/scattering.py``).
ETA, COSINE, LEAST = 1.5, 0.03, 0.25
SAMPLES = 400


def pane() -> psdr.Scene:
    """Glass above a floor, seen at a grazing angle."""
    T = psdr.Transform
    return psdr.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 0.001,
                "to_world": T.look_at([0.0, -1.0, COSINE], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]),
                "film": {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}},
            },
            "sky": {"type": "constant"},
            "pane": {"type": "rectangle", "bsdf": {"type": "dielectric", "int_ior": ETA, "ext_ior": 1.0}},
            "floor": {"type": "rectangle", "to_world": T.translate([0.0, 0.0, -1.0]) @ T.scale(9.0)},
        }
    )


def first_weights(kind: str) -> np.ndarray:
    """Return (samples, 2): beta of the pane, and 1 where the path is refracted."""
    scene, integrator, rows = pane(), psdr.PathIntegrator(max_depth=3), []
    for sample in range(SAMPLES):
        path = psdr.trace_sample(scene, pixel=(0, 0), sample=sample, seed=3, integrator=integrator, kind=kind)
        rows.append((path.vertices[0].beta[0], path.vertices[1].shape == "floor"))
    return np.array(rows)


@pytest.mark.parametrize("kind", ["image", "interior"])
def test_derivatives_draw_what_is_transmitted_by_a_quarter_and_images_by_its_share(kind: str) -> None:
    c = COSINE / np.hypot(1.0, COSINE)
    g = np.sqrt(ETA**2 - 1.0 + c**2)
    transmittance = 2.0 * c * g * (1.0 / (c + g) ** 2 + ETA**2 / (ETA**2 * c + g) ** 2)
    assert transmittance < LEAST
    drawn = transmittance if kind == "image" else LEAST
    beta, refracted = first_weights(kind).T
    weight = np.where(refracted, transmittance / ETA**2 / drawn, (1.0 - transmittance) / (1.0 - drawn))
    np.testing.assert_allclose(beta, weight, rtol=1e-3)
    assert abs(refracted.mean() - drawn) < 4.0 * (drawn * (1.0 - drawn) / SAMPLES) ** 0.5
