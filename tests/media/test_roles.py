"""Parameters of media in every role: tapes, PyTorch, fits, accuracy, the viewer."""

import json

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.gradients.measure import shared_random_numbers
from tests.media.scenes import T, camera, cube, grid, grids, medium, point, puffs, rgb, sky, square, whole
from warp_psdr import image_io
from warp_psdr.view.volume_fields import volume_field

VOXELS, ALBEDO = "cube.interior_medium.sigma_t.data", "cube.interior_medium.albedo.value.value"
OPTIONS = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": 4, "seed": 3}
#: Rounding of float32 sums over the pixels, relative to the largest entry.
ROUNDING = 1e-5


@pytest.fixture
def scene():
    smoke = grids(grid(puffs(4) + 0.1), (0.9, 0.8, 0.7), scale=2.0)
    return psdr.load_dict(whole(sensor=camera([4, 1, 1], [0, 0, 0], 40.0, 6), cube=cube(smoke), sky=sky(1.0, 0.8, 0.6)))


@pytest.fixture
def expected(scene):
    """Image, its adjoint, and what ``render_backward`` makes of it."""
    image = psdr.render(scene, **OPTIONS).numpy()
    params = psdr.traverse(scene)
    params.requires_grad(VOXELS, ALBEDO)
    psdr.render_backward(scene, params, 2.0 * image, **OPTIONS)
    found = {name: params[name].grad.numpy().copy() for name in (VOXELS, ALBEDO)}
    assert all(np.abs(values).max() > 0.0 for values in found.values())
    return image, found


def assert_same(found, expected):
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, rtol=0.0, atol=ROUNDING * np.abs(values).max())


@pytest.mark.slow
def test_derivatives_trace_the_paths_of_the_image():
    """Images are linear in lights: with equal numbers the derivative along their radiance is the image, pixel by pixel.

    Paths end in empty voxels and behind interfaces alike; the primal role drops what is zero, the other one does not.
    """
    smoke = grids(grid(puffs(4)), (0.9, 0.8, 0.7), g=0.4, scale=3.0)
    parts = {
        "sensor": camera([4, 1, 1], [0, 0, 0], 40.0, 6),
        "cube": cube(smoke),
        "fog": cube(medium((0.5, 0.2, 1.0), 0.8), scale=0.6, translate=(0, 1.8, 0)),
        "floor": square(-1.1, 3.0, {"type": "diffuse", "reflectance": rgb(0.6, 0.0, 0.3)}),
        "sky": sky(1.0, 0.8, 0.6),
        "bulb": point([2.0, -1.5, 2.5], (6.0, 7.0, 8.0)),
    }
    scene = psdr.load_dict(whole(**parts))
    params = psdr.traverse(scene)
    lights = {name: params[name].numpy() for name in ("sky.radiance.value", "bulb.intensity.value")}
    options = {"integrator": psdr.PathIntegrator(max_depth=6, rr_depth=100), "spp": 16, "seed": 5}
    with shared_random_numbers():
        image = psdr.render(scene, **options).numpy()
        derivative = psdr.render_forward(scene, params, lights, **options).numpy()
    assert (image.max(axis=2) > 0.0).all()
    np.testing.assert_allclose(derivative, image, rtol=2e-4, atol=0.0)


@wp.kernel
def sum_of_squares(image: wp.array2d(dtype=wp.vec3), loss: wp.array(dtype=wp.float32)):
    i, j = wp.tid()
    wp.atomic_add(loss, 0, wp.dot(image[i, j], image[i, j]))


@pytest.mark.slow
def test_a_tape(scene, expected):
    params = psdr.traverse(scene)
    params.requires_grad(VOXELS, ALBEDO)
    loss, tape = wp.zeros(1, dtype=wp.float32, requires_grad=True), wp.Tape()
    with tape:
        image = psdr.render(scene, params, tape=tape, **OPTIONS)
        wp.launch(sum_of_squares, dim=image.shape, inputs=[image], outputs=[loss])
    tape.backward(loss)
    np.testing.assert_array_equal(image.numpy(), expected[0])
    assert_same({name: params[name].grad.numpy() for name in expected[1]}, expected[1])


