"""Points of curves that segments touch: closed forms of curvature and area, and the two densities of one measure."""

import numpy as np
import warp as wp

import warp_psdr as psdr
from warp_psdr.kernels.boundary.silhouette.tube_points import TubeItems, choose_tube, tube_curvature, tube_seen
from warp_psdr.kernels.boundary.silhouette.tube_roots import QUARTIC, quartic_roots
from warp_psdr.kernels.boundary.silhouette.tube_sampling import own_touch, own_touch_density, seen_touch_density
from warp_psdr.kernels.structs import Scene
from warp_psdr.scene.kinds.bsplinecurve import coefficients
from warp_psdr.topology.kinds.tube_items import curve_shapes, tube_items

from .etendue import assert_shares_agree, bin_of

COUNT = 200_000


@wp.kernel(module="unique", enable_backward=False)
def measure(
    scene: Scene,
    found: TubeItems,
    u: wp.array2d(dtype=wp.float32),
    ways: wp.array(dtype=wp.vec3),
    out: wp.array2d(dtype=wp.float32),
):
    """One over the density of a point and a direction, drawn by itself and towards light; of open ends."""
    i = wp.tid()
    n, along, chance = choose_tube(found, wp.float64(u[i, 0]))
    item = found.items[n]
    tri = scene.triangles[item[0]]
    own = own_touch(scene, tri, item[0], item[1], along, wp.vec3(u[i, 1], u[i, 2], u[i, 3]))
    if own.point.valid == 1 and own.point.rim == 0:
        bend = tube_curvature(own.point, own.w)
        share = 1.0 / (chance * own_touch_density(own.point, own.w, bend))
        out[i, 0] = share
        out[i, 1] = wp.abs(share)
        out[i, 4] = wp.float32(bin_of(own.point.x, own.w))
    if own.point.valid == 1 and own.point.rim == 1:
        out[i, 6] = 1.0 / (chance * own_touch_density(own.point, own.w, 0.0))
        out[i, 7] = wp.float32(bin_of(own.point.e, own.w))
    w = ways[i]
    seen = tube_seen(scene, tri, item[0], item[1], w, True, along, u[i, 1])
    if seen.valid == 1 and seen.rim == 0:
        out[i, 2] = wp.abs(wp.dot(seen.out, w))
        out[i, 3] = 12.566370614 / (chance * seen_touch_density(seen, w, True, w))
        out[i, 5] = wp.float32(bin_of(seen.x, w))


def measured(plugin: str, points: np.ndarray) -> np.ndarray:
    """Return what ``measure`` writes, (COUNT, 8)."""
    scene = psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective"},
            "sky": {"type": "constant"},
            "body": {"type": plugin, "control_points": points},
        }
    )
    rng = np.random.default_rng(0)
    ways = rng.standard_normal((COUNT, 3))
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    out = wp.zeros((COUNT, 8), dtype=wp.float32, device=scene.device)
    found = tube_items(scene, curve_shapes(scene), creases=False)
    inputs = [wp.array(rng.random((COUNT, 4)), dtype=wp.float32), wp.array(ways, dtype=wp.vec3)]
    wp.launch(measure, dim=COUNT, inputs=[scene.data(), found, *inputs], outputs=[out], device=scene.device)
    return out.numpy().astype(np.float64)


