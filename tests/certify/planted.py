"""``python -m tests.certify.planted NAME``: a certificate of a gradient pass whose kernels have a defect.

Images are rendered first, so that their kernels are built without it. A process of its own, for kernels stay as they
were built. The last line is the certificate's ``ok``.
"""

import sys

import warp as wp

import warp_psdr as psdr
from tests.boundary.scenes import load
from warp_psdr.kernels import scattering
from warp_psdr.kernels.bsdf import diffuse
from warp_psdr.kernels.emitter import area
from warp_psdr.kernels.structs import Emitter, Scene, Triangle

ALBEDO, BUDGET, DEPTH = "floor.bsdf.reflectance.value", 60.0, 3


@wp.func
def half_weight(a: wp.float32, b: wp.float32) -> wp.float32:
    """Weights of a pair that add up to more than one."""
    return a / wp.max(a + 0.5 * b, 1.0e-30)


@wp.func
def density_without_area(scene: Scene, e: Emitter, face: wp.int32, tri: Triangle) -> wp.float32:
    """Density of a light's points as if its triangles were as large as one another, and the light 1."""
    return 1.0 / wp.float32(e.face_count)


def plant(name: str) -> None:
    """Change what kernels that are built from now on are made of."""
    if name == "bsdf":
        diffuse.INV_PI = wp.constant(0.95 * diffuse.INV_PI)
    elif name == "weight":
        scattering.mis_weight = half_weight
    elif name == "light":
        area.density_on = density_without_area
    elif name != "none":
        raise SystemExit(f"no defect {name!r}")


def main(name: str) -> None:
    """Issue a certificate, and print it."""
    scene, params = load("soft")
    params.requires_grad_only(ALBEDO)
    integrator = psdr.PathIntegrator(max_depth=DEPTH)
    psdr.render(scene, integrator=integrator, spp=1)
    plant(name)
    certificate = psdr.certify(scene, params, integrator=integrator, budget=BUDGET, checks="slope")
    print(certificate)
    print(certificate.ok)


if __name__ == "__main__":
    main(sys.argv[1])
