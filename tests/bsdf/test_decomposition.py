"""The lobes of a microfacet distribution's derivative: their masses, signs, and that samples have their density."""

import functools

import numpy as np
import pytest
import scipy.stats
import warp as wp

from warp_psdr.kernels.bsdf.abc import BY_B, BY_C, abc_lobe_draw
from warp_psdr.kernels.bsdf.decomposition import ACROSS, ALONG, BOTH, MOST, make_decomposition, quartic
from warp_psdr.kernels.bsdf.dispatch import make_bsdf, models_of
from warp_psdr.scene.materials.tables import MAKERS

#: Largest statistic of a chi-square test that right samples exceed once in 10^4 tries.
CHANCE = 1e-4
SAMPLES = 200_000
#: Cells of slopes, bent to angles so that all have some.
CELLS = 24
#: Points of a quadrature in each, a side.
POINTS = 24

CASES = [
    (distribution, axis, outer)
    for distribution in ("ggx", "beckmann")
    for axis in (ALONG, ACROSS, BOTH)
    for outer in (0, 1)
]


@functools.cache
def make_drawing(distribution: str):
    lobes = make_decomposition(distribution)

    @wp.kernel(module="unique", enable_backward=False)
    def drawing(
        axis: wp.int32,
        outer: wp.int32,
        u: wp.array(dtype=wp.vec3),
        at: wp.array(dtype=wp.vec2),
        slopes_out: wp.array(dtype=wp.vec2),
        rate_out: wp.array(dtype=wp.float32),
        mass_out: wp.array(dtype=wp.float32),
    ):
        i = wp.tid()
        slopes_out[i] = lobes.draw(axis, outer == 1, u[i])
        rate_out[i] = lobes.rate(at[i][0], at[i][1], axis)
        mass_out[i] = lobes.mass(axis)

    return drawing


def drawn(distribution, axis, outer, u, at):
    """Return slopes drawn with the numbers ``u``, the rates at ``at``, and the mass of a lobe."""
    outputs = [wp.zeros(len(u), dtype=t, device="cpu") for t in (wp.vec2, wp.float32, wp.float32)]
    inputs = [axis, outer, wp.array(u, dtype=wp.vec3, device="cpu"), wp.array(at, dtype=wp.vec2, device="cpu")]
    wp.launch(make_drawing(distribution), dim=len(u), inputs=inputs + outputs, device="cpu")
    return tuple(x.numpy().astype(np.float64) for x in outputs)


def density(distribution, x, y):
    """P(X, Y) of slopes over the roughness."""
    s = x * x + y * y
    return 1.0 / (np.pi * (1.0 + s) ** 2) if distribution == "ggx" else np.exp(-s) / np.pi


def rate(distribution, x, y, axis):
    """Return d log P / d log alpha, by differences of P(X / a, Y / b) / (a b)."""
    h = 1e-4
    along, across = axis in (ALONG, BOTH), axis in (ACROSS, BOTH)

    def log(e):
        a, b = 1.0 + e * along, 1.0 + e * across
        return np.log(density(distribution, x / a, y / b) / (a * b))

    return (log(h) - log(-h)) / (2.0 * h)


@pytest.mark.parametrize(("distribution", "axis", "outer"), CASES)
def test_samples_have_the_density_of_a_lobe(distribution, axis, outer):
    random = np.random.default_rng(17)
    u = random.uniform(size=(SAMPLES, 3)).astype(np.float32)
    slopes, _rates, mass = drawn(distribution, axis, outer, u, u[:, :2])
    edges = np.linspace(-0.5 * np.pi, 0.5 * np.pi, CELLS + 1)
    counts = np.histogram2d(*np.arctan(slopes.T), bins=(edges, edges))[0]
    assert counts.sum() == SAMPLES
    # dX = (1 + X^2) d(atan X), midpoints.
    step = (edges[1] - edges[0]) / POINTS
    t = -0.5 * np.pi + step * (np.arange(CELLS * POINTS) + 0.5)
    x, y = np.meshgrid(np.tan(t), np.tan(t), indexing="ij")
    p = density(distribution, x, y)
    derivative = p * np.where(p > 1e-300, rate(distribution, x, y, axis), 0.0) if distribution == "ggx" else None
    if derivative is None:
        s = {ALONG: x * x, ACROSS: y * y, BOTH: x * x + y * y}[axis]
        derivative = p * (2.0 * s - (2.0 if axis == BOTH else 1.0))
    lobe = np.maximum(derivative if outer else -derivative, 0.0) * (1.0 + x * x) * (1.0 + y * y) * step * step
    expected = lobe.reshape(CELLS, POINTS, CELLS, POINTS).sum((1, 3))
    assert abs(expected.sum() / mass[0] - 1.0) < 2e-3
    expected *= SAMPLES / expected.sum()
    full = expected > 20.0
    statistic = ((counts - expected)[full] ** 2 / expected[full]).sum()
    assert scipy.stats.chi2.sf(statistic, full.sum() - 1) > CHANCE, statistic / full.sum()


