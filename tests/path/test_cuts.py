"""All ways to draw a path: their weights, each computed where the path is cut, add up to one."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.path.test_light_tracing import (
    ENVIRONMENT,
    GLASS,
    POINT,
    PROJECTOR,
    ROUGH,
    SPOT,
    SUN,
    ball,
    camera_of,
    lamp,
    room,
)
from warp_psdr import workers
from warp_psdr.estimate.jobs import PixelSamples
from warp_psdr.estimate.light import bounding_sphere
from warp_psdr.estimate.passes import launch_pass
from warp_psdr.kernels.bidirectional_path import CameraWalk, make_camera_cuts
from warp_psdr.kernels.bidirectional_weights import Cuts, make_hit_weight
from warp_psdr.kernels.connection import make_connect, make_subpaths
from warp_psdr.kernels.constants import FAR, LOBE_SMOOTH
from warp_psdr.kernels.emitter.area import pdf_area
from warp_psdr.kernels.emitter.dispatch import is_delta_light, make_lights
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.jobs import PixelJob, pixel_of
from warp_psdr.kernels.light_path import LightVertex
from warp_psdr.kernels.light_ray import LightRay
from warp_psdr.kernels.reading import emitter_at, triangle_at
from warp_psdr.kernels.scattering import ScatterSample
from warp_psdr.kernels.sensor.projection import make_projection
from warp_psdr.kernels.structs import Camera, LightSample, Scene
from warp_psdr.kernels.surface import point_on
from warp_psdr.kernels.vertex import PathVertex

#: Rounding of float32, and rays that start a little off their surfaces: of nearly all paths, and where two vertices are
#: close to each other.
CLOSE, CLOSE_TOGETHER = 1e-4, 1e-2
DEPTH = 5


@functools.cache
def make_all_weights(config):
    """Return the kernel: the last join of each light path, cut at every place; the weights' sum, and how many."""
    light_path, _connections = make_subpaths(config, True)
    interaction = make_interaction(config.surfaces, config.lights)
    cuts_behind, walk_on, share_of_lights = make_camera_cuts(config)
    hit_weight = make_hit_weight(config.lights, config.through)
    connect = make_connect(config, True)
    project = make_projection(config.camera)[0]
    sky_pdf = make_lights(config.lights.others, None, ()).environment_pdf
    most = config.most_vertices
    inner = config.connections == "all"

    @wp.func
    def sample_of(scene: Scene, ray: LightRay, x: wp.vec3) -> LightSample:
        """What next-event estimation at x draws."""
        light = emitter_at(scene, ray.emitter)
        ls = LightSample()
        ls.wi = -ray.d
        ls.pdf = 1.0
        ls.probability = light.probability
        ls.face = ray.face
        ls.distance = FAR
        if ray.from_point == 1:
            ls.distance = wp.length(ray.position - x)
        if ray.face >= 0:
            ls.distance = wp.length(point_on(triangle_at(scene, ray.face), ray.u, ray.v) - x)
            ls.pdf = pdf_area(scene, light, ray.face, -ray.d, ls.distance)
        elif is_delta_light(light.kind):
            ls.delta = 1
        else:
            ls.pdf = sky_pdf(scene, -ray.d)
        return ls

    @wp.kernel(module="unique", enable_backward=False)
    def all_weights(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        job: PixelJob,
        sphere: wp.vec4,
        # Out:
        sums_out: wp.array2d(dtype=wp.vec4),
    ):
        pixel = pixel_of(job, camera, wp.tid())
        lights = wp.zeros(shape=(wp.static(most),), dtype=LightVertex)
        light_cuts = wp.zeros(shape=(wp.static(most),), dtype=Cuts)
        ray, count = light_path(scene, camera, job, sphere, pixel.number, 0, lights, light_cuts)
        first = count - 1
        while first >= 0 and lights[wp.max(first, 0)].joined == 0:
            first -= 1
        if first < 0:
            return
        x1 = point_on(triangle_at(scene, lights[first].face), lights[first].u, lights[first].v)
        film = project(scene, camera, x1, wp.vec2(0.0, 0.0))
        walk = CameraWalk()
        walk.path.o = film.origin
        walk.path.d = wp.normalize(x1 - film.origin)
        walk.path.eta = 1.0
        at = interaction.at(scene, lights[first].face, lights[first].u, lights[first].v, walk.path.d)
        last = lights[first]
        whole = wp.abs(wp.dot(at.ng, walk.path.d)) * film.per_area / wp.abs(wp.dot(at.ng, last.d))
        total = last.join / whole
        cuts_counted = wp.float32(1.0)
        lobe = wp.int32(LOBE_SMOOTH)
        i = first
        while i >= 0:
            here = lights[i]
            at = interaction.at(scene, here.face, here.u, here.v, walk.path.d)
            cuts = cuts_behind(scene, camera, walk, at)
            if wp.static(inner):
                if i > 0 and lobe == LOBE_SMOOTH and lights[wp.max(i - 1, 0)].lobe == LOBE_SMOOTH:
                    vertex = PathVertex()
                    vertex.face = here.face
                    vertex.u = here.u
                    vertex.v = here.v
                    vertex.d = walk.path.d
                    other = lights[i - 1]
                    joint = connect(scene, vertex, cuts, other, light_cuts[i - 1])
                    z = point_on(triangle_at(scene, other.face), other.u, other.v)
                    there = interaction.at(scene, other.face, other.u, other.v, joint.w)
                    g = wp.abs(wp.dot(there.ng, joint.w)) / wp.abs(wp.dot(there.ng, other.d)) / wp.length_sq(z - at.x)
                    if joint.joined == 1:
                        total += joint.factor / g
                        cuts_counted += 1.0
                    else:
                        total = wp.NAN  # hidden by rounding
            if i == 0 and lobe == LOBE_SMOOTH:
                total += share_of_lights(scene, at, cuts, sample_of(scene, ray, at.x), ray.emitter, 1.0)
                cuts_counted += 1.0
            scattered = ScatterSample()
            scattered.wo = -here.d
            scattered.lobe = lobe
            scattered.after.eta = walk.path.eta
            scattered.after.depth = walk.path.depth + 1
            scattered.after.o = at.x
            scattered.after.d = -here.d
            if lobe == LOBE_SMOOTH:
                scattered.after.pdf = interaction.pdf(at, enter_frame(at.frame, -here.d))
            walk = walk_on(at, walk, cuts, scattered)
            if i > 0:
                lobe = lights[i - 1].lobe
            else:
                ls = sample_of(scene, ray, at.x)
                if ls.delta == 0:
                    total += hit_weight(scene, walk.path, ray.face, ls.distance, walk.far)
                    cuts_counted += 1.0
            i -= 1
        sums_out[pixel.py, pixel.px] = wp.vec4(total, cuts_counted, wp.float32(first), wp.float32(ray.emitter))

    return all_weights


