"""Where rays that are next to touching a shape without triangles touch it: on the ray, and across it."""

import functools

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.networks import fitted, sphere
from warp_psdr.kernels.boundary.specular.chain_outlines import begins_beside, make_chain_outline, make_one_sheet
from warp_psdr.kernels.boundary.specular.chain_patches import make_patch
from warp_psdr.kernels.boundary.specular.chain_touch import JUMPS, ChainOutline
from warp_psdr.kernels.boundary.specular.specular_chain import Link
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.primitive.network import clear_of_network
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of

from .scenes import T, camera, sky
from .test_sdfgrid import values
from .test_sdfgrid_cubic import neck
from .test_tubes import tube

COUNT = 512
SHIFT = T.translate([-0.5, -0.5, -0.5])
SHAPES = {
    "sphere": {"type": "sphere", "exact": True, "to_world": T.rotate([0, 1, 1], 35.0).scale([0.5, 0.3, 0.4])},
    "disk": {"type": "disk", "exact": True, "to_world": T.rotate([1, 1, 0], 50.0).scale(0.4)},
    "cylinder": {"type": "cylinder", "exact": True, "to_world": T.rotate([1, 0.4, 0], 25.0).scale([0.3, 0.4, 0.6])},
    "grid": {"type": "sdfgrid", "grid": values(), "normals": "analytic", "to_world": SHIFT},
    "cubic": {"type": "sdfgrid", "grid": neck(), "interpolation": "cubic", "to_world": SHIFT},
    "network": {**fitted(sphere, (24, 24)).plugin(), "to_world": SHIFT},
    "tube": {"type": "bsplinecurve", "control_points": tube("helix"), "to_world": T.translate([0, 0, -0.8])},
    "cones": {"type": "linearcurve", "control_points": tube("helix"), "to_world": T.translate([0, 0, -0.8])},
}
#: Distance of the touched point from the ray: roundings of hits, and a tube's circle is that of the hit.
ON_THE_RAY = {"tube": 2e-3, "cones": 2e-3}


