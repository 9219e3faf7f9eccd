"""Examples of models made of models, put together from those of their children."""

import re

import numpy as np
import pytest

from tests.bsdf.materials import glass, material, metal, plastic, rough
from tests.bsdf.principled import alphas, index_of
from warp_psdr.kernels.bsdf.blendbsdf import MIN_SHARE
from warp_psdr.kernels.bsdf.composite import split_key
from warp_psdr.kernels.bsdf.dispatch import declaration_of
from warp_psdr.kernels.constants import LOBE_NULL

#: Examples of models made of models: two smooth lobes, a mirror reflection of both, one that transmits.
SMOOTH_BLEND = "blendbsdf(diffuse, roughconductor (ggx))"
COATED_BLEND = "blendbsdf(plastic, conductor)"
GLASS_BLEND = "blendbsdf(diffuse, dielectric)"
#: A normal map with both switches on, a bump map with both off.
MAPPED = "normalmap(plastic)"
BUMPED = "bumpmap(roughconductor (ggx)) (no_flip_invalid_normals no_use_shadowing_function)"
MASKED = "mask(diffuse)"
MASKED_PLATE = "mask(thindielectric)"
MASKED_COAT = "mask(plastic) (explored)"


def nest(**children: dict) -> dict:
    """Values of a composite: its own, and those of its children under their prefixes."""
    out = {}
    for prefix, mat in children.items():
        out |= {f"{prefix}_{name}": value for name, value in mat.items()} if isinstance(mat, dict) else {prefix: mat}
    return out


def part(mat: dict, prefix: str) -> dict:
    """Values of a child."""
    return {name.removeprefix(f"{prefix}_"): v for name, v in mat.items() if name.startswith(f"{prefix}_")}


def bare(mat: dict) -> dict:
    """Values under the names that they have in the innermost models; of equal names the last one counts."""
    return {re.sub("^((first|second|nested)_)+", "", name): value for name, value in mat.items()}


def narrowest(mat: dict) -> float:
    """Least roughness; 1: the model has none."""
    if "base_color" in mat:
        return min(alphas(mat))
    if "nu" in mat:
        return float(np.sqrt(2.0 / (max(mat["nu"], mat["nv"]) + 2.0)))
    if "B" in mat:
        return float(np.clip(np.sqrt(2.0 / (mat["B"] + 1.0)), 0.0, 1.0))
    return min(bare(mat).get(name, 1.0) for name in ("alpha", "alpha_u", "alpha_v"))


def index_behind(mat: dict, wi: np.ndarray) -> float:
    """Index of refraction behind the interface over the one in front."""
    ior = index_of(mat) if "base_color" in mat else bare(mat)["ior"]
    return ior if wi[2] > 0.0 else 1.0 / ior


