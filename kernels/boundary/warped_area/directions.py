"""The rays from a path vertex whose motion counts, and the adjoint that each asks of its motion.

Derivation: ``docs/theory/reparameterisation.md``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.warped_area.auxiliary import AuxiliaryBundle
from warp_psdr.kernels.constants import EMITTER_AREA, LOBE_SMOOTH
from warp_psdr.kernels.emitter.dispatch import make_lights
from warp_psdr.kernels.interaction import enter_frame, leave_frame, make_interaction
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.sinks import make_light_sink
from warp_psdr.kernels.invalid import vanishes
from warp_psdr.kernels.scattering import samples_lights
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import PathConfig, PathVertex


@wp.struct
class MovingDirection:
    """A ray of a vertex: the adjoint of ``value . div V + a_w . V`` is asked for."""

    moves: wp.int32  # 0: nothing is
    bundle: AuxiliaryBundle
    value: wp.float32
    a_w: wp.vec3


@functools.cache
def make_direction_from(config: PathConfig, wanted: GradientRequest, role: str):
    """Return ``direction_from(scene, target, technique, n, a_n, vertex, at, radiance, a_d) -> MovingDirection``.

    ``technique`` 0: to the light that was sampled; 1: the one along which the path goes on from vertex ``n``, where
    ``radiance`` is what it finds and ``a_d`` the adjoint of its direction behind ``n``.
    """
    interaction = make_interaction(config.surfaces, config.lights)
    record = interaction.record
    has_lights = config.scatter and samples_lights(config.lights, config.surfaces.bsdfs)
    radiance_of = make_light_sink(config.surfaces, config.lights, wanted, role)[0] if has_lights else None
    lights = make_lights(config.lights.others, role, ()) if config.lights.others else None
    environment_vjp = lights.environment_vjp if lights else None

    @wp.func
    def direction_from(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        technique: wp.int32,
        n: wp.int32,
        a_n: wp.vec3,
        vertex: PathVertex,
        at: record,
        radiance: wp.vec3,
        a_d: wp.vec3,
    ) -> MovingDirection:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        r = MovingDirection()
        w = vertex.wo
        scale = vertex.inv_pdf * a_n
        light = radiance
        a_w = a_d
        moves = vertex.lobe == LOBE_SMOOTH and not (vanishes(light) and vanishes(a_d))
        if technique == 0:
            moves = wp.bool(False)
            if wp.static(has_lights):
                moves = vertex.light >= 0
                if moves:
                    w = vertex.light_wi
                    scale = vertex.light_weight * a_n
                    light = radiance_of(scene, vertex, at.x)
                    a_w = wp.vec3(0.0, 0.0, 0.0)
        if moves:
            r.moves = 1
            wo = enter_frame(at.frame, w)
            f = interaction.eval(at, wo)
            if wp.static(has_lights and environment_vjp is not None):
                if technique == 0 and scene.emitters[vertex.light].kind != EMITTER_AREA:
                    a_w = environment_vjp(scene, target, w, wp.cw_mul(scale, f)).x
            of_light = wp.cw_mul(scale, light)
            r.value = wp.dot(of_light, f)
            r.a_w = a_w + leave_frame(at.frame, interaction.eval_vjp(at, wo, of_light).wo)
            r.bundle.o = at.x
            r.bundle.start = interaction.offset(at, w)
            r.bundle.n = at.ng
            r.bundle.w = w
            r.bundle.depth = n + 1
        return r

    return direction_from
