"""What the tests of scattering models share: launches over arrays, and a float64 twin of every model as the oracle.

The twin is written from the textbook formulas (complex Fresnel, angles, normalised half vectors), not from the kernels'
rearrangements of them, so that the two agree only where both are right.
"""

import functools

import numpy as np
import warp as wp

from warp_psdr.kernels.bsdf.dispatch import make_bsdf
from warp_psdr.kernels.bsdf.microfacet import MIN_ALPHA
from warp_psdr.kernels.constants import (
    BSDF_CONDUCTOR,
    BSDF_DIELECTRIC,
    BSDF_DIFFUSE,
    BSDF_ROUGH_CONDUCTOR_BECKMANN,
    BSDF_ROUGH_CONDUCTOR_GGX,
    LOBE_DELTA_REFLECTION,
)
from warp_psdr.kernels.structs import BsdfAdjoint, BsdfSample, Material, Scattered

ALL_MODELS = (
    BSDF_DIFFUSE,
    BSDF_CONDUCTOR,
    BSDF_DIELECTRIC,
    BSDF_ROUGH_CONDUCTOR_GGX,
    BSDF_ROUGH_CONDUCTOR_BECKMANN,
)
ROUGH = (BSDF_ROUGH_CONDUCTOR_GGX, BSDF_ROUGH_CONDUCTOR_BECKMANN)
#: eta and k of gold at red, green and blue (rounded).
GOLD = ((0.143, 0.375, 1.442), (3.983, 2.386, 1.603))
MIRROR = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))

#: A material as one float64 record, laid out like the struct on the device.
MATERIAL = np.dtype([("c0", "f8", 3), ("c1", "f8", 3), ("c2", "f8", 3), ("s0", "f8"), ("s1", "f8")])


def material(c0=(1.0, 1.0, 1.0), c1=(0.0, 0.0, 0.0), c2=(1.0, 1.0, 1.0), s0=0.0, s1=0.0) -> np.void:
    return np.array((c0, c1, c2, s0, s1), dtype=MATERIAL)[()]


def rough(alpha_u, alpha_v=None, metal=GOLD, reflectance=(0.9, 0.6, 0.3)) -> np.void:
    return material(reflectance, metal[0], metal[1], alpha_u, alpha_u if alpha_v is None else alpha_v)


def direction(degrees: float, azimuth: float = 30.0) -> np.ndarray:
    """Unit vector at an angle from the normal; the azimuth, degrees, keeps it off the axes."""
    t, p = np.radians(degrees), np.radians(azimuth)
    return np.array([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)])


def unit(w: np.ndarray) -> np.ndarray:
    return w / np.linalg.norm(w, axis=-1, keepdims=True)


def random_directions(rng: np.random.Generator, n: int, both_sides: bool = False) -> np.ndarray:
    w = rng.normal(size=(n, 3))
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    if not both_sides:
        w[:, 2] = np.abs(w[:, 2])
    return w


# --- launches ---


@functools.cache
def make_kernels(models: tuple[int, ...]) -> dict[str, wp.Kernel]:
    """One kernel a function of ``make_bsdf(models)``, all over one material, so that a test may ask for any of them."""
    f = make_bsdf(models)
    kernels = {}

    @wp.kernel(module="unique", enable_backward=False)
    def sample_kernel(
        model: wp.int32,
        mat: Material,
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
            mat: Material,
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
            mat: Material,
            wi: wp.array(dtype=wp.vec3),
            wo: wp.array(dtype=wp.vec3),
            w: wp.vec3,
            out: wp.array(dtype=BsdfAdjoint),
        ):
            i = wp.tid()
            out[i] = f.eval_vjp(model, mat, wi[i], wo[i], w)

        kernels["eval"] = eval_kernel
        kernels["eval_vjp"] = eval_vjp_kernel
    if f.scatter is not None:

        @wp.kernel(module="unique", enable_backward=False)
        def scatter_kernel(
            model: wp.int32,
            mat: Material,
            wi: wp.array(dtype=wp.vec3),
            lobe: wp.int32,
            out: wp.array(dtype=Scattered),
        ):
            i = wp.tid()
            out[i] = f.scatter(model, mat, wi[i], lobe)

        @wp.kernel(module="unique", enable_backward=False)
        def scatter_vjp_kernel(
            model: wp.int32,
            mat: Material,
            wi: wp.array(dtype=wp.vec3),
            lobe: wp.int32,
            w: wp.vec3,
            a_wo: wp.vec3,
            out: wp.array(dtype=BsdfAdjoint),
        ):
            i = wp.tid()
            out[i] = f.scatter_vjp(model, mat, wi[i], lobe, w, a_wo)

        kernels["scatter"] = scatter_kernel
        kernels["scatter_vjp"] = scatter_vjp_kernel
    return kernels


