"""A float64 twin of every scattering model, the oracle of their tests.

The twins are written from the textbook formulas (complex Fresnel equations, angles, normalised half vectors), not from
the kernels' rearrangements of them, so that the two agree only where both are right. A material is a dictionary of the
values that its model declares, by their names.
"""

import numpy as np

from warp_psdr.kernels.bsdf.microfacet import MIN_ALPHA
from warp_psdr.kernels.constants import LOBE_DELTA_REFLECTION, LOBE_NULL
from warp_psdr.scene.materials.rough_transmittance import transmittance

#: Turns a direction into its mirror direction.
MIRRORED = np.array([-1.0, -1.0, 1.0])


def fresnel_conductor(cos: float, eta: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Reflectance of a metal."""
    n = eta + 1j * k
    n_cos_t = n * np.sqrt(1.0 - (1.0 - cos**2) / n**2 + 0j)
    # Of the two roots the one in the first quadrant; its axes are k = 0 and eta = 0, which lie inside the domain here.
    n_cos_t = np.where(n_cos_t.real + n_cos_t.imag < 0.0, -n_cos_t, n_cos_t)
    r_s = (cos - n_cos_t) / (cos + n_cos_t)
    r_p = (n * n * cos - n_cos_t) / (n * n * cos + n_cos_t)
    return 0.5 * (np.abs(r_s) ** 2 + np.abs(r_p) ** 2)


def fresnel_dielectric(cos: float, eta: float) -> tuple[float, float]:
    """Reflectance of an interface and the cosine behind it; ``eta``: the index behind over that in front."""
    theta = np.arccos(min(cos, 1.0))
    sin_t = np.sin(theta) / eta
    if sin_t >= 1.0:
        return 1.0, 0.0
    theta_t = np.arcsin(sin_t)
    r_s = (np.cos(theta) - eta * np.cos(theta_t)) / (np.cos(theta) + eta * np.cos(theta_t))
    r_p = (eta * np.cos(theta) - np.cos(theta_t)) / (eta * np.cos(theta) + np.cos(theta_t))
    return 0.5 * (r_s**2 + r_p**2), np.cos(theta_t)


def mean_reflectance(eta: float) -> float:
    """Mean reflectance of an interface for diffuse light: the fits that define ``plastic``."""
    if eta < 1.0:
        return -1.4399 * eta**2 + 0.7099 * eta + 0.6681 + 0.0636 / eta
    return float(np.polynomial.Polynomial([0.919317, -3.4793, 6.75335, -7.80989, 4.98554, -1.36881])(1.0 / eta))


# --- smooth lobes: f_s times the cosine of wo ---


def diffuse_eval(mat: dict, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    if min(wi[2], wo[2]) <= 0.0:
        return np.zeros(3)
    return mat["reflectance"] / np.pi * wo[2]


def oren_nayar_eval(mat: dict, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    if min(wi[2], wo[2]) <= 0.0:
        return np.zeros(3)
    lesser, greater = sorted(np.arctan2(np.hypot(w[0], w[1]), w[2]) for w in (wi, wo))
    turn = np.arctan2(wi[1], wi[0]) - np.arctan2(wo[1], wo[0])
    s2 = mat["sigma"] ** 2
    a, b = 1.0 - 0.5 * s2 / (s2 + 0.33), 0.45 * s2 / (s2 + 0.09)
    grooves = a + b * max(0.0, np.cos(turn)) * np.sin(greater) * np.tan(lesser)
    return mat["reflectance"] / np.pi * grooves * wo[2]


def ashikhmin_shirley_eval(mat: dict, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    if min(wi[2], wo[2]) <= 0.0:
        return np.zeros(3)
    nu, nv, rs = mat["nu"], mat["nv"], mat["specular_reflectance"]
    h = (wi + wo) / np.linalg.norm(wi + wo)
    c, phi = np.dot(wi, h), np.arctan2(h[1], h[0])
    power = nu * np.cos(phi) ** 2 + nv * np.sin(phi) ** 2
    # The logarithm of the cosine from the sine, which is what has digits near the normal.
    d = np.sqrt((nu + 1.0) * (nv + 1.0)) / (2.0 * np.pi) * np.exp(0.5 * power * np.log1p(-(h[0] ** 2 + h[1] ** 2)))
    glossy = d * (rs + (1.0 - rs) * (1.0 - c) ** 5) / (4.0 * c * max(wi[2], wo[2]))
    below = (1.0 - (1.0 - wi[2] / 2.0) ** 5) * (1.0 - (1.0 - wo[2] / 2.0) ** 5)
    return (glossy + 28.0 / (23.0 * np.pi) * mat["reflectance"] * (1.0 - rs) * below) * wo[2]


def abc_eval(mat: dict, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    if min(wi[2], wo[2]) <= 0.0:
        return np.zeros(3)
    h = (wi + wo) / np.linalg.norm(wi + wo)
    c, sine2 = np.dot(wi, h), h[0] ** 2 + h[1] ** 2
    s = mat["A"] * (1.0 + mat["B"] * sine2 / (1.0 + h[2])) ** -mat["C"]
    masking = min(1.0, 2.0 * h[2] * wi[2] / c, 2.0 * h[2] * wo[2] / c)
    return mat["specular_reflectance"] * fresnel_conductor(c, mat["eta"], mat["k"]) * s * masking / wi[2]


def ggx_eval(mat: dict, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    return _rough_conductor_eval(mat, wi, wo, lambda t: 1.0 / (1.0 + t) ** 2, ggx_g1)


def beckmann_eval(mat: dict, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    return _rough_conductor_eval(mat, wi, wo, lambda t: np.exp(-t), _beckmann_g1)


def _rough_conductor_eval(mat: dict, wi: np.ndarray, wo: np.ndarray, p, g1) -> np.ndarray:
    if min(wi[2], wo[2]) <= 0.0:
        return np.zeros(3)
    au, av = (max(mat[name], float(np.float32(MIN_ALPHA))) for name in ("alpha_u", "alpha_v"))
    h = (wi + wo) / np.linalg.norm(wi + wo)
    theta, phi = np.arctan2(np.hypot(h[0], h[1]), h[2]), np.arctan2(h[1], h[0])
    t = np.tan(theta) ** 2 * ((np.cos(phi) / au) ** 2 + (np.sin(phi) / av) ** 2)
    d = p(t) / (np.pi * au * av * np.cos(theta) ** 4)
    fresnel = fresnel_conductor(np.dot(wi, h), mat["eta"], mat["k"])
    masking = g1(_slope(wi, au, av)) * g1(_slope(wo, au, av))
    return mat["specular_reflectance"] * fresnel * d * masking / (4.0 * wi[2])


def _slope(w: np.ndarray, au: float, av: float) -> float:
    return np.hypot(au * w[0], av * w[1]) / w[2]


def ggx_g1(tan_alpha: float) -> float:
    return 2.0 / (1.0 + np.sqrt(1.0 + tan_alpha**2))


def _beckmann_g1(tan_alpha: float) -> float:
    if tan_alpha == 0.0:
        return 1.0
    a = 1.0 / tan_alpha
    return 1.0 if a >= 1.6 else min(1.0, (3.535 * a + 2.181 * a**2) / (1.0 + 2.276 * a + 2.577 * a**2))


def plastic_eval(mat: dict, wi: np.ndarray, wo: np.ndarray, nonlinear: bool = False) -> np.ndarray:
    if min(wi[2], wo[2]) <= 0.0:
        return np.zeros(3)
    rho, eta = mat["diffuse_reflectance"], mat["ior"]
    passed_in, passed_out = (1.0 - fresnel_dielectric(w[2], eta)[0] for w in (wi, wo))
    # A share of the light from the base is reflected back to it, where the nonlinear variant tints it again.
    again = mean_reflectance(1.0 / eta) * (rho if nonlinear else 1.0)
    return rho / (1.0 - again) * passed_in * passed_out / (np.pi * eta**2) * wo[2]


def nonlinear_plastic_eval(mat: dict, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    return plastic_eval(mat, wi, wo, nonlinear=True)


def rough_plastic_eval(mat: dict, wi: np.ndarray, wo: np.ndarray, distribution: str, nonlinear: bool) -> np.ndarray:
    if min(wi[2], wo[2]) <= 0.0:
        return np.zeros(3)
    rho, eta, alpha = mat["diffuse_reflectance"], mat["ior"], mat["alpha"]
    p, g1 = {"ggx": (lambda t: 1.0 / (1.0 + t) ** 2, ggx_g1), "beckmann": (lambda t: np.exp(-t), _beckmann_g1)}[
        distribution
    ]
    h = (wi + wo) / np.linalg.norm(wi + wo)
    d = p((h[0] ** 2 + h[1] ** 2) / (alpha * h[2]) ** 2) / (np.pi * alpha**2 * h[2] ** 4)
    masking = g1(_slope(wi, alpha, alpha)) * g1(_slope(wo, alpha, alpha))
    specular = mat["specular_reflectance"] * fresnel_dielectric(np.dot(wi, h), eta)[0] * d * masking / (4.0 * wi[2])
    inside, through = _coat(distribution, alpha, eta)
    passed_in, passed_out = (np.interp(w[2], np.linspace(0.0, 1.0, len(through)), through) for w in (wi, wo))
    again = inside * (rho if nonlinear else 1.0)
    return specular + rho / (1.0 - again) * passed_in * passed_out / (np.pi * eta**2) * wo[2]


def _coat(distribution: str, alpha: float, eta: float) -> tuple[float, np.ndarray]:
    """R and T by the table of the nearest values of three digits; small moves of either are of first order."""
    near = transmittance(distribution, *(float(np.float32(f"{x:.3g}")) for x in (alpha, eta)))
    made, *rows = near.astype(float).reshape(-1, 3)
    inside, *through = np.array(rows) @ [1.0, alpha - made[0], eta - made[1]]
    return inside, np.array(through)


def rough_dielectric_eval(mat: dict, wi: np.ndarray, wo: np.ndarray, distribution: str) -> np.ndarray:
    au, av = (max(mat[name], float(np.float32(MIN_ALPHA))) for name in ("alpha_u", "alpha_v"))
    eta = mat["ior"] if wi[2] > 0.0 else 1.0 / mat["ior"]
    reflected = wi[2] * wo[2] > 0.0
    h = wi + wo if reflected else wi + eta * wo
    h = h / np.linalg.norm(h) * np.sign(h[2])
    i, o = np.dot(wi, h), np.dot(wo, h)
    if i * wi[2] <= 0.0 or o * wo[2] <= 0.0:
        return np.zeros(3)
    p, g1 = {"ggx": (lambda t: 1.0 / (1.0 + t) ** 2, ggx_g1), "beckmann": (lambda t: np.exp(-t), _beckmann_g1)}[
        distribution
    ]
    d = p(((h[0] / au) ** 2 + (h[1] / av) ** 2) / h[2] ** 2) / (np.pi * au * av * h[2] ** 4)
    masking = g1(abs(_slope(wi, au, av))) * g1(abs(_slope(wo, au, av)))
    fresnel = fresnel_dielectric(abs(i), eta)[0]
    if reflected:
        return mat["specular_reflectance"] * fresnel * d * masking / (4.0 * abs(wi[2]))
    # The Jacobian of the half vector has eta^2, by which radiance is divided.
    jacobian = abs(o) / (i + eta * o) ** 2
    return mat["specular_transmittance"] * (1.0 - fresnel) * d * masking * jacobian * abs(i) / abs(wi[2])


# --- delta lobes: direction and weight ---


def conductor_scatter(mat: dict, wi: np.ndarray, _lobe: int) -> tuple[np.ndarray, np.ndarray]:
    value = mat["specular_reflectance"] * fresnel_conductor(wi[2], mat["eta"], mat["k"])
    return wi * MIRRORED, value * (wi[2] > 0.0)


def dielectric_scatter(mat: dict, wi: np.ndarray, lobe: int) -> tuple[np.ndarray, np.ndarray]:
    eta = mat["ior"] if wi[2] > 0.0 else 1.0 / mat["ior"]
    reflectance, cos_t = fresnel_dielectric(abs(wi[2]), eta)
    if lobe == LOBE_DELTA_REFLECTION:
        return wi * MIRRORED, mat["specular_reflectance"] * reflectance
    if cos_t == 0.0:
        return wi * MIRRORED, np.zeros(3)
    wo = np.array([-wi[0] / eta, -wi[1] / eta, -np.sign(wi[2]) * cos_t])
    return wo, mat["specular_transmittance"] * (1.0 - reflectance) / eta**2


def plastic_scatter(mat: dict, wi: np.ndarray, _lobe: int) -> tuple[np.ndarray, np.ndarray]:
    if wi[2] <= 0.0:
        return wi * MIRRORED, np.zeros(3)
    return wi * MIRRORED, mat["specular_reflectance"] * fresnel_dielectric(wi[2], mat["ior"])[0]


def null_scatter(_mat: dict, wi: np.ndarray, _lobe: int) -> tuple[np.ndarray, np.ndarray]:
    return -wi, np.ones(3)


def thindielectric_scatter(mat: dict, wi: np.ndarray, lobe: int) -> tuple[np.ndarray, np.ndarray]:
    reflectance = fresnel_dielectric(abs(wi[2]), mat["ior"])[0]
    # Interreflection within the plate: a geometric series.
    passed = (1.0 - reflectance) ** 2 / (1.0 - reflectance**2) if reflectance < 1.0 else 0.0
    if lobe == LOBE_NULL:
        return -wi, mat["specular_transmittance"] * passed
    return wi * MIRRORED, mat["specular_reflectance"] * (1.0 - passed)