@pytest.mark.parametrize("distribution", ["ggx", "beckmann"])
@pytest.mark.parametrize("axis", [ALONG, ACROSS, BOTH])
def test_rates_are_derivatives_and_lobes_have_one_sign(distribution, axis):
    at = np.random.default_rng(3).normal(size=(2000, 2)).astype(np.float32)
    u = np.random.default_rng(4).uniform(size=(2000, 3)).astype(np.float32)
    u[0, 0], u[1, 0], u[2, 1], u[3, 1] = 0.0, 1.0 - 2.0**-24, 0.0, 1.0 - 2.0**-24
    for outer in (0, 1):
        slopes, rates, _mass = drawn(distribution, axis, outer, u, at)
        np.testing.assert_allclose(rates, rate(distribution, *at.T.astype(np.float64), axis), rtol=1e-3, atol=1e-3)
        assert np.isfinite(slopes).all()
        sign = drawn(distribution, axis, outer, u, slopes.astype(np.float32))[1]
        assert ((sign > -1e-3) if outer else (sign < 1e-3)).all()


#: Exponents of Ashikhmin and Shirley's model, along and across, and what moves.
PHONG = [(5.0, 5.0, BOTH), (60.0, 60.0, BOTH), (8.0, 40.0, ALONG), (8.0, 40.0, ACROSS)]
#: Cells of a hemisphere: cosines, angles around.
RINGS, SECTORS = 16, 16


@functools.cache
def make_phong_drawing():
    bsdf = make_bsdf(("ashikhminshirley",))
    record, split = bsdf.record, bsdf.split

    @wp.kernel(module="unique", enable_backward=False)
    def phong_drawing(
        axis: wp.int32,
        outer: wp.int32,
        exponents: wp.vec2,
        wi: wp.vec3,
        u: wp.array(dtype=wp.vec3),
        at: wp.array(dtype=wp.vec3),
        drawn_out: wp.array(dtype=wp.vec3),
        density_out: wp.array(dtype=wp.float32),
        rate_out: wp.array(dtype=wp.float32),
        mass_out: wp.array(dtype=wp.float32),
    ):
        i = wp.tid()
        mat = record()
        mat.nu = exponents[0]
        mat.nv = exponents[1]
        drawn_out[i] = split.draw(0, mat, wi, axis, outer == 1, u[i])
        density_out[i] = split.density(0, mat, wi, at[i])
        rate_out[i] = split.rate(0, mat, wi, at[i], axis)
        mass_out[i] = split.mass(0, mat, axis)

    return phong_drawing