def blend(examples: dict, key: str) -> dict:
    """What an ``Example`` of a blend needs but for its materials, from those of its children."""
    one, two = (examples[child] for child in split_key(key)[2])
    lobes = [declaration_of(child)[0].lobes for child in split_key(key)[2]]

    def mixed(mat: dict, of_one, of_two):
        w = mat["weight"]
        return (1.0 - w) * of_one(part(mat, "first")) + w * of_two(part(mat, "second"))

    def value(mat: dict, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
        f, g = (e.eval or (lambda *_: np.zeros(3)) for e in (one, two))
        return mixed(mat, lambda m: f(m, wi, wo), lambda m: g(m, wi, wo))

    def scatter(mat: dict, wi: np.ndarray, lobe: int) -> tuple[np.ndarray, np.ndarray]:
        def of(example, lobes, m):
            return example.scatter(m, wi, lobe) if lobe in lobes else (None, np.zeros(3))

        wo = of(one, lobes[0], part(mat, "first"))[0]
        wo = of(two, lobes[1], part(mat, "second"))[0] if wo is None else wo
        return wo, mixed(mat, lambda m: of(one, lobes[0], m)[1], lambda m: of(two, lobes[1], m)[1])

    def mitsuba(mat: dict) -> dict | None:
        nested = [example.mitsuba(part(mat, prefix)) for example, prefix in ((one, "first"), (two, "second"))]
        # A model of weight 0 is not drawn there, and here it is, since its derivative is not 0.
        if None in nested or not MIN_SHARE <= mat["weight"] <= 1.0 - MIN_SHARE:
            return None
        return {"type": "blendbsdf", "weight": mat["weight"], "a": nested[0], "b": nested[1]}

    model = declaration_of(key)[0]
    return {
        "eval": value if model.has_smooth else None,
        "scatter": scatter if model.has_delta else None,
        "mitsuba": mitsuba,
        "lossless": lambda mat: one.lossless(part(mat, "first")) and two.lossless(part(mat, "second")),
    }


def mask(examples: dict, key: str) -> dict:
    """What an ``Example`` of a mask needs but for its materials, from that of its child."""
    child = examples[split_key(key)[2][0]]
    lobes = declaration_of(split_key(key)[2][0])[0].lobes

    def value(mat: dict, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
        return mat["opacity"] * child.eval(part(mat, "nested"), wi, wo)

    def scatter(mat: dict, wi: np.ndarray, lobe: int) -> tuple[np.ndarray, np.ndarray]:
        nothing = -wi, np.zeros(3)
        wo, inner = child.scatter(part(mat, "nested"), wi, lobe) if lobe in lobes else nothing
        return wo, mat["opacity"] * inner + (lobe == LOBE_NULL) * (1.0 - mat["opacity"])

    def mitsuba(mat: dict) -> dict | None:
        nested = child.mitsuba(part(mat, "nested"))
        if nested is None or not 0.0 < mat["opacity"] < 1.0:
            return None
        return {"type": "mask", "opacity": mat["opacity"], "a": nested}

    return {
        "eval": value if declaration_of(key)[0].has_smooth else None,
        "scatter": scatter,
        "mitsuba": mitsuba,
        # From behind, an opaque model loses its share.
        "lossless": lambda mat: (
            declaration_of(split_key(key)[2][0])[0].transmits and child.lossless(part(mat, "nested"))
        ),
    }


def framed(examples: dict, key: str, normal_of, mitsuba_of) -> dict:
    """What an ``Example`` of a normal or bump map needs but for its materials, from that of the nested model.

    Args:
        examples: of plain models.
        key: of the map.
        normal_of: ``mat -> n``, its unit normal in local coordinates.
        mitsuba_of: ``mat -> dict``: the plugin's own parameters in Mitsuba.
    """
    _, variant, (child,) = split_key(key)
    inner, model = examples[child], declaration_of(child)[0]
    flip, shadow = (f"no_{name}" not in variant for name in ("flip_invalid_normals", "use_shadowing_function"))

    def frame(mat: dict, wi: np.ndarray) -> np.ndarray:
        n = normal_of(mat)
        if flip and wi[2] * (wi @ n) <= 0.0:
            n = n * [-1.0, -1.0, 1.0]
        s = np.array([1.0, 0.0, 0.0]) - n * n[0]
        s /= np.linalg.norm(s)
        return np.array([s, np.cross(n, s), n])

    def seen(rows: np.ndarray, wo: np.ndarray) -> float:
        if wo[2] * (wo @ rows[2]) <= 0.0:
            return 0.0
        tan_n, tan_o = (np.hypot(w[0], w[1]) / w[2] for w in (rows[2], wo))
        return 2.0 / (1.0 + np.sqrt(1.0 + min(tan_n**2 / 8.0, 1.0) * tan_o**2)) if shadow else 1.0

    def value(mat: dict, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
        rows = frame(mat, wi)
        return seen(rows, wo) * inner.eval(part(mat, "nested"), rows @ wi, rows @ wo)

    def scatter(mat: dict, wi: np.ndarray, lobe: int) -> tuple[np.ndarray, np.ndarray]:
        rows = frame(mat, wi)
        wo, weight = inner.scatter(part(mat, "nested"), rows @ wi, lobe)
        return rows.T @ wo, seen(rows, rows.T @ wo) * weight

    def mitsuba(mat: dict) -> dict | None:
        nested = inner.mitsuba(part(mat, "nested"))
        # Mitsuba builds the frame of a bump map from dp/du in world coordinates, which only two roughnesses notice.
        if nested is None or bare(mat).get("alpha_u") != bare(mat).get("alpha_v"):
            return None
        switches = {"flip_invalid_normals": flip, "use_shadowing_function": shadow}
        return {"type": split_key(key)[0], **switches, **mitsuba_of(mat), "nested": nested}

    return {
        "eval": value if model.has_smooth else None,
        "scatter": scatter if model.has_delta else None,
        "mitsuba": mitsuba,
        "lossless": lambda mat: False,
    }


def mapped_normal(mat: dict) -> np.ndarray:
    """The normal of a normal map."""
    n = (2.0 * mat["normalmap"] - 1.0) * [1.0, mat["side"], 1.0]
    return n / np.linalg.norm(n)


def bumped_normal(mat: dict) -> np.ndarray:
    """The normal of a bump map: of the plane that both turned tangents span."""
    a, b, c = mat["metric"]
    du, dv = np.array([a, 0.0, mat["scale"] * mat["heights"][0]]), np.array([b, c, mat["scale"] * mat["heights"][1]])
    n = np.cross(du, dv)
    return n * np.sign(n[2]) / np.linalg.norm(n)


def ramp(mat: dict) -> np.ndarray:
    """A bitmap of 2 x 2 heights that rises so in the middle of the texture coordinates."""
    u, v = 0.5 * mat["heights"][0], 0.5 * mat["heights"][1]
    return np.array([[0.0, u], [v, u + v]], np.float32)


def _normals(mat: dict) -> dict:
    return {
        "type": "rgb",
        "value": (mat["normalmap"] * [1.0, mat["side"], 1.0] + [0.0, mat["side"] < 0.0, 0.0]).tolist(),
    }


def _heights(mat: dict) -> dict:
    mi = pytest.importorskip("mitsuba")
    return {"type": "bitmap", "raw": True, "wrap_mode": "clamp", "bitmap": mi.Bitmap(ramp(mat)[..., None])}


def nested_examples(example: type, plain: dict) -> dict:
    """The ``Example``s of models made of models, from the plain ones."""
    return {
        SMOOTH_BLEND: example(
            materials=tuple(
                nest(weight=w, first=material(reflectance=(0.2, 0.5, 0.8)), second=rough(*alpha))
                for w, alpha in ((0.3, (0.4, 0.3)), (0.0, (0.6, 0.6)), (1.0, (0.6, 0.6)), (0.9, (0.3, 0.3)))
            ),
            **blend(plain, SMOOTH_BLEND),
        ),
        COATED_BLEND: example(
            materials=tuple(nest(weight=w, first=plastic(1.5), second=metal()) for w in (0.5, 0.0, 1.0)),
            **blend(plain, COATED_BLEND),
        ),
        GLASS_BLEND: example(
            materials=tuple(
                nest(weight=w, first=material(reflectance=(0.2, 0.5, 0.8)), second=glass(ior))
                for w, ior in ((0.5, 1.5), (0.0, 1.3), (1.0, 0.7))
            ),
            # Nothing but the glass sends the light that comes from behind.
            **blend(plain, GLASS_BLEND) | {"lossless": lambda mat: False},
        ),
        MAPPED: example(
            materials=tuple(
                nest(normalmap=np.array(n), side=side, nested=plastic(1.5))
                for n, side in (((0.7, 0.4, 0.85), -1.0), ((0.5, 0.5, 1.0), 1.0), ((0.1, 0.6, 0.7), 1.0))
            ),
            extremes=tuple(
                nest(normalmap=np.array(n), side=1.0, nested=plastic(1.5)) for n in ((0.5, 0.5, 0.5), (1.0, 0.5, 0.5))
            ),
            **framed(plain, MAPPED, mapped_normal, lambda mat: {"normalmap": _normals(mat)}),
        ),
        BUMPED: example(
            materials=tuple(
                nest(heights=np.array(h), scale=scale, metric=np.array(m), nested=rough(*alpha))
                for h, scale, m, alpha in (
                    ((0.6, 0.4, 0.1), 0.5, (1.5, 0.4, 0.8), (0.4, 0.3)),
                    ((0.0, 0.0, 0.0), 1.0, (1.0, 0.0, 1.0), (0.4, 0.4)),
                    ((-0.5, 0.3, 0.0), 1.3, (2.0, -0.7, 1.3), (0.6, 0.6)),
                )
            ),
            extremes=tuple(
                nest(heights=np.array(h), scale=1.0, metric=np.array(m), nested=rough(0.4, 0.3))
                for h, m in (((1.0, 1.0, 0.0), (0.0, 0.0, 0.0)), ((1e4, -1e4, 0.0), (1.0, 0.0, 1.0)))
            ),
            **framed(plain, BUMPED, bumped_normal, lambda mat: {"heights": _heights(mat), "scale": mat["scale"]}),
        ),
        MASKED: example(
            materials=tuple(nest(opacity=o, nested=material(reflectance=(0.2, 0.5, 0.8))) for o in (0.7, 0.0, 1.0)),
            **mask(plain, MASKED),
        ),
        MASKED_PLATE: example(
            materials=tuple(nest(opacity=o, nested=glass(1.5)) for o in (0.7, 0.0, 1.0)), **mask(plain, MASKED_PLATE)
        ),
        MASKED_COAT: example(
            materials=tuple(nest(opacity=o, nested=plastic(1.5)) for o in (0.7, 0.0, 1.0)), **mask(plain, MASKED_COAT)
        ),
    }