class Launcher:
    """The functions of a set of models over NumPy arrays; directions are (N, 3) or (3,), broadcast."""

    def __init__(self, device: str, models: tuple[int, ...] = ALL_MODELS):
        self.device = device
        self.kernels = make_kernels(models)

    def eval_pdf(self, model: int, mat: np.void, wi, wo) -> tuple[np.ndarray, np.ndarray]:
        wi, wo = self._vectors(wi, wo)
        value = wp.empty(len(wi), dtype=wp.vec3, device=self.device)
        pdf = wp.empty(len(wi), dtype=wp.float32, device=self.device)
        self._launch("eval", model, mat, [wi, wo], [value, pdf])
        return value.numpy().astype(float), pdf.numpy().astype(float)

    def sample(self, model: int, mat: np.void, wi, uvw) -> np.ndarray:
        wi, uvw = self._vectors(wi, uvw)
        return self._structs("sample", BsdfSample, model, mat, [wi, uvw])

    def eval_vjp(self, model: int, mat: np.void, wi, wo, w) -> np.ndarray:
        wi, wo = self._vectors(wi, wo)
        return self._structs("eval_vjp", BsdfAdjoint, model, mat, [wi, wo, wp.vec3(*w)])

    def scatter(self, model: int, mat: np.void, wi, lobe: int) -> np.ndarray:
        return self._structs("scatter", Scattered, model, mat, [*self._vectors(wi), lobe])

    def scatter_vjp(self, model: int, mat: np.void, wi, lobe: int, w, a_wo) -> np.ndarray:
        inputs = [*self._vectors(wi), lobe, wp.vec3(*w), wp.vec3(*a_wo)]
        return self._structs("scatter_vjp", BsdfAdjoint, model, mat, inputs)

    def _vectors(self, *arrays) -> list[wp.array]:
        broadcast = np.broadcast_arrays(*(np.atleast_2d(a) for a in arrays))
        return [wp.array(np.ascontiguousarray(a, np.float32), dtype=wp.vec3, device=self.device) for a in broadcast]

    def _structs(self, name: str, dtype, model: int, mat: np.void, inputs: list) -> np.ndarray:
        out = wp.empty(inputs[0].shape, dtype=dtype, device=self.device)
        self._launch(name, model, mat, inputs, [out])
        return out.numpy()

    def _launch(self, name: str, model: int, mat: np.void, inputs: list, outputs: list) -> None:
        m = Material()
        m.c0, m.c1, m.c2 = (wp.vec3(*mat[c]) for c in ("c0", "c1", "c2"))
        m.s0, m.s1 = float(mat["s0"]), float(mat["s1"])
        dim = inputs[0].shape
        wp.launch(self.kernels[name], dim=dim, inputs=[model, m, *inputs], outputs=outputs, device=self.device)


# --- the float64 twin ---