def mean_and_error(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return values.mean(axis=0), values.std(axis=0) / np.sqrt(COUNT)


def test_all_lines_that_touch_a_cone_with_its_spheres() -> None:
    """The integral of kappa_n dA dtheta is pi dS/dr, S the surface, as for every convex body [Cauchy]."""
    r0, r1, length = 0.5, 0.2, 0.9
    # S = pi (r0 + r1) sqrt(l^2 - (r0 - r1)^2) + 2 pi r0^2 (1 + k) + 2 pi r1^2 (1 - k), k = (r0 - r1) / l, between the
    # circles of touch: radii r0 s and r1 s, slant l s, s^2 = 1 - k^2.
    k = (r0 - r1) / length
    by_radius = 2.0 * np.pi * length * (1.0 - k * k) + 4.0 * np.pi * (r0 * (1.0 + k) + r1 * (1.0 - k))
    values = measured("linearcurve", np.array([[0.1, 0.0, 0.0, r0], [0.1 + length, 0.0, 0.0, r1]]))
    means, errors = mean_and_error(values)
    for place in (0, 3):
        assert abs(means[place] - np.pi * by_radius) < 4.0 * errors[place] + 1e-4 * means[place]
    assert_shares_agree([(values[:, 1], values[:, 4]), (values[:, 3], values[:, 5])])


def test_all_lines_that_touch_a_bent_tube() -> None:
    """A radius that grows sweeps the normals: the integral of the mean curvature is dS/dr, 2 pi times the length."""
    rng = np.random.default_rng(2)
    k = np.linspace(0.0, 1.0, 8)
    points = np.column_stack([2.4 * k - 1.2, 0.4 * np.cos(7.0 * k), 0.4 * np.sin(7.0 * k), 0.0 * k + 0.16])
    a = coefficients(points, np.arange(5))
    v = np.linspace(0.0, 1.0, 2001)[:, None, None]
    axis = (a[0] + v * (a[1] + v * (a[2] + v * a[3])))[..., :3]
    length = np.linalg.norm(np.diff(axis, axis=0), axis=2).sum()
    values = measured("bsplinecurve", points)
    means, errors = mean_and_error(values)
    assert abs(means[0] - 2.0 * np.pi**2 * length) < 4.0 * errors[0] + 1e-4 * means[0]
    # Where the surface curves towards the line, what is drawn towards a light counts by its size.
    assert abs(means[3] - means[1]) < 4.0 * np.hypot(errors[1], errors[3])
    assert means[2] < 1e-4
    assert_shares_agree([(values[:, 1], values[:, 4]), (values[:, 3], values[:, 5])])
    # Open ends are circles across the axis: |dx/du x w| du dsigma, by points that are uniform along them.
    ends = np.stack([a[1, 0], a[1, 4] + 2.0 * a[2, 4] + 3.0 * a[3, 4]])[rng.integers(0, 2, COUNT), :3]
    e = np.cross(ends, rng.standard_normal((COUNT, 3)))
    e /= np.linalg.norm(e, axis=1)[:, None]
    w = rng.standard_normal((COUNT, 3))
    w /= np.linalg.norm(w, axis=1)[:, None]
    tangent = np.cross(ends / np.linalg.norm(ends, axis=1)[:, None], e)
    shares = 2.0 * (2.0 * np.pi * 0.16) * 4.0 * np.pi * np.linalg.norm(np.cross(tangent, w), axis=1)
    axis = np.abs(w).argmax(axis=1)
    bins = 6 * ((e > 0.0) @ [1, 2, 4]) + 2 * axis + (w[np.arange(COUNT), axis] > 0.0)
    assert_shares_agree([(values[:, 6], values[:, 7]), (shares, bins)])


@wp.kernel(module="unique", enable_backward=False)
def solve(p: wp.array2d(dtype=wp.float32), out: wp.array(dtype=wp.vec4)):
    i = wp.tid()
    out[i] = quartic_roots(QUARTIC(p[i, 0], p[i, 1], p[i, 2], p[i, 3], p[i, 4]))


def test_no_root_is_passed() -> None:
    rng = np.random.default_rng(1)
    p = rng.standard_normal((4000, 5)).astype(np.float32)
    p[::7, 4] = 0.0
    out = wp.zeros(len(p), dtype=wp.vec4, device="cpu")
    wp.launch(solve, dim=len(p), inputs=[wp.array(p, dtype=wp.float32, device="cpu")], outputs=[out], device="cpu")
    counted = np.zeros(5, int)
    for row, found in zip(p, out.numpy(), strict=True):
        roots = np.polynomial.polynomial.polyroots(np.trim_zeros(row.astype(np.float64), "b"))
        real = np.sort(roots[np.abs(roots.imag) < 1e-9].real)
        real = real[np.abs(real) < 1.0]
        near = np.diff(np.concatenate([[-1.0], real, [1.0]])).min() < 1e-3  # pairs, and roots at the ends
        if not near:
            got = np.sort(found[found != 2.0])
            assert len(got) == len(real)
            np.testing.assert_allclose(got, real, atol=2e-5)
            counted[len(real)] += 1
    assert (counted[:4] > 20).all()