LIT = {
    "lamp": lamp(),
    "point": POINT,
    "spot": SPOT,
    "sun": SUN,
    "sky": ENVIRONMENT,
    "projector": PROJECTOR,
    "beam": {**lamp("directionalarea"), "to_world": psdr.Transform.translate([0.0, 0.0, -0.2]) @ lamp()["to_world"]},
}


@pytest.mark.slow
@pytest.mark.parametrize("connections", ["light", "all"])
def test_the_weights_of_all_cuts_of_a_path_add_up_to_one(connections):
    """Under all lights, with glass, rough glass and metal in the way."""
    balls = {"matte": ball([-0.5, -0.3, 0.6], **GLASS), "rough": ball([0.6, -0.6, 0.5], **ROUGH)}
    scene = psdr.load_dict(room(camera_of("box", size=64), **balls, **LIT))
    method = psdr.interior.Bidirectional(connections="all")
    config = psdr.plan(scene, integrator=psdr.PathIntegrator(max_depth=DEPTH, interior=method)).config
    config = replace(config, connections=connections)
    camera = scene.camera(0)
    sums = wp.zeros((64, 64), dtype=wp.vec4)
    samples = PixelSamples(1, 7, DEPTH, 100)
    sphere = bounding_sphere(scene)
    kernel = make_all_weights(config)
    launch_pass(
        scene, kernel, (64, 64), samples, camera, lambda _shard: [sphere, sums], shards=workers.SHARDS, kind="light"
    )
    total, ways, surfaces, light = np.moveaxis(sums.numpy(), -1, 0)
    kept = np.isfinite(total) & (ways > 0)
    assert kept.sum() > 500 and (~np.isfinite(total)).sum() < 0.02 * kept.sum()
    assert (
        len(np.unique(light[kept])) == len(LIT)
        and surfaces[kept].max() >= 2
        and ways[kept].max() >= (4 if connections == "all" else 3)
    )
    off = np.abs(total[kept] - 1.0)
    assert np.quantile(off, 0.99) < CLOSE and off.max() < CLOSE_TOGETHER, np.sort(off)[-20:]