def rays_past(count: int, distance: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where rays start, (count, 3), at a distance from the middle, and points inside of the shape and beside it."""
    around = np.random.default_rng(3).normal(size=(3, count, 3))
    o = distance * around[0] / np.linalg.norm(around[0], axis=1, keepdims=True)
    side = np.cross(o, around[2])
    return o, 0.1 * around[1], 1.8 * side / np.linalg.norm(side, axis=1, keepdims=True)


@functools.cache
def outline_kernel(config: PathConfig):
    outline_at = make_chain_outline(config.surfaces.primitives)
    visibility = visibility_of(config.rays, config.surfaces.primitives)

    @wp.kernel(module="unique", enable_backward=False)
    def outlines(
        # In:
        scene: Scene,
        face: wp.int32,
        origins: wp.array(dtype=wp.vec3),
        inner: wp.array(dtype=wp.vec3),
        outer: wp.array(dtype=wp.vec3),
        # Out:
        valid_out: wp.array(dtype=wp.int32),
        x_out: wp.array(dtype=wp.vec3),
        m_out: wp.array(dtype=wp.vec3),
        d_out: wp.array(dtype=wp.vec3),
    ):
        i = wp.tid()
        o = origins[i]
        a = inner[i]
        b = outer[i]
        link = Link()
        met = wp.int32(0)
        for _k in range(24):
            d = wp.normalize(0.5 * (a + b) - o)
            hit = visibility.closest(scene, o, d, FAR)
            if hit.face == face:
                met = 1
                a = 0.5 * (a + b)
                link.face = hit.face
                link.x = o + hit.t * d
                link.u = hit.u
                link.v = hit.v
                d_out[i] = d
            else:
                b = 0.5 * (a + b)
        if met == 1:
            r = outline_at(scene, face, link, link, True, o, False)
            valid_out[i] = wp.where(r.valid == 1, 1, -1)
            x_out[i] = r.x
            m_out[i] = wp.normalize(r.m)

    return outlines


@pytest.mark.slow_rows("grid", "tube")
@pytest.mark.parametrize(
    "kind", [pytest.param(k, marks=[] if k in ("sphere", "grid", "tube") else pytest.mark.slow) for k in SHAPES]
)
def test_outlines_lie_on_the_rays_that_touch_them(kind: str) -> None:
    scene = psdr.load_dict({"type": "scene", "sensor": camera(), "sky": sky(), "shape": SHAPES[kind]})
    kernel = outline_kernel(psdr.plan(scene, integrator=psdr.PathIntegrator(max_depth=2)).config)
    rays = rays_past(COUNT, 4.0)
    o = np.float32(rays[0])
    arrays = [wp.array(np.float32(v), dtype=wp.vec3, device="cpu") for v in rays]
    out = [wp.zeros(COUNT, dtype=t, device="cpu") for t in (wp.int32, wp.vec3, wp.vec3, wp.vec3)]
    wp.launch(kernel, COUNT, [scene.data(), scene.face_count, *arrays], out, device="cpu")
    valid, x, m, d = (v.numpy() for v in out)
    met = valid != 0
    assert met.sum() > COUNT // 4
    assert (valid[met] == 1).mean() > 0.98
    good = valid == 1
    beside = np.linalg.norm(np.cross(x[good] - o[good], d[good]), axis=1)
    assert np.quantile(beside, 0.98) < ON_THE_RAY.get(kind, 1e-4)
    assert np.quantile(np.abs((m[good] * d[good]).sum(axis=1)), 0.98) < 2e-3


@functools.cache
def grazing_kernel(config: PathConfig):
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    interaction = make_interaction(config.surfaces, config.lights)

    @wp.kernel(module="unique", enable_backward=False)
    def grazing(
        # In:
        scene: Scene,
        face: wp.int32,
        origins: wp.array(dtype=wp.vec3),
        inner: wp.array(dtype=wp.vec3),
        outer: wp.array(dtype=wp.vec3),
        steps: wp.float32,
        # Out:
        met_out: wp.array(dtype=wp.int32),
        cosine_out: wp.array(dtype=wp.float32),
    ):
        i = wp.tid()
        o = origins[i]
        a = inner[i]
        b = outer[i]
        met = wp.int32(0)
        for _k in range(24):
            middle = 0.5 * (a + b)
            if visibility.closest(scene, o, wp.normalize(middle - o), FAR).face == face:
                met = 1
                a = middle
            else:
                b = middle
        inwards = wp.normalize(inner[i] - outer[i])
        d = wp.normalize(a + steps * clear_of_network(scene, scene.triangles[face]) * inwards - o)
        hit = visibility.closest(scene, o, d, FAR)
        if met == 1 and hit.face == face:
            met_out[i] = 1
            cosine_out[i] = -wp.dot(interaction.at(scene, face, hit.u, hit.v, d).ng, d)

    return grazing


@pytest.mark.slow
def test_hits_aside_of_the_outline_of_a_network_face_the_ray() -> None:
    """At it some lie behind the touched point, by roundings of phi: as far aside as its sign is told none does."""
    scene = psdr.load_dict({"type": "scene", "sensor": camera(), "sky": sky(), "shape": SHAPES["network"]})
    kernel = grazing_kernel(psdr.plan(scene, integrator=psdr.PathIntegrator(max_depth=2)).config)
    arrays = [wp.array(np.float32(v), dtype=wp.vec3, device="cpu") for v in rays_past(4096, 2.1)]
    behind = []
    for steps in (0.0, 1.0):
        out = [wp.zeros(4096, dtype=t, device="cpu") for t in (wp.int32, wp.float32)]
        wp.launch(kernel, 4096, [scene.data(), scene.face_count, *arrays, steps], out, device="cpu")
        met, cosine = (v.numpy() for v in out)
        assert met.sum() > 1024
        behind.append((cosine[met == 1] <= 0.0).mean())
    assert behind[0] > 0.1
    assert behind[1] == 0.0


@functools.cache
def crease_kernel(config: PathConfig):
    outline_at = make_chain_outline(config.surfaces.primitives)
    one_sheet = make_one_sheet(config.surfaces.primitives)
    patch = make_patch(config.surfaces.primitives)
    visibility = visibility_of(config.rays, config.surfaces.primitives)

    @wp.func
    def met(scene: Scene, o: wp.vec3, at: wp.vec3) -> Link:
        d = wp.normalize(at - o)
        hit = visibility.closest(scene, o, d, FAR)
        r = Link()
        r.face = hit.face
        r.x = o + hit.t * d
        r.u = hit.u
        r.v = hit.v
        return r

    @wp.kernel(module="unique", enable_backward=False)
    def creases(
        # In:
        scene: Scene,
        face: wp.int32,
        origins: wp.array(dtype=wp.vec3),
        first: wp.array(dtype=wp.vec3),
        last: wp.array(dtype=wp.vec3),
        # Out:
        valid_out: wp.array(dtype=wp.int32),
        x_out: wp.array(dtype=wp.vec3),
        hit_out: wp.array(dtype=wp.vec3),
    ):
        i = wp.tid()
        o = origins[i]
        a = first[i]
        b = last[i]
        low = met(scene, o, a)
        high = met(scene, o, b)
        if low.face != face or high.face != face:
            return
        for _k in range(20):
            middle = met(scene, o, 0.5 * (a + b))
            if middle.face == face:
                if patch(scene, face, middle.u, middle.v, 1) == patch(scene, face, low.u, low.v, 1):
                    a = 0.5 * (a + b)
                    low = middle
                else:
                    b = 0.5 * (a + b)
                    high = middle
        if one_sheet(scene, low, high) == JUMPS:
            r = outline_at(scene, face, low, high, True, o, True)
            valid_out[i] = wp.where(r.valid == 1, 1, -1)
            x_out[i] = r.x
            hit_out[i] = low.x

    return creases


@pytest.mark.slow
def test_creases_lie_between_the_voxels_of_two_hits() -> None:
    """Also where both hits are as close to the face as roundings of their positions."""
    scene = psdr.load_dict({"type": "scene", "sensor": camera(), "sky": sky(), "shape": SHAPES["grid"]})
    kernel = crease_kernel(psdr.plan(scene, integrator=psdr.PathIntegrator(max_depth=2)).config)
    random = np.random.default_rng(4)
    around = random.normal(size=(3, COUNT, 3))
    o = 4.0 * around[0] / np.linalg.norm(around[0], axis=1, keepdims=True)
    first = 0.05 * around[1]
    arrays = [wp.array(np.float32(v), dtype=wp.vec3, device="cpu") for v in (o, first, first + 0.05 * around[2])]
    out = [wp.zeros(COUNT, dtype=t, device="cpu") for t in (wp.int32, wp.vec3, wp.vec3)]
    wp.launch(kernel, COUNT, [scene.data(), scene.face_count, *arrays], out, device="cpu")
    valid, x, hit = (v.numpy() for v in out)
    good = valid == 1
    assert good.sum() > COUNT // 3
    assert good.sum() > 0.99 * (valid != 0).sum()
    assert np.quantile(np.linalg.norm(x[good] - hit[good], axis=1), 0.98) < 1e-5
    places = 16.0 * (x[good] + 0.5)
    assert np.quantile(np.abs(places - np.round(places)).min(axis=1), 0.98) < 1e-4


@wp.kernel(module="unique", enable_backward=False)
def beside(
    # In:
    scene: Scene,
    outline: ChainOutline,
    face: wp.int32,
    t1: wp.float32,
    # Out:
    rim_out: wp.array(dtype=wp.bool),
):
    rim_out[0] = begins_beside(scene, outline, face, t1)
    outline.rim = 1
    outline.curvature = 0.0
    rim_out[1] = begins_beside(scene, outline, face, t1)


def test_rims_count_from_all_surfaces() -> None:
    """Only silhouettes are left out next to what their shape runs through: rims and creases have no such curves."""
    disk = SHAPES["disk"]
    scene = psdr.load_dict({"type": "scene", "sensor": camera(), "sky": sky(), "one": disk, "other": disk})
    outline = ChainOutline()
    outline.face = scene.face_count
    outline.curvature = 1.0
    for t1, left_out in ((1e-4, True), (1.0, False)):
        out = wp.zeros(2, dtype=wp.bool, device="cpu")
        wp.launch(beside, 1, [scene.data(), outline, scene.face_count + 1, t1], [out], device="cpu")
        assert out.numpy().tolist() == [left_out, False]