@pytest.mark.parametrize("outer", [0, 1])
@pytest.mark.parametrize(("nu", "nv", "axis"), PHONG)
def test_lobes_of_exponents_have_their_density(nu, nv, axis, outer):
    """Directions of a lobe, seen from straight above: none points below, and the half vector is found from each."""
    count = RINGS * SECTORS * POINTS * POINTS
    random = np.random.default_rng(23)
    u = random.uniform(size=(max(SAMPLES, count), 3)).astype(np.float32)
    # Midpoints: cosines of the half vector are squared, so that there are many where the lobe is.
    z = ((np.arange(RINGS * POINTS) + 0.5) / (RINGS * POINTS)) ** 0.25
    angle = 2.0 * np.pi * (np.arange(SECTORS * POINTS) + 0.5) / (SECTORS * POINTS)
    cosine, phi = np.meshgrid(z, angle, indexing="ij")
    sine = np.sqrt(1.0 - cosine**2)
    h = np.stack((sine * np.cos(phi), sine * np.sin(phi), cosine), -1).reshape(-1, 3)
    wi = np.array([0.0, 0.0, 1.0])
    wo = 2.0 * h[:, 2:] * h - wi
    at = np.tile(wi.astype(np.float32), (len(u), 1))
    at[:count] = wo
    outputs = [wp.zeros(len(u), dtype=t, device="cpu") for t in (wp.vec3, wp.float32, wp.float32, wp.float32)]
    inputs = [axis, outer, wp.vec2(nu, nv), wp.vec3(0.0, 0.0, 1.0), wp.array(u, dtype=wp.vec3, device="cpu")]
    inputs.append(wp.array(at, dtype=wp.vec3, device="cpu"))
    wp.launch(make_phong_drawing(), dim=len(u), inputs=inputs + outputs, device="cpu")
    drawn, density, rates, mass = (x.numpy().astype(np.float64) for x in outputs)
    # The rate is that of D in the exponents, by differences of its closed form.
    du, dv = float(axis in (ALONG, BOTH)), float(axis in (ACROSS, BOTH))

    def log(step):
        a, b = nu + step * du, nv + step * dv
        power = a * np.cos(phi) ** 2 + b * np.sin(phi) ** 2
        return 0.5 * np.log((a + 1.0) * (b + 1.0)) + power * np.log(cosine)

    expected_rate = ((log(1e-3) - log(-1e-3)) / 2e-3).reshape(-1)
    above = wo[:, 2] > 1e-3
    np.testing.assert_allclose(rates[:count][above], expected_rate[above], rtol=2e-3, atol=1e-4)
    # What one sign of the rate has of the density of normals, in the measure of half vectors: of directions over 4 cos.
    normals = density[:count].reshape(cosine.shape) * 4.0 * cosine
    signed = np.maximum(rates[:count] * (-1.0 if outer else 1.0), 0.0).reshape(cosine.shape)
    # dz = 4 z^3 of even steps in the fourth power.
    cell = 2.0 * np.pi / (SECTORS * POINTS) / (RINGS * POINTS) / (4.0 * cosine**3)
    lobe = np.where(above.reshape(cosine.shape), normals * signed * cell, 0.0)
    expected = lobe.reshape(RINGS, POINTS, SECTORS, POINTS).sum((1, 3))
    halves = drawn[drawn[:, 2] > 1e-3] + wi
    halves /= np.linalg.norm(halves, axis=1)[:, None]
    edges = (np.linspace(0.0, 1.0, RINGS + 1), np.linspace(0.0, 2.0 * np.pi, SECTORS + 1))
    around = np.arctan2(halves[:, 1], halves[:, 0]) % (2.0 * np.pi)
    counts = np.histogram2d(halves[:, 2] ** 4, around, bins=edges)[0]
    assert abs(expected.sum() / -mass[0] / (counts.sum() / len(u)) - 1.0) < 5e-3
    expected *= counts.sum() / expected.sum()
    full = expected > 20.0
    statistic = ((counts - expected)[full] ** 2 / expected[full]).sum()
    assert scipy.stats.chi2.sf(statistic, full.sum() - 1) > CHANCE, statistic / full.sum()


#: Model, values, by which of them, angle of ``wi`` from the normal.
SIGNED = [
    ("abc", {"A": 2.0, "B": 60.0, "C": 1.3}, "A", 0.6),
    ("abc", {"A": 2.0, "B": 60.0, "C": 1.3}, "B", 0.6),
    ("abc", {"A": 2.0, "B": 60.0, "C": 1.3}, "C", 0.6),
    ("abc", {"A": 1.0, "B": 1e-3, "C": 30.0}, "B", 0.3),
    ("abc", {"A": 1.0, "B": 4.0, "C": 8.0}, "C", 1.2),
    ("orennayar", {"sigma": 0.4}, "sigma", 0.5),
    ("orennayar", {"sigma": 1.2}, "sigma", 1.4),
    ("roughplastic (ggx)", {"alpha": 0.4, "ior": 1.5}, "ior", 0.6),
    ("roughplastic (beckmann nonlinear)", {"alpha": 0.3, "ior": 1.3}, "ior", 1.2),
]


