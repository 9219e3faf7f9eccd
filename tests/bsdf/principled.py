"""The tests' entries for ``principled`` and ``principledthin``: float64 twins, materials, Mitsuba's plugins."""

import numpy as np

from tests.bsdf.materials import BLACK, material
from warp_psdr.kernels.bsdf.principled import MIN_NORMAL_REFLECTANCE, TINT_BLACK

LUMINANCE = np.array([0.212671, 0.715160, 0.072169])
RATES = ("main_specular_sampling_rate", "clearcoat_sampling_rate", "diffuse_reflectance_sampling_rate")


def principled(roughness=0.6, base=(0.2, 0.5, 0.8), **more) -> dict:
    """A material; ``ior`` 0: by ``specular``."""
    weights = dict.fromkeys(
        ("anisotropic", "metallic", "spec_tint", "sheen", "sheen_tint", "flatness", "clearcoat", "clearcoat_gloss"), 0.0
    )
    given = {"ior": 1.5, "specular": 0.4, **dict.fromkeys(RATES, 1.0)}
    return material(base_color=base, roughness=roughness, **weights | given | more)


#: Everything at once, off all ends of the ranges.
TYPICAL = principled(
    0.65, anisotropic=0.3, metallic=0.3, spec_tint=0.4, sheen=0.6, sheen_tint=0.7, flatness=0.3, clearcoat=0.8,
    clearcoat_gloss=0.2, clearcoat_sampling_rate=1.5, diffuse_reflectance_sampling_rate=0.8,
)  # fmt: skip
ONES = dict.fromkeys(("metallic", "spec_tint", "sheen", "sheen_tint", "flatness", "clearcoat"), 1.0)


def is_thin(mat: dict) -> bool:
    """Whether it is a ``principledthin``, behind which is what is in front."""
    return "diff_trans" in mat


def index_of(mat: dict) -> float:
    """Index of refraction behind the surface over that in front."""
    if is_thin(mat):
        return 1.0
    root = np.sqrt(0.08 * mat["specular"] + MIN_NORMAL_REFLECTANCE)
    return mat["ior"] if mat["ior"] > 0.0 else 2.0 / (1.0 - root) - 1.0


def alphas(mat: dict) -> tuple[float, float]:
    """Slopes of the main lobe."""
    aspect = np.sqrt(1.0 - 0.9 * mat["anisotropic"])
    return max(1e-3, mat["roughness"] ** 2 / aspect), max(1e-3, mat["roughness"] ** 2 * aspect)


def coat_alpha(mat: dict) -> float:
    """Slope of the clear coat; 1: there is none."""
    if is_thin(mat):
        return 1.0
    return 0.1 - 0.099 * mat["clearcoat_gloss"]


def fresnel(cos: float, eta: float) -> float:
    """Reflectance of a dielectric."""
    sin_t = np.sqrt(max(1.0 - cos * cos, 0.0)) / eta
    if sin_t >= 1.0:
        return 1.0
    cos_t = np.sqrt(1.0 - sin_t**2)
    r_s, r_p = (cos - eta * cos_t) / (cos + eta * cos_t), (eta * cos - cos_t) / (eta * cos + cos_t)
    return 0.5 * (r_s**2 + r_p**2)


def g1(w: np.ndarray, au: float, av: float) -> float:
    """Smith's masking of GGX."""
    return 2.0 / (1.0 + np.sqrt(1.0 + np.hypot(au * w[0], av * w[1]) ** 2 / w[2] ** 2))