@pytest.mark.slow
def test_torch(scene, expected):
    torch = pytest.importorskip("torch")
    params = psdr.traverse(scene)
    tensors = {name: torch.tensor(params[name].numpy(), requires_grad=True) for name in expected[1]}
    image = psdr.torch.render(scene, tensors, **OPTIONS)
    (image * image).sum().backward()
    assert_same({name: tensor.grad.numpy() for name, tensor in tensors.items()}, expected[1])


SCENE = """<scene version="3.0.0"><integrator type="volpath"><integer name="max_depth" value="3"/></integrator>
<sensor type="perspective"><float name="fov" value="40"/>
<transform name="to_world"><lookat origin="4, 1, 1" target="0, 0, 0" up="0, 0, 1"/></transform>
<film type="hdrfilm"><integer name="width" value="6"/><integer name="height" value="6"/><rfilter type="box"/></film>
</sensor><emitter type="constant" id="sky"><rgb name="radiance" value="1, 0.8, 0.6"/></emitter>
<shape type="cube" id="cube"><bsdf type="null"/><medium type="homogeneous" name="interior">
<float name="sigma_t" value="1.5"/><float name="albedo" value="0.4"/></medium></shape></scene>"""
FIT = """scene = "scene.xml"
targets = ["target.exr"]
output = "out"
iterations = 12
spp = 16
final_spp = 16
[parameters."cube.interior_medium.sigma_t.value.value"]
lr = 0.2
initial = 0.0
"""


@pytest.mark.slow
def test_a_fit_starts_at_a_density_of_zero(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "fit.toml").write_text(FIT)
    target = psdr.render(psdr.load_file(tmp_path / "scene.xml"), spp=256, seed=9).numpy()
    image_io.write_image(tmp_path / "target.exr", target)
    psdr.fit.fit(psdr.fit.FitConfig.from_file(tmp_path / "fit.toml"))
    found = np.load(next((tmp_path / "out" / "parameters").glob("*.npy")))
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary and abs(found.item() - 1.5) < 0.4


@pytest.mark.slow
def test_accuracy_has_a_line_of_densities(scene):
    params = psdr.traverse(scene)
    params.requires_grad(VOXELS, ALBEDO)
    options = {"integrator": OPTIONS["integrator"], "seconds": 0.2, "spp": 2}
    report = psdr.accuracy(scene, params, np.ones((6, 6, 3), np.float32), **options)
    assert [term.name for term in report.terms] == ["interior", "interior density"]
    by_albedo, by_density = report.terms
    assert by_albedo.variance[VOXELS] == 0.0 < by_albedo.variance[ALBEDO]
    assert by_density.variance[ALBEDO] == 0.0 < by_density.variance[VOXELS]
    params.requires_grad_only(VOXELS)
    assert "interior density" in str(psdr.accuracy(scene, params, np.ones((6, 6, 3), np.float32), **options))


def test_the_viewer_draws_sums_of_voxels(scene):
    volume = scene.description.shapes[0].interior.sigma_t
    values = np.arange(2 * 3 * 4, dtype=np.float64).reshape(2, 3, 4, 1)
    field = volume_field(volume, values, T.scale(2.0).matrix)
    assert field.vertices.min() == 0.0 and field.vertices.max() == 2.0
    assert len(field.faces) == len(field.values) == 2 * (2 * 3 + 2 * 4 + 3 * 4)
    assert field.values.sum() == pytest.approx(6.0 * values.sum())
    # The last faces are those across z; the value at the corner of the smallest x and y is the sum along z.
    across_z = field.values[-24:].reshape(3, 4, 2)
    np.testing.assert_allclose(across_z, np.repeat(values.sum(axis=0), 2, axis=2))
    middle = field.vertices[field.faces[-24:]].mean(axis=1).reshape(3, 4, 2, 3)
    assert (np.diff(middle[..., 0], axis=1) > 0).all() and (np.diff(middle[..., 1], axis=0) > 0).all()
