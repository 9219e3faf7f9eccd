"""Kernels of the scattering functions, which the tests launch over arrays."""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.dispatch import BsdfFunctions, make_bsdf
from warp_psdr.kernels.structs import BsdfSample, Scattered


@functools.cache
def functions_of(models: tuple[str, ...]) -> BsdfFunctions:
    """``make_bsdf(models)``, kept here: kernels and arrays need the same structs even if its own cache is emptied."""
    return make_bsdf(models)


@functools.cache
def make_kernels(models: tuple[str, ...]) -> dict[str, wp.Kernel]:
    """One kernel a function of ``make_bsdf(models)``, all over one material, so that a test may ask for any of them."""
    f = functions_of(models)
    record, adjoint = f.record, f.adjoint
    kernels = {}

    @wp.kernel(module="unique", enable_backward=False)
    def sample_kernel(
        model: wp.int32,
        mat: record,
        wi: wp.array(dtype=wp.vec3),
        uvw: wp.array(dtype=wp.vec3),
        out: wp.array(dtype=BsdfSample),
    ):
        i = wp.tid()
        out[i] = f.sample(model, mat, wi[i], uvw[i][0], wp.vec2(uvw[i][1], uvw[i][2]))

    kernels["sample"] = sample_kernel
    if f.eval is not None:

        @wp.kernel(module="unique", enable_backward=False)
        def eval_kernel(
            model: wp.int32,
            mat: record,
            wi: wp.array(dtype=wp.vec3),
            wo: wp.array(dtype=wp.vec3),
            value_out: wp.array(dtype=wp.vec3),
            pdf_out: wp.array(dtype=wp.float32),
        ):
            i = wp.tid()
            value_out[i] = f.eval(model, mat, wi[i], wo[i])
            pdf_out[i] = f.pdf(model, mat, wi[i], wo[i])

        @wp.kernel(module="unique", enable_backward=False)
        def eval_vjp_kernel(
            model: wp.int32,
            mat: record,
            wi: wp.array(dtype=wp.vec3),
            wo: wp.array(dtype=wp.vec3),
            w: wp.vec3,
            out: wp.array(dtype=adjoint),
        ):
            i = wp.tid()
            out[i] = f.eval_vjp(model, mat, wi[i], wo[i], w)

        kernels["eval"] = eval_kernel
        kernels["eval_vjp"] = eval_vjp_kernel
    if f.scatter is not None:

        @wp.kernel(module="unique", enable_backward=False)
        def scatter_kernel(
            model: wp.int32,
            mat: record,
            wi: wp.array(dtype=wp.vec3),
            lobe: wp.int32,
            out: wp.array(dtype=Scattered),
        ):
            i = wp.tid()
            out[i] = f.scatter(model, mat, wi[i], lobe)

        @wp.kernel(module="unique", enable_backward=False)
        def scatter_vjp_kernel(
            model: wp.int32,
            mat: record,
            wi: wp.array(dtype=wp.vec3),
            lobe: wp.int32,
            w: wp.vec3,
            a_wo: wp.vec3,
            out: wp.array(dtype=adjoint),
        ):
            i = wp.tid()
            out[i] = f.scatter_vjp(model, mat, wi[i], lobe, w, a_wo)

        kernels["scatter"] = scatter_kernel
        kernels["scatter_vjp"] = scatter_vjp_kernel
    return kernels
