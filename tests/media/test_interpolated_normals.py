"""What moves in fog and has interpolated normals: terminators, horizons and creases, against differences and vacuum."""

import numpy as np
import pytest
import trimesh

import warp_psdr as psdr
from tests.gradients.configs import aim, shift, widen
from tests.media.scenes import BLACK, T, camera, cube, lamp, medium, rgb, square, whole
from tests.media.test_boundary import COLOURS, Z, derivatives, difference
from warp_psdr.estimate.boundary import terms

SIZE, BATCHES = 8, 6
RAMP = np.linspace(-1.0, 1.0, SIZE)
#: Weights of the pixels.
ADJOINT = (COLOURS * (1.0 + 0.3 * RAMP[:, None, None] + 0.5 * RAMP[None, :, None])).astype(np.float32)
#: Terms of interpolated normals.
BENT = {"creases", "terminator", "indirect_terminator", "geometric_horizon", "media_horizon"}
MOTIONS = {"ball.to_world": shift(0.3, 1.0, -0.5), "sensor.to_world": shift(-0.1, 0.8, 0.3)}


def ball(center):
    """A coarse ball, whose normals bend much."""
    m = trimesh.creation.icosphere(subdivisions=1)
    paint = {"type": "diffuse", "reflectance": rgb(0.8, 0.6, 0.4)}
    vertices = np.float32(0.45 * m.vertices + center)
    return {"type": "mesh", "vertices": vertices, "faces": np.int32(m.faces), "bsdf": paint, "face_normals": False}


def fog(**more):
    """A ball above a floor in a cube of fog, below a lamp."""
    return psdr.load_dict(
        whole(
            sensor=camera([3.2, 0.6, 0.7], [0, 0, 0], 32.0, SIZE),
            fog=cube({**medium((0.8, 0.6, 1.0), (0.9, 0.8, 0.7), g=0.3), **more}, translate=(0, 0, 0.31), turn=15.0),
            floor=square(-0.7, 1.6, {"type": "diffuse", "reflectance": rgb(0.6, 0.5, 0.3)}),
            ball=ball((0.1, 0.05, 0.1)),
            lamp=lamp(1.6, 0.5),
        )
    )


def slopes(scene, motions, depth, boundary, spp):
    """Return the derivatives of the weighted image along motions of parameters, (batches, motions)."""
    params = psdr.traverse(scene)
    names = list(dict.fromkeys(name for name, _motion in motions))
    tangents = [(names.index(name), motion(params[name].numpy())) for name, motion in motions]
    found = derivatives(scene, names, ADJOINT, boundary, spp=spp, depth=depth, batches=BATCHES)
    return np.array([[(batch[i] * tangent).sum() for i, tangent in tangents] for batch in found])


@pytest.mark.filterwarnings("ignore:samples that were not finite")  # rays through the cube's own edges
@pytest.mark.slow
def test_derivatives_in_fog_equal_finite_differences(monkeypatch):
    """What the camera sees, and light that is scattered once; without the terms they are wrong."""
    scene = fog()
    params = psdr.traverse(scene)
    found = slopes(scene, list(MOTIONS.items()), 2, "auto", 8192)
    launches = terms.launches
    monkeypatch.setattr(terms, "launches", lambda term, r: [] if term.name in BENT else launches(term, r))
    without = slopes(scene, list(MOTIONS.items()), 2, "auto", 8192)
    for column, (name, motion) in enumerate(MOTIONS.items()):
        tangent = motion(params[name].numpy())
        images = [difference(scene, name, tangent, 2, 32768, seed, 0.01) for seed in range(1, 1 + BATCHES)]
        expected = np.array([(ADJOINT * image).sum() for image in images])
        spread = np.hypot(found[:, column].std(ddof=1), expected.std(ddof=1)) / np.sqrt(BATCHES)
        assert abs(found[:, column].mean() - expected.mean()) < Z * spread
        assert abs(without[:, column].mean() - expected.mean()) > 2.0 * Z * spread, "the terms do not show"


def aside(density):
    """A ball beside what the camera sees, a wall that it lights; in vacuum, or in fog."""
    lit = T.translate([1.0, -0.3, 0]) @ T.rotate([0, 1, 0], -35.0) @ T.rotate([1, 0, 0], -90.0) @ T.scale(0.38)
    paint = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": rgb(0.7, 0.7, 0.7)}}
    shines = {"type": "area", "radiance": rgb(20.0, 20.0, 20.0)}
    pose = T.look_at([-0.3, 1.2, 0.9], [0, 0, 0], [0, 0, 1]) @ T.scale(0.3)
    parts = {
        "sensor": camera([1.0, 3.0, 0.1], [1.0, 0, 0.1], 15.0, SIZE),
        "ball": ball((0.0, 0.0, 0.0)),
        "wall": {"type": "rectangle", "to_world": lit, "bsdf": paint},
        "lamp": {"type": "rectangle", "to_world": pose, "bsdf": BLACK, "emitter": shines},
    }
    if density:
        parts["fog"] = cube(medium(density, 0.9), scale=1.5)
    return psdr.load_dict(whole(**parts))


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", [{"indirect_terminator"}, {"geometric_horizon", "media_horizon"}], ids=["turned", "horizon"]
)
def test_in_thin_fog_terms_are_those_of_vacuum(kind, monkeypatch):
    """Each by itself: what is left after the interior term of equal samples."""
    launches, kept = terms.launches, set(kind)
    monkeypatch.setattr(terms, "launches", lambda term, r: launches(term, r) if term.name in kept else [])
    method = psdr.boundary.PathSpace(spp_secondary=131072, guiding=None)
    name = "ball.to_world"
    motions = [(name, MOTIONS[name]), (name, widen), (name, aim(0, 0, 1))]
    found = []
    for density in (0.0, 1e-4):
        scene, parts = aside(density), []
        for names in (kind, set()):
            kept.clear()
            kept.update(names)
            parts.append(slopes(scene, motions, 3, method, 16))
        found.append(parts[0] - parts[1])
    vacuum, thin = (f.mean(axis=0) for f in found)
    spread = np.hypot(*(f.std(axis=0, ddof=1) for f in found)) / np.sqrt(BATCHES)
    assert (np.abs(thin - vacuum) < Z * spread).all(), (vacuum, thin, spread)
    assert (np.abs(vacuum) > 2.0 * Z * spread).any(), "too noisy to tell"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:samples that were not finite")
def test_nothing_changes_where_all_moves_together():
    """Sample by sample, whatever vertices in the fog ride on."""
    scene = fog()
    names = ["ball.to_world", "floor.to_world", "lamp.to_world", "sensor.to_world", "fog.to_world"]
    motion = shift(0.3, -0.5, 0.8)
    grads = derivatives(scene, names, np.ones((SIZE, SIZE, 3), np.float32), spp=16, depth=3, batches=1)[0]
    parts = [(g * motion(g)).sum() for g in grads]
    assert min(map(abs, parts)) > 0.0
    assert abs(sum(parts)) < 2e-4 * max(map(abs, parts)), parts


def test_only_beside_fog_that_shines_they_are_refused():
    psdr.plan(fog(), names=["ball.to_world"], integrator=psdr.PathIntegrator(max_depth=2))
    scene = fog(emission={"type": "constvolume", "value": rgb(0.1, 0.1, 0.1)})
    with pytest.raises(ValueError, match="'ball' has; give face_normals"):
        psdr.plan(scene, names=["ball.to_world"], integrator=psdr.PathIntegrator(max_depth=2))