def base_and_sheen(mat: dict, wi: np.ndarray, wo: np.ndarray, c: float) -> tuple[np.ndarray, np.ndarray]:
    """Of directions in front, without the cosine of ``wo``."""
    base = mat["base_color"]
    s_c, s_i, s_o = ((1.0 - min(x, 1.0)) ** 5 for x in (c, wi[2], wo[2]))
    rr = 2.0 * mat["roughness"] * c * c
    diffuse = (1.0 - 0.5 * s_i) * (1.0 - 0.5 * s_o) + rr * (s_o + s_i + s_o * s_i * (rr - 1.0))
    fss = (1.0 + (0.5 * rr - 1.0) * s_o) * (1.0 + (0.5 * rr - 1.0) * s_i)
    flat = 1.25 * (fss * (1.0 / (wo[2] + wi[2]) - 0.5) + 0.5)
    tint = (base + TINT_BLACK) / (np.dot(LUMINANCE, base) + TINT_BLACK)
    matte = base / np.pi * ((1.0 - mat["flatness"]) * diffuse + mat["flatness"] * flat)
    return matte, mat["sheen"] * s_c * (1.0 + mat["sheen_tint"] * (tint - 1.0))


def principled_eval(mat: dict, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """f_s times the cosine of ``wo``."""
    if min(wi[2], wo[2]) <= 0.0:
        return _glass(mat, wi, wo) if "spec_trans" in mat else np.zeros(3)
    base, metallic, eta = mat["base_color"], mat["metallic"], index_of(mat)
    h = (wi + wo) / np.linalg.norm(wi + wo)
    c = np.dot(wi, h)
    tint = (base + TINT_BLACK) / (np.dot(LUMINANCE, base) + TINT_BLACK)
    s_c = (1.0 - min(c, 1.0)) ** 5
    refracted = np.sqrt(max(1.0 - (1.0 - c * c) / eta**2, 0.0))
    s_eta = s_c if eta > 1.0 else (1.0 - refracted) ** 5
    # The main lobe.
    au, av = alphas(mat)
    d = 1.0 / (np.pi * au * av * ((h[0] / au) ** 2 + (h[1] / av) ** 2 + h[2] ** 2) ** 2)
    r0 = ((eta - 1.0) / (eta + 1.0)) ** 2 * tint
    dielectric = (1.0 - mat["spec_tint"]) * fresnel(c, eta) + mat["spec_tint"] * (r0 + s_eta * (1.0 - r0))
    f = (1.0 - metallic) * dielectric + metallic * (base + s_eta * (1.0 - base))
    main = f * d * g1(wi, au, av) * g1(wo, au, av) / (4.0 * wi[2])
    # The clear coat.
    a2 = coat_alpha(mat) ** 2
    d1 = (a2 - 1.0) / (np.pi * np.log(a2) * (h[0] ** 2 + h[1] ** 2 + a2 * h[2] ** 2))
    coat = 0.25 * mat["clearcoat"] * (0.04 + 0.96 * s_eta) * d1 * g1(wi, 0.25, 0.25) * g1(wo, 0.25, 0.25) * wo[2]
    # The base and its sheen.
    matte, sheen = base_and_sheen(mat, wi, wo, c)
    return main + coat + (1.0 - metallic) * wo[2] * ((1.0 - mat.get("spec_trans", 0.0)) * matte + sheen)


def _glass(mat: dict, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """What is refracted, and what is reflected inside."""
    if wi[2] == 0.0 or wo[2] == 0.0:
        return np.zeros(3)
    eta = index_of(mat) if wi[2] > 0.0 else 1.0 / index_of(mat)
    share = (1.0 - mat["metallic"]) * mat["spec_trans"]
    inside = wi[2] * wo[2] > 0.0
    h = wi + wo if inside else wi + eta * wo
    h = h / np.linalg.norm(h) * np.sign(h[2])
    c, c_o = np.dot(wi, h), np.dot(wo, h)
    if c * wi[2] <= 0.0 or c_o * wo[2] <= 0.0:
        return np.zeros(3)
    au, av = alphas(mat)
    d = 1.0 / (np.pi * au * av * ((h[0] / au) ** 2 + (h[1] / av) ** 2 + h[2] ** 2) ** 2)
    f, g = fresnel(abs(c), eta), g1(wi, au, av) * g1(wo, au, av)
    if inside:
        return np.full(3, share * f * d * g / (4.0 * abs(wi[2])))
    root = mat["base_color"] / np.sqrt(mat["base_color"] + TINT_BLACK)
    return share * root * (1.0 - f) * d * g * abs(c * c_o) / (abs(wi[2]) * (c + eta * c_o) ** 2)


def mitsuba_principled(mat: dict) -> dict | None:
    """The plugin; None: its arithmetic does not resolve a lobe, or it does not draw one whose derivative is not 0."""
    if min(*alphas(mat), coat_alpha(mat) if mat["clearcoat"] > 0.0 else 1.0) < 0.03 or mat["metallic"] == 1.0:
        return None
    index = {"eta": mat["ior"]} if mat["ior"] > 0.0 else {"specular": mat["specular"]}
    numbers = {name: value for name, value in mat.items() if name not in ("base_color", "ior", "specular")}
    base = {"type": "rgb", "value": mat["base_color"].tolist()}
    return {"type": "principled", "base_color": base, **index, **numbers}


THIN_RATES = tuple(
    f"{lobe}_{way}_sampling_rate" for lobe in ("specular", "diffuse") for way in ("reflectance", "transmittance")
)


def thin(roughness=0.6, base=(0.2, 0.5, 0.8), ior=1.5, **more) -> dict:
    """A thin sheet."""
    weights = dict.fromkeys(
        ("anisotropic", "spec_trans", "spec_tint", "sheen", "sheen_tint", "flatness", "diff_trans"), 0.0
    )
    rates = dict.fromkeys(THIN_RATES, 1.0)
    return material(base_color=base, roughness=roughness, ior=ior, **weights | rates | more)


def thin_alphas(mat: dict) -> tuple[float, float]:
    """Slopes of the lobe that passes a sheet."""
    return alphas(mat | {"roughness": mat["roughness"] * (0.65 * mat["ior"] - 0.35)})


def thin_eval(mat: dict, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """f_s times the cosine of ``wo``."""
    if wi[2] == 0.0 or wo[2] == 0.0:
        return np.zeros(3)
    behind = wi[2] * wo[2] < 0.0
    i, o = (w * np.array([1.0, 1.0, np.sign(w[2])]) for w in (wi, wo))
    base, t, d, eta = mat["base_color"], mat["spec_trans"], 0.5 * mat["diff_trans"], mat["ior"]
    h = (i + o) / np.linalg.norm(i + o)
    c = np.dot(i, h)
    au, av = thin_alphas(mat) if behind else alphas(mat)
    density = 1.0 / (np.pi * au * av * ((h[0] / au) ** 2 + (h[1] / av) ** 2 + h[2] ** 2) ** 2)
    glossy = t * density * g1(i, au, av) * g1(o, au, av) / (4.0 * i[2])
    if behind:
        return base * (glossy * (1.0 - fresnel(c, eta)) + (1.0 - t) * d / np.pi * o[2])
    tint = (base + TINT_BLACK) / (np.dot(LUMINANCE, base) + TINT_BLACK)
    refracted = np.sqrt(max(1.0 - (1.0 - c * c) / eta**2, 0.0))
    s_eta = (1.0 - min(c if eta > 1.0 else refracted, 1.0)) ** 5
    r0 = ((eta - 1.0) / (eta + 1.0)) ** 2 * tint
    f = (1.0 - mat["spec_tint"]) * fresnel(c, eta) + mat["spec_tint"] * (r0 + s_eta * (1.0 - r0))
    return f * glossy + (1.0 - t) * (1.0 - d) * o[2] * sum(base_and_sheen(mat, i, o, c))


def mitsuba_cuts(wi: np.ndarray, wo: np.ndarray) -> bool:
    """Whether Mitsuba leaves the glossy lobe out that passes a sheet.

    It asks that ``wo``, which is mirrored at the sheet, also lies behind the microfacet that has reflected it: nothing
    in the model does, and the lobe ends at an edge of no meaning.
    """
    i, o = (w * np.array([1.0, 1.0, np.sign(w[2])]) for w in (wi, wo))
    return bool(wi[2] * wo[2] < 0.0 and np.dot(o * [1.0, 1.0, -1.0], i + o) >= 0.0)


def mitsuba_thin(mat: dict) -> dict | None:
    """The plugin; None: it does not draw a lobe whose derivative is not 0."""
    if not all(0.02 < share < 0.98 for share in (mat["spec_trans"], 0.5 * mat["diff_trans"])):
        return None
    numbers = {name: value for name, value in mat.items() if name not in ("base_color", "ior")}
    base = {"type": "rgb", "value": mat["base_color"].tolist()}
    return {"type": "principledthin", "base_color": base, "eta": mat["ior"], **numbers}


_SHARED = {
    "eval": principled_eval,
    "mitsuba": mitsuba_principled,
    "lossless": lambda mat: False,
    # Retro-reflection, sheen and the clear coat come on top of what the base reflects.
    "made": 1.0,
}
PRINCIPLED = _SHARED | {
    "materials": (
        TYPICAL,
        principled(0.5),
        principled(0.4, metallic=0.97, anisotropic=0.8, base=(0.9, 0.6, 0.3)),
        principled(0.7, BLACK, ior=0.0, specular=0.8, clearcoat=1.0, clearcoat_gloss=0.5, sheen=1.0),
    ),
    "more": (
        principled(0.6, (1.0, 1.0, 1.0), clearcoat_gloss=1.0, **ONES),
        principled(0.6, BLACK, ior=0.0, specular=0.0, spec_tint=0.5, sheen_tint=0.5),
        principled(0.6, ior=0.0, specular=1.0, anisotropic=1.0),
        principled(0.5, ior=0.8, metallic=0.5, flatness=1.0, spec_tint=1.0),
        principled(0.1, metallic=1.0),
        principled(0.0, clearcoat=1.0, clearcoat_gloss=0.9),
    ),
    "extremes": (principled(0.6, ior=1.0), principled(0.6, ior=0.999999), principled(0.0, ior=1.000001)),
}
TRANSMITTING = _SHARED | {
    "materials": (
        TYPICAL | {"spec_trans": 0.6},
        principled(0.5, spec_trans=0.97, ior=1.3),
        principled(0.6, spec_trans=0.5, ior=0.0, specular=0.8, anisotropic=0.5),
    ),
    "more": (
        principled(0.6, spec_trans=1.0, ior=0.75),
        principled(0.6, spec_trans=0.0, metallic=0.2),
        principled(0.6, BLACK, spec_trans=0.5),
        principled(0.7, spec_trans=1.0, metallic=1.0),
    ),
    "extremes": (principled(0.6, spec_trans=1.0, ior=1.0), principled(0.0, spec_trans=0.5, ior=1.001)),
}
THIN = _SHARED | {
    "eval": thin_eval,
    "mitsuba": mitsuba_thin,
    "mitsuba_wrong": mitsuba_cuts,
    "materials": (
        thin(
            0.65, anisotropic=0.3, spec_trans=0.6, spec_tint=0.4, sheen=0.6, sheen_tint=0.7, flatness=0.3,
            diff_trans=0.8, diffuse_transmittance_sampling_rate=0.7,
        ),
        thin(0.5, spec_trans=0.3, ior=1.3, diff_trans=1.7),
        thin(0.7, diff_trans=1.0),
    ),
    "more": (
        thin(0.6, (1.0, 1.0, 1.0), spec_trans=1.0, spec_tint=1.0, diff_trans=2.0),
        thin(0.6, BLACK, spec_trans=0.5, sheen=1.0, sheen_tint=0.5, diff_trans=1.0),
        thin(1.0, ior=2.5, spec_trans=0.9, anisotropic=1.0),
        thin(0.5, ior=0.8, spec_trans=0.5, flatness=1.0, spec_tint=1.0),
    ),
    "extremes": (thin(0.6, spec_trans=1.0, ior=1.0), thin(0.0, spec_trans=0.5, ior=0.54)),
}  # fmt: skip
