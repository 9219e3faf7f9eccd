"""Primary boundary at creases between flat faces: one path estimates both sides of the jump.

The camera sees both flat faces of the edge. Light arrives from the same directions on both sides, so one path estimates
L_A - L_B = integral ( f_A(w) - f_B(w) ) L(w) dsigma(w). The variance falls with the square of the angle between the
faces.

Derivation: ``docs/theory/boundary.md#creases-between-flat-faces``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.concave_edge import facing
from warp_psdr.kernels.boundary.detector import make_following
from warp_psdr.kernels.boundary.film_edge import AHEAD, BESIDE, MARGIN, make_film_edge
from warp_psdr.kernels.boundary.local_form import Edges, barycentrics_at, narrowest_face, on_planes, own_face
from warp_psdr.kernels.boundary.path_space.primary import make_primary_kernel
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.interaction import enter_frame, leave_frame, make_interaction
from warp_psdr.kernels.invalid import inverse_pdf, vanishes
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.primitive.affine import triangle_or_none
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.sampling import mis_weight
from warp_psdr.kernels.scattering import make_light_sampler, shadow_ray
from warp_psdr.kernels.step import leaving_step
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, path_from
from warp_psdr.kernels.visibility import visibility_of

#: Sample slots: the light, the direction. The path's vertices, the first of which is behind one, take those behind.
SLOT_LIGHT, SLOT_DIRECTION = 1, 2


@wp.struct
class Crease:
    """The two faces of a crease at a point of it, with normals towards the camera, and how rays leave it."""

    x_a: wp.vec3  # in front of the face alone
    x_b: wp.vec3
    x: wp.vec3  # in front of both
    n_a: wp.vec3
    n_b: wp.vec3


@wp.struct
class Difference:
    """f_A - f_B for a direction, its density (p_A + p_B) / 2, and where a ray along it starts."""

    value: wp.vec3
    pdf: wp.float32
    o: wp.vec3


@functools.cache
def make_flat_creases_kernel(config: PathConfig, role: str, camera_moves: bool):
    """Return the kernel: one thread a sample (arguments as in ``secondary.py``).

    Before a transient film, where the light of either face has lengths of its own, and where shadow rays pass surfaces,
    it is that of all other edges.
    """
    if config.pulse or config.points_pass:
        return make_primary_kernel(config, role, camera_moves)
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    interaction = make_interaction(config.surfaces, config.lights)
    record = interaction.record
    lit = bool(config.lights.area or config.lights.others)
    sample_light = make_light_sampler(config.lights) if lit else None
    following = make_following(config)
    find, accumulate, _accumulate_side = make_film_edge(config, role, camera_moves)
    sample_4d = make_sampler(config.sampler).sample_4d

    @wp.func
    def scattered(at: record, w: wp.vec3) -> tuple[wp.vec3, wp.float32]:
        wo = enter_frame(at.frame, w)
        return interaction.eval(at, wo), interaction.pdf(at, wo)

    @wp.func
    def difference(a: record, b: record, c: Crease, w: wp.vec3) -> Difference:
        r = Difference()
        above_a = wp.dot(c.n_a, w) > 0.0
        above_b = wp.dot(c.n_b, w) > 0.0
        r.o = c.x
        if above_a:
            value, pdf = scattered(a, w)
            r.value += value
            r.pdf += 0.5 * pdf
            if not above_b:
                r.o = c.x_a
        if above_b:
            value_b, pdf_b = scattered(b, w)
            r.value -= value_b
            r.pdf += 0.5 * pdf_b
            if not above_a:
                r.o = c.x_b
        return r

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def flat_creases(
        # Scene:
        scene: Scene,
        camera: Camera,
        edges: Edges,
        # In:
        job: SampleJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        number = job.first + wp.tid()
        sampler = sampler_at(number, 0, job.seed)
        f = find(scene, camera, edges, number, job.samples, sampler, job.image_adjoint)
        if f.valid == 0:
            return
        apart = BESIDE * f.step
        _width, slant = narrowest_face(scene, edges, f.point, f.m, f.d)
        ahead = wp.min(wp.max(AHEAD * f.step, MARGIN * apart / slant), f.distance - f.at.near)
        for i in range(2):
            o = f.point.x + (apart - 2.0 * apart * wp.float32(i)) * f.m - ahead * f.d
            hit = visibility.seen(scene, o, f.d, 2.0 * ahead, 0)
            seen = o + hit.t * f.d
            met = hit.face
            if wp.static(len(config.surfaces.primitives) > 0):
                met = triangle_or_none(scene, met)
            if not (
                own_face(scene, edges, f.point.edge, met) or on_planes(scene, edges, f.point, hit.face, seen, f.step)
            ):
                return
        # A lies on the side that m points away from.
        k = edges.first[f.point.edge]
        face_a = edges.faces[k]
        face_b = edges.faces[k + 1]
        tri_a = scene.triangles[face_a]
        if wp.dot(f.m, (tri_a.p0 - f.point.x) + (tri_a.p1 - f.point.x) + (tri_a.p2 - f.point.x)) > 0.0:
            face_a = edges.faces[k + 1]
            face_b = edges.faces[k]
            tri_a = scene.triangles[face_a]
        tri_b = scene.triangles[face_b]
        uv_a = barycentrics_at(tri_a, f.point.x)
        uv_b = barycentrics_at(tri_b, f.point.x)
        c = Crease()
        a = interaction.at(scene, face_a, uv_a[0], uv_a[1], f.d)
        b = interaction.at(scene, face_b, uv_b[0], uv_b[1], f.d)
        c.n_a = facing(a.ng, f.d)
        c.n_b = facing(b.ng, f.d)
        away = wp.max(leaving_step(scene, face_a), leaving_step(scene, face_b))
        c.x_a = f.point.x - apart * f.m + away * c.n_a
        c.x_b = f.point.x + apart * f.m + away * c.n_b
        middle = wp.normalize(c.n_a + c.n_b)
        c.x = f.point.x + (away / wp.dot(middle, c.n_a)) * middle
        sampler.index = wp.uint32(1)
        jump = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(lit):
            ls, _index, probability = sample_light(scene, f.point.x, sample_4d(sampler, SLOT_LIGHT))
            if not (ls.pdf <= 0.0):
                to_light = difference(a, b, c, ls.wi)
                if not vanishes(to_light.value):
                    pdf_light = ls.pdf * probability
                    weight = inverse_pdf(pdf_light)
                    if ls.delta == 0:
                        weight *= mis_weight(pdf_light, to_light.pdf)
                    r, t_max = shadow_ray(to_light.o, ls)
                    if not visibility.occluded(scene, to_light.o, r, t_max):
                        jump += weight * wp.cw_mul(to_light.value, ls.radiance)
        r4 = sample_4d(sampler, SLOT_DIRECTION)
        own = a
        if r4[1] >= 0.5:
            own = b
        bs = interaction.sample(own, r4[0], wp.vec2(r4[2], r4[3]))
        if not (bs.pdf <= 0.0):
            w = leave_frame(own.frame, bs.wo)
            along = difference(a, b, c, w)
            if not (along.pdf <= 0.0) and not vanishes(along.value):
                state = path_from(along.o, w, FAR, 1)
                state.pdf = along.pdf
                radiance_behind = following(scene, sampler, state, job.max_depth, job.rr_depth, False)
                jump += inverse_pdf(along.pdf) * wp.cw_mul(along.value, radiance_behind.radiance)
        accumulate(scene, camera, edges, sampler, job.samples, f, jump, target, image_out)

    return flat_creases
