"""Certificates in worlds of other sizes: images stay, right gradients do, and lost lengths show."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.boundary.scenes import T, ball, diffuse, floor
from warp_psdr.certify import precision
from warp_psdr.certify.precision import SCALES, NotScaled, scaling, world_of
from warp_psdr.certify.subject import SceneSubject
from warp_psdr.options.integrator import PathIntegrator

SIZE, SPP = 8, 64
ALBEDO = "ball.bsdf.reflectance.value"
#: Of the mean pixel; paths whose choices fall differently by rounding are less than one in a thousand.
SAME = 0.01
AIM = T.look_at([0.3, -3.0, 1.5], [0.0, 0.0, 0.3], [0, 0, 1])
LAMP = T.look_at([1.0, -1.0, 2.0], [0.0, 0.0, 0.0], [0, 1, 0])
WHITE = {"type": "rgb", "value": [1.0, 1.0, 1.0]}


def film():
    return {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}


def fog(**more):
    return {"type": "cube", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous", "sigma_t": 0.4, **more}}


def lights(*kinds):
    described = {
        "point": {"type": "point", "position": [-1.0, 0.5, 2.0], "intensity": WHITE},
        "spot": {"type": "spot", "to_world": LAMP, "cutoff_angle": 40.0, "intensity": WHITE},
        "projector": {"type": "projector", "to_world": LAMP, "fov": 40.0, "irradiance": WHITE},
        "constant": {"type": "constant", "radiance": WHITE},
    }
    return {kind: described[kind] for kind in kinds}


#: Distances from a sphere at the corners of a grid.
SPHERE = (np.linalg.norm(np.indices((5, 5, 5)) / 4.0 - 0.5, axis=0) - 0.3).astype(np.float32)[..., None]
SCENES = {
    "lamps in fog": {
        "camera": {"type": "thinlens", "fov": 40.0, "aperture_radius": 0.1, "focus_distance": 3.2, "to_world": AIM},
        "fog": fog(albedo=0.7),
        **lights("point", "spot"),
    },
    "an orthographic camera": {
        "camera": {"type": "orthographic", "to_world": AIM @ T.scale([1.2, 1.2, 1.0]), "near_clip": 0.5},
        **lights("constant", "projector"),
    },
}


def loaded(name: str) -> tuple[SceneSubject, psdr.Parameters]:
    described = SCENES[name]
    camera = described["camera"] | {"film": film()}
    shapes = {"ball": ball((0.0, 0.0, 0.4), 0.4, diffuse(0.6)), "floor": floor(0.0, 1.5, diffuse(0.4))}
    scene = psdr.load_dict({**described, "type": "scene", "camera": camera, **shapes})
    params = psdr.traverse(scene)
    params.requires_grad(ALBEDO)
    subject = SceneSubject.of(scene, [ALBEDO], PathIntegrator(max_depth=3), 0)
    return subject, params


@pytest.mark.parametrize("name", SCENES)
def test_images_of_larger_and_smaller_worlds_are_the_same(name: str) -> None:
    subject, _params = loaded(name)
    options = {"integrator": subject.integrator, "spp": SPP, "seed": 1}
    before = psdr.render(subject.scene, **options).numpy()
    for scale in SCALES:
        with world_of(subject, scale, scaling(subject.scene, scale)):
            image = psdr.render(subject.scene, **options).numpy()
        assert before.mean() > 0.01 and np.abs(image - before).mean() < SAME * before.mean()
        np.testing.assert_array_equal(psdr.render(subject.scene, **options).numpy(), before)


def test_a_derivative_that_changes_with_the_size_of_the_world_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    subject, params = loaded("an orthographic camera")
    options = {"integrator": subject.integrator, "budget": 20.0, "checks": "precision"}
    certificate = psdr.certify(subject.scene, params, **options)
    assert certificate.ok is True and [f.what for f in certificate.findings] == ["world × 0.001", "world × 1000"]
    right = SceneSubject.gradients

    def gradients(self, adjoints, seed):
        """Lose what is nearer than a hundredth."""
        found = right(self, adjoints, seed)
        share = self.scene.radius / (0.01 + self.scene.radius)
        return {name: share * gradient for name, gradient in found.items()}

    monkeypatch.setattr(SceneSubject, "gradients", gradients)
    verdicts = {f.what: f.verdict for f in psdr.certify(subject.scene, params, **options).findings}
    assert verdicts == {"world × 0.001": "biased", "world × 1000": "within"}


def test_shapes_without_lengths_among_their_parameters_are_named() -> None:
    grid = {"type": "sdfgrid", "grid": SPHERE, "bsdf": diffuse(0.5)}
    camera = SCENES["an orthographic camera"]["camera"] | {"film": film()}
    scene = psdr.load_dict({"type": "scene", "camera": camera, "blob": grid, **lights("constant")})
    with pytest.raises(NotScaled, match=r"'blob\.grid' belongs to a shape without triangles"):
        precision.scaling(scene, 10.0)