def twin_fresnel_conductor(cos: float, eta: np.ndarray, k: np.ndarray) -> np.ndarray:
    n = eta + 1j * k
    n_cos_t = n * np.sqrt(1.0 - (1.0 - cos**2) / n**2 + 0j)
    # Of the two roots the one in the first quadrant; its axes are k = 0 and eta = 0, which lie inside the domain here.
    n_cos_t = np.where(n_cos_t.real + n_cos_t.imag < 0.0, -n_cos_t, n_cos_t)
    r_s = (cos - n_cos_t) / (cos + n_cos_t)
    r_p = (n * n * cos - n_cos_t) / (n * n * cos + n_cos_t)
    return 0.5 * (np.abs(r_s) ** 2 + np.abs(r_p) ** 2)


def twin_eval(model: int, mat: np.void, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    if min(wi[2], wo[2]) <= 0.0:
        return np.zeros(3)
    if model == BSDF_DIFFUSE:
        return mat["c0"] / np.pi * wo[2]
    if model not in ROUGH:
        return np.zeros(3)
    au, av = (max(mat[name], float(np.float32(MIN_ALPHA))) for name in ("s0", "s1"))
    h = (wi + wo) / np.linalg.norm(wi + wo)
    theta, phi = np.arctan2(np.hypot(h[0], h[1]), h[2]), np.arctan2(h[1], h[0])
    t = np.tan(theta) ** 2 * ((np.cos(phi) / au) ** 2 + (np.sin(phi) / av) ** 2)
    p = np.exp(-t) if model == BSDF_ROUGH_CONDUCTOR_BECKMANN else 1.0 / (1.0 + t) ** 2
    d = p / (np.pi * au * av * np.cos(theta) ** 4)
    fresnel = twin_fresnel_conductor(np.dot(wi, h), mat["c1"], mat["c2"])
    return mat["c0"] * fresnel * d * _twin_g1(model, wi, au, av) * _twin_g1(model, wo, au, av) / (4.0 * wi[2])


def _twin_g1(model: int, w: np.ndarray, au: float, av: float) -> float:
    tan_alpha = np.hypot(au * w[0], av * w[1]) / w[2]
    if tan_alpha == 0.0:
        return 1.0
    if model == BSDF_ROUGH_CONDUCTOR_GGX:
        return 2.0 / (1.0 + np.sqrt(1.0 + tan_alpha**2))
    a = 1.0 / tan_alpha
    return 1.0 if a >= 1.6 else min(1.0, (3.535 * a + 2.181 * a**2) / (1.0 + 2.276 * a + 2.577 * a**2))


def twin_scatter(model: int, mat: np.void, wi: np.ndarray, lobe: int) -> tuple[np.ndarray, np.ndarray]:
    """Direction and value of a delta lobe."""
    mirror = wi * [-1.0, -1.0, 1.0]
    if model == BSDF_CONDUCTOR:
        return mirror, mat["c0"] * twin_fresnel_conductor(wi[2], mat["c1"], mat["c2"]) * (wi[2] > 0.0)
    assert model == BSDF_DIELECTRIC
    eta = mat["s0"] if wi[2] > 0.0 else 1.0 / mat["s0"]
    theta = np.arccos(min(abs(wi[2]), 1.0))
    sin_t = np.sin(theta) / eta
    if sin_t >= 1.0:
        return mirror, mat["c0"] if lobe == LOBE_DELTA_REFLECTION else np.zeros(3)
    theta_t = np.arcsin(sin_t)
    r_s = (np.cos(theta) - eta * np.cos(theta_t)) / (np.cos(theta) + eta * np.cos(theta_t))
    r_p = (eta * np.cos(theta) - np.cos(theta_t)) / (eta * np.cos(theta) + np.cos(theta_t))
    reflectance = 0.5 * (r_s**2 + r_p**2)
    if lobe == LOBE_DELTA_REFLECTION:
        return mirror, mat["c0"] * reflectance
    wo = np.array([-wi[0] / eta, -wi[1] / eta, -np.sign(wi[2]) * np.cos(theta_t)])
    return wo, mat["c1"] * (1.0 - reflectance) / eta**2