@functools.cache
def make_signed_drawing(plugin: str, name: str):
    bsdf = make_bsdf((plugin,))
    record, signed, eval_vjp = bsdf.record, bsdf.signed, bsdf.eval_vjp
    place = models_of((plugin,))[0].signed.index(name)

    @wp.kernel(module="unique", enable_backward=False)
    def signed_drawing(
        values: wp.vec3,
        table: wp.uint64,
        wi: wp.vec3,
        u: wp.array(dtype=wp.vec2),
        at: wp.array(dtype=wp.vec3),
        drawn_out: wp.array2d(dtype=wp.vec3),
        weight_out: wp.array2d(dtype=wp.float32),
        derivative_out: wp.array(dtype=wp.float32),
    ):
        i = wp.tid()
        mat = record()
        if wp.static(plugin == "abc"):
            mat.A = values[0]
            mat.B = values[1]
            mat.C = values[2]
            mat.specular_reflectance = wp.vec3(1.0, 1.0, 1.0)
            mat.eta = wp.vec3(0.2, 0.9, 1.1)
            mat.k = wp.vec3(4.0, 2.0, 2.0)
        elif wp.static(name == "ior"):
            mat.alpha = values[0]
            mat.ior = values[1]
            mat.transmittance = table
            mat.specular_reflectance = wp.vec3(0.9, 0.9, 0.9)
            mat.diffuse_reflectance = wp.vec3(0.7, 0.7, 0.7)
        else:
            mat.sigma = values[0]
            mat.reflectance = wp.vec3(0.7, 0.7, 0.7)
        for second in range(2):
            drawn_out[i, second] = signed.draw(0, mat, wi, place, second == 1, u[i])
            weight_out[i, second] = signed.weight(0, mat, wi, at[i], place, second == 1)[0]
        a = eval_vjp(0, mat, wi, at[i], wp.vec3(1.0, 0.0, 0.0)).material
        if wp.static(name == "A"):
            derivative_out[i] = a.A
        if wp.static(name == "B"):
            derivative_out[i] = a.B
        if wp.static(name == "C"):
            derivative_out[i] = a.C
        if wp.static(name == "sigma"):
            derivative_out[i] = a.sigma
        if wp.static(name == "ior"):
            derivative_out[i] = a.ior

    return signed_drawing


@pytest.mark.slow_rows("abc-values1-B-0.6", "abc-values3-B-0.3", "abc-values4-C-1.2")
@pytest.mark.parametrize(("plugin", "values", "name", "angle"), SIGNED)
def test_lobes_of_one_sign_have_their_density(plugin, values, name, angle):
    """What is drawn has the model's own derivative over the weights as its density, cell by cell and in all."""
    count = RINGS * SECTORS * POINTS * POINTS
    u = np.random.default_rng(29).uniform(size=(max(SAMPLES, count), 2)).astype(np.float32)
    # Midpoints of the angle from the normal and of that around.
    polar = 0.5 * np.pi * (np.arange(RINGS * POINTS) + 0.5) / (RINGS * POINTS)
    around = 2.0 * np.pi * (np.arange(SECTORS * POINTS) + 0.5) / (SECTORS * POINTS)
    theta, phi = np.meshgrid(polar, around, indexing="ij")
    wo = np.stack((np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)), -1).reshape(-1, 3)
    wi = np.array([np.sin(angle) * np.cos(0.7), np.sin(angle) * np.sin(0.7), np.cos(angle)])
    at = np.tile(wi.astype(np.float32), (len(u), 1))
    at[:count] = wo
    numbers = wp.vec3(*[*values.values(), 0.0, 0.0][:3])
    tables = [
        wp.array(MAKERS[t.maker](t.variant, *(values[of] for of in t.of)), dtype=wp.float32, device="cpu")
        for t in models_of((plugin,))[0].tables(plugin.partition("(")[2].rstrip(")"))
    ]
    inputs = [
        numbers,
        wp.uint64(tables[0].ptr if tables else 0),
        wp.vec3(*wi),
        wp.array(u, dtype=wp.vec2, device="cpu"),
        wp.array(at, dtype=wp.vec3, device="cpu"),
    ]
    shapes = ((len(u), 2), wp.vec3), ((len(u), 2), wp.float32), (len(u), wp.float32)
    outputs = [wp.zeros(shape, dtype=dtype, device="cpu") for shape, dtype in shapes]
    wp.launch(make_signed_drawing(plugin, name), dim=len(u), inputs=inputs + outputs, device="cpu")
    drawn, weights, derivative = (x.numpy().astype(np.float64) for x in outputs)
    solid_angle = (np.sin(theta) * (polar[1] - polar[0]) * (around[1] - around[0])).reshape(-1)
    weights, derivative = weights[:count], derivative[:count]
    if plugin == "abc":
        # The halves together have the one lobe, which has one sign.
        assert (derivative * np.sign(values[name]) * (1.0 if name == "A" else -1.0) >= 0.0).all()
        densities = [derivative / weights.sum(1)]
        found = [drawn.reshape(-1, 3)]
    elif name == "ior":
        # The coat reflects more, and lets less pass to the base. Far from its middle its density underflows.
        cosine = np.cos(theta).reshape(-1) / np.pi
        near = weights[:, 0] > 0.0
        densities = [
            np.divide(derivative - weights[:, 1] * cosine, weights[:, 0], out=0.0 * cosine, where=near),
            cosine,
        ]
        found = [drawn[:, 0], drawn[:, 1]]
        assert (weights[:, 0] >= 0.0).all() and near.mean() > 0.5 and (weights[:, 1] < 0.0).all()
    else:
        cosine = np.cos(theta).reshape(-1) / np.pi
        densities = [cosine, (derivative - weights[:, 0] * cosine) / weights[:, 1]]
        found = [drawn[:, 0], drawn[:, 1]]
        assert (weights[:, 0] < 0.0).all() and (weights[:, 1] > 0.0).all()
    for density, directions in zip(densities, found, strict=True):
        expected = (density * solid_angle).reshape(RINGS, POINTS, SECTORS, POINTS).sum((1, 3))
        directions = directions[directions[:, 2] > 0.0]
        angles = (
            np.arccos(np.minimum(directions[:, 2], 1.0)),
            np.arctan2(directions[:, 1], directions[:, 0]) % (2 * np.pi),
        )
        edges = np.linspace(0.0, 0.5 * np.pi, RINGS + 1), np.linspace(0.0, 2.0 * np.pi, SECTORS + 1)
        counts = np.histogram2d(*angles, bins=edges)[0]
        drawn_in_all = len(u) * len(drawn[0]) / len(densities)
        assert abs(expected.sum() / (counts.sum() / drawn_in_all) - 1.0) < 5e-3
        expected *= counts.sum() / expected.sum()
        full = expected > 20.0
        statistic = ((counts - expected)[full] ** 2 / expected[full]).sum()
        assert scipy.stats.chi2.sf(statistic, full.sum() - 1) > CHANCE, statistic / full.sum()


#: Largest error of a number of the unit interval that an inversion in float32 leaves.
INVERTED = 2e-4


@wp.kernel(module="unique", enable_backward=False)
def inverting(
    b: wp.float32, c: wp.float32, u: wp.array(dtype=wp.float32), x_out: wp.array2d(dtype=wp.float32)
):  # fmt: skip
    i = wp.tid()
    x_out[i, 0] = abc_lobe_draw(BY_B, b, c, u[i])
    x_out[i, 1] = abc_lobe_draw(BY_C, b, c, u[i])
    x_out[i, 2] = quartic(MOST * u[i], False)
    x_out[i, 3] = quartic(MOST * (1.0 - u[i]), True)


@pytest.mark.parametrize(("b", "c"), [(1e-3, 0.2), (60.0, 1.3), (1e6, 0.2), (1e6, 1.0), (1e6, 100.0)])
def test_inversions_hit_every_number(b, c):
    """Not in the mean of many alone: lobes of a few degrees and of a whole hemisphere, both ends."""
    u = ((np.arange(1 << 14) + 0.5) / (1 << 14)).astype(np.float32)
    out = wp.zeros((len(u), 4), dtype=wp.float32, device="cpu")
    wp.launch(inverting, dim=len(u), inputs=[b, c, wp.array(u, device="cpu"), out], device="cpu")
    x = out.numpy().astype(np.float64)
    # Trapezoids in t = log(1 + B x) / log(1 + B).
    size = np.log1p(b)
    t = np.linspace(0.0, 1.0, 1 << 20)
    for k, density in enumerate((np.expm1(size * t) * np.exp(-c * size * t), t * np.exp((1.0 - c) * size * t))):
        share = np.concatenate(([0.0], np.cumsum(density[1:] + density[:-1])))
        assert np.abs(np.interp(np.log1p(b * x[:, k]) / size, t, share / share[-1]) - u).max() < INVERTED
    for k, share in ((2, u), (3, 1.0 - u)):
        assert np.abs(x[:, k] / (1.0 + x[:, k] ** 2) ** 2 / MOST - share).max() < INVERTED
