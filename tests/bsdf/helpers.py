"""What the tests of scattering models share: launches over arrays, and ``EXAMPLES``, the table of what is tested.

A new model joins the tests by one entry in that table (two or more if it has variants), with a twin in
``twins.py``.
"""

import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp

from tests.bsdf import twins
from tests.bsdf.kernels import functions_of, make_kernels
from tests.bsdf.materials import (  # noqa: F401 -- tests take them from here
    BLACK,
    GOLD,
    LOSSLESS,
    MIRROR,
    abc,
    glass,
    material,
    metal,
    plastic,
    rough,
    rough_glass,
    rough_plastic,
)
from tests.bsdf.mitsuba_plugins import (
    mitsuba_dielectric,
    mitsuba_plastic,
    mitsuba_rough,
    mitsuba_rough_glass,
    mitsuba_rough_plastic,
    rgb,
)
from tests.bsdf.nested import (  # noqa: F401
    BUMPED,
    COATED_BLEND,
    GLASS_BLEND,
    MAPPED,
    MASKED,
    MASKED_COAT,
    MASKED_PLATE,
    SMOOTH_BLEND,
    bare,
    index_behind,
    narrowest,
    nest,
    nested_examples,
)
from tests.bsdf.principled import PRINCIPLED, THIN, TRANSMITTING
from warp_psdr.kernels.bsdf.composite import split_key
from warp_psdr.kernels.bsdf.dispatch import VARIANTS, declaration_of, ordered
from warp_psdr.kernels.bsdf.microfacet import MIN_ALPHA
from warp_psdr.kernels.bsdf.model import ComplexIndex, Value
from warp_psdr.kernels.constants import LOBE_DELTA_TRANSMISSION, LOBE_SMOOTH
from warp_psdr.kernels.structs import BsdfSample, Scattered
from warp_psdr.scene.materials.tables import MAKERS

NESTED_MODELS = ordered((SMOOTH_BLEND, COATED_BLEND, GLASS_BLEND, MAPPED, BUMPED, MASKED, MASKED_PLATE, MASKED_COAT))
PLAIN_MODELS = tuple(VARIANTS)
ALL_MODELS = (*PLAIN_MODELS, *NESTED_MODELS)
SMOOTH_MODELS = tuple(key for key in ALL_MODELS if declaration_of(key)[0].has_smooth)
DELTA_MODELS = tuple(key for key in ALL_MODELS if declaration_of(key)[0].has_delta)
GGX, BECKMANN = "roughconductor (ggx)", "roughconductor (beckmann)"

BELOW = np.array([1.0, 1.0, -1.0])


# --- directions ---


def direction(degrees: float, azimuth: float = 30.0) -> np.ndarray:
    """Unit vector at an angle from the normal; the azimuth, degrees, keeps it off the axes."""
    t, p = np.radians(degrees), np.radians(azimuth)
    return np.array([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)])


def unit(w: np.ndarray) -> np.ndarray:
    return w / np.linalg.norm(w, axis=-1, keepdims=True)


def rounded(x) -> np.ndarray:
    """What the device sees of a float64 value."""
    return np.asarray(x, np.float32).astype(float)


def as_seen(mat: dict) -> dict:
    """What the device sees of a material."""
    return {name: rounded(value) if np.ndim(value) else float(rounded(value)) for name, value in mat.items()}


def random_directions(rng: np.random.Generator, n: int, both_sides: bool = False) -> np.ndarray:
    w = rng.normal(size=(n, 3))
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    if not both_sides:
        w[:, 2] = np.abs(w[:, 2])
    return w


# --- the table ---


@dataclass(frozen=True, kw_only=True)
class Example:
    """What the tests of a model go through.

    Attributes:
        materials: at several places of the values' ranges, their ends included; the first is a typical one, off all
            ends, whose lobes are wide.
        more: further materials whose values and derivatives are compared with the twin.
        extremes: materials for which everything is finite, but which the twin does not define.
        eval: ``(material, wi, wo) -> f_s cos``, the twin of the smooth lobes.
        scatter: ``(material, wi, lobe) -> (wo, weight)``, the twin of the delta lobes.
        mitsuba: ``material -> plugin dictionary``; None: Mitsuba's arithmetic does not do.
        mitsuba_wrong: ``(wi, wo) -> bool``: directions for which Mitsuba's value and pdf are wrong.
        mitsuba_pdf: how far Mitsuba's pdf may be from ours, relative.
        lossless: ``material -> bool``: whether it is white in a white furnace once its reflectances are 1, and no
            sample is lost.
        bounded_by: the reflectance that bounds value over pdf; "": none does.
        made: energy that the model makes, at most.
    """

    materials: tuple[dict, ...]
    mitsuba: Callable[[dict], dict | None]
    more: tuple[dict, ...] = ()
    extremes: tuple[dict, ...] = ()
    eval: Callable[[dict, np.ndarray, np.ndarray], np.ndarray] | None = None
    scatter: Callable[[dict, np.ndarray, int], tuple[np.ndarray, np.ndarray]] | None = None
    mitsuba_wrong: Callable[[np.ndarray, np.ndarray], bool] = lambda wi, wo: False
    mitsuba_pdf: float = 2e-3
    lossless: Callable[[dict], bool] = lambda mat: True
    bounded_by: str = ""
    made: float = 0.0


_ROUGH = {
    "materials": (
        rough(0.4, 0.2),
        *(rough(*a) for a in ((MIN_ALPHA, MIN_ALPHA), (1e-4, 1e-4), (0.05, 0.05), (0.3, 0.08), (0.6, 0.6), (0.2, 1.0))),
    ),
    "more": (
        *(rough(*a) for a in ((0.3, 0.2), (1.0, 1.0), (0.9, 0.7), (1e-2, 1e-2), (2e-4, 3e-4), (2e-5, 3e-5))),
        *(rough(0.3, 0.2, m) for m in (MIRROR, LOSSLESS, ((1.5, 1.0, 0.5), (0.0, 0.0, 0.1)))),
        *(rough(a, a, m) for a in (1e-4, 0.05) for m in (MIRROR, ((1.5, 1.0, 0.5), (0.0, 0.0, 0.1)))),
        rough(0.3, 0.2, reflectance=BLACK),
        rough(0.3, 0.2, reflectance=(1.0, 1.0, 1.0)),
    ),
    "extremes": (
        rough(MIN_ALPHA, 1.0),
        rough(0.3, metal=((0.0, 1.0, 1e-4), (0.0, 0.0, 1e-4))),
        rough(0.1, metal=((20.0, 0.0, 1.0), (0.0, 50.0, 0.0)), reflectance=BLACK),
    ),
    # Visible normals leave G_1(wo) F of a sample. A nearly smooth mirror hides nothing.
    "bounded_by": "specular_reflectance",
    "lossless": lambda mat: mat["alpha_u"] == mat["alpha_v"] <= 1e-4,
}
_PLASTIC = {
    "materials": (plastic(1.5), plastic(1.1, BLACK), plastic(1.9, (1.0, 1.0, 1.0), BLACK), plastic(0.7)),
    "more": (plastic(1.0003), plastic(1.5, (1.0, 1.0, 1.0), (1.0, 1.0, 1.0)), plastic(1.5, BLACK, BLACK)),
    "extremes": (plastic(1.0), plastic(0.999999), plastic(1.000001)),
    "scatter": twins.plastic_scatter,
}
_ROUGH_PLASTIC = {
    "materials": (
        *(rough_plastic(1.5, alpha) for alpha in (0.4, 0.1)),
        rough_plastic(1.1, 0.3, BLACK),
        rough_plastic(1.9, 0.25, (1.0, 1.0, 1.0), BLACK),
    ),
    "more": (rough_plastic(1.5, 1e-3), rough_plastic(1.3, 0.03, (1.0, 1.0, 1.0), (1.0, 1.0, 1.0))),
    "extremes": (rough_plastic(1.0, 0.3), rough_plastic(0.999999, 0.3), rough_plastic(1.000001, MIN_ALPHA)),
    "lossless": lambda mat: False,
}

_ROUGH_GLASS = {
    "materials": (
        rough_glass(1.5, 0.4, 0.2),
        *(rough_glass(ior, alpha) for ior, alpha in ((1.5, 0.1), (1.1, 0.3), (0.7, 0.25), (2.4, 1e-2), (1.5, 1e-3))),
    ),
    "more": (rough_glass(1.5, 0.3, reflectance=BLACK, transmittance=BLACK),),
    "extremes": (rough_glass(1.0, 0.3), rough_glass(0.999999, MIN_ALPHA), rough_glass(1.001, MIN_ALPHA, 1.0)),
    "lossless": lambda mat: mat["alpha_u"] == mat["alpha_v"] <= 1e-3,
}

#: Key of ``VARIANTS`` -> what its tests go through.
EXAMPLES: dict[str, Example] = {
    "diffuse": Example(
        materials=tuple(material(reflectance=c) for c in ((0.2, 0.5, 0.8), BLACK, (1.0, 1.0, 1.0))),
        eval=twins.diffuse_eval,
        mitsuba=lambda mat: {"type": "diffuse", **rgb(mat, "reflectance")},
        bounded_by="reflectance",
    ),
    "conductor": Example(
        materials=(metal(), metal(MIRROR), metal(LOSSLESS), metal(reflectance=BLACK), metal(MIRROR, (1.0, 1.0, 1.0))),
        extremes=(metal(((0.0, 1.0, 1e-4), (0.0, 0.0, 1e-4))), metal(((20.0, 0.0, 1.0), (0.0, 50.0, 0.0)), BLACK)),
        scatter=twins.conductor_scatter,
        mitsuba=lambda mat: {"type": "conductor", **rgb(mat, "specular_reflectance", "eta", "k")},
    ),
    "dielectric": Example(
        materials=tuple(glass(ior) for ior in (1.5, 0.7, 1.0, 1.001, 1.0001, 2.4)),
        more=(glass(1.5, BLACK, BLACK),),
        extremes=tuple(glass(ior) for ior in (0.5, 0.999999, 1.000001, 4.0)),
        scatter=twins.dielectric_scatter,
        mitsuba=mitsuba_dielectric,
    ),
    GGX: Example(eval=twins.ggx_eval, mitsuba=lambda mat: mitsuba_rough(mat, "ggx"), **_ROUGH),
    BECKMANN: Example(
        eval=twins.beckmann_eval,
        mitsuba=lambda mat: mitsuba_rough(mat, "beckmann"),
        # Mitsuba's pdf takes a rational fit of the masking, ours the exact one.
        mitsuba_pdf=1e-2,
        **_ROUGH,
    ),
    "plastic": Example(eval=twins.plastic_eval, mitsuba=lambda mat: mitsuba_plastic(mat, False), **_PLASTIC),
    "plastic (nonlinear)": Example(
        eval=twins.nonlinear_plastic_eval, mitsuba=lambda mat: mitsuba_plastic(mat, True), **_PLASTIC
    ),
    **{
        f"roughplastic ({distribution}{' nonlinear' if nonlinear else ''})": Example(
            eval=functools.partial(twins.rough_plastic_eval, distribution=distribution, nonlinear=nonlinear),
            mitsuba=functools.partial(mitsuba_rough_plastic, distribution=distribution, nonlinear=nonlinear),
            mitsuba_pdf=1e-2 if distribution == "beckmann" else 2e-3,
            **_ROUGH_PLASTIC,
        )
        for distribution in ("ggx", "beckmann")
        for nonlinear in (False, True)
    },
    **{
        f"roughdielectric ({distribution})": Example(
            eval=functools.partial(twins.rough_dielectric_eval, distribution=distribution),
            mitsuba=functools.partial(mitsuba_rough_glass, distribution=distribution),
            mitsuba_pdf=1e-2 if distribution == "beckmann" else 2e-3,
            **_ROUGH_GLASS,
        )
        for distribution in ("ggx", "beckmann")
    },
    "thindielectric": Example(
        materials=tuple(glass(ior) for ior in (1.5, 0.7, 1.0, 1.001, 2.4)),
        more=(glass(1.5, BLACK, BLACK),),
        extremes=tuple(glass(ior) for ior in (0.5, 0.999999, 1.000001, 4.0)),
        scatter=twins.thindielectric_scatter,
        mitsuba=lambda mat: mitsuba_dielectric(mat, "thindielectric"),
    ),
    "null": Example(materials=(material(),), scatter=twins.null_scatter, mitsuba=lambda mat: {"type": "null"}),
    "principled": Example(**PRINCIPLED),
    "principled (spec_trans)": Example(**TRANSMITTING),
    "principledthin": Example(**THIN),
    "ashikhminshirley": Example(
        materials=tuple(
            material(reflectance=(0.2, 0.5, 0.8), specular_reflectance=(0.3, 0.2, 0.1), nu=nu, nv=nv)
            for nu, nv in ((12.0, 8.0), (40.0, 10.0), (0.5, 0.7))
        ),
        more=(
            material(reflectance=BLACK, specular_reflectance=(1.0, 1.0, 1.0), nu=10.0, nv=10.0),
            material(reflectance=(1.0, 1.0, 1.0), specular_reflectance=BLACK, nu=0.0, nv=20.0),
            material(reflectance=BLACK, specular_reflectance=(0.9, 0.6, 0.3), nu=3e4, nv=9e4),
        ),
        eval=twins.ashikhmin_shirley_eval,
        mitsuba=lambda mat: None,
        lossless=lambda mat: False,
    ),
    "abc": Example(
        materials=tuple(abc(*a) for a in ((0.6, 30.0, 1.5), (0.1, 4.0, 1.0), (3.0, 200.0, 3.0))),
        more=(
            *(
                abc(*a)
                for a in ((0.0, 30.0, 1.5), (0.05, 0.0, 2.0), (0.05, 10.0, 0.0), (50.0, 1e3, 0.7), (9e3, 1e6, 2.0))
            ),
            abc(0.6, 30.0, 1.5, MIRROR, BLACK),
        ),
        eval=twins.abc_eval,
        mitsuba=lambda mat: None,
        lossless=lambda mat: False,
    ),
    "orennayar": Example(
        materials=tuple(material(reflectance=(0.2, 0.5, 0.8), sigma=s) for s in (0.5, 1.2)),
        more=(material(reflectance=(1.0, 1.0, 1.0), sigma=0.0), material(reflectance=BLACK, sigma=0.3)),
        eval=twins.oren_nayar_eval,
        mitsuba=lambda mat: None,
        lossless=lambda mat: mat["sigma"] == 0.0,
    ),
}


def values_of(key: str) -> tuple[Value, ...]:
    """What a material gives; its tables follow from that."""
    return tuple(value for value in declaration_of(key)[0].values if not value.size)


def lobes_of(key: str) -> tuple[int, ...]:
    """The delta lobes of a model."""
    return tuple(lobe for lobe in declaration_of(key)[0].lobes if lobe != LOBE_SMOOTH)


def transmits(key: str) -> bool:
    """Whether light passes the surface in a delta lobe."""
    return declaration_of(key)[0].transmits


def passes(key: str) -> bool:
    """Whether light passes the surface in a smooth lobe."""
    return declaration_of(key)[0].passes


def reflectances(key: str) -> list[str]:
    """Names of the values that are shares of light."""
    return [value.name for value in values_of(key) if value.color and value.high == 1.0]


def is_black(key: str, mat: dict) -> bool:
    names = reflectances(key)
    return bool(names) and all(mat[name].max() == 0.0 for name in names)


def white(key: str, mat: dict) -> dict:
    """The material that absorbs nothing where its lobes are."""
    out = mat | {name: np.ones(3) for name in reflectances(key)}
    metal = {value.name: value for value in ComplexIndex().values}
    indices = {"eta": np.array(MIRROR[0]), "k": np.array(MIRROR[1])}
    return out | {name: indices[last] for name in mat for last in metal if last in bare({name: 0})}


def corners(key: str) -> list[dict]:
    """Materials at all combinations of the ends of the values' ranges, of many values at some; no end stops at 50.

    Of nested models those of the children, side by side, at both ends of the weight. Indices of refraction lie between
    0.5 and 3: above 3.8 the fit of ``mean_reflectance`` exceeds 1.
    """
    if key in NESTED_MODELS:
        children = [corners(child) for child in split_key(key)[2]]
        if len(children) == 2:
            both = [{"first": m, "second": children[1][i % len(children[1])]} for i, m in enumerate(children[0])]
            return [nest(weight=w, **pair) for pair in both for w in (0.0, 1.0)]
        own = (*EXAMPLES[key].materials, *EXAMPLES[key].extremes)
        return [mat | nest(nested=m) for mat in own for m in children[0]]
    ends = []
    for value in values_of(key):
        high = value.high if np.isfinite(value.high) else 50.0
        low, high = (0.5, 3.0) if value.name == "ior" else (value.low, high)
        ends.append([np.full(3, end) if value.color else end for end in (low, high)])
    names = [value.name for value in values_of(key)]
    few = len(names) < 9
    picks = itertools.product((0, 1), repeat=len(names)) if few else np.random.default_rng(0).integers(2, size=(64, 99))
    return [{name: end[i] for name, end, i in zip(names, ends, pick, strict=False)} for pick in picks]


def energy_of(mat: dict, wi: np.ndarray, lobe: int, value: np.ndarray) -> np.ndarray:
    """Energy of a delta lobe with a weight: radiance that crosses an interface is scaled, its energy is not."""
    return value * index_behind(mat, wi) ** 2 if lobe == LOBE_DELTA_TRANSMISSION else value


EXAMPLES |= nested_examples(Example, EXAMPLES)
EXAMPLES = {key: EXAMPLES[key] for key in ALL_MODELS}


# --- launches ---


class Launcher:
    """The functions of a set of models over NumPy arrays; directions are (N, 3) or (3,), broadcast.

    Models that are not among them are compiled with the other nested ones.
    """

    def __init__(self, device: str, models: tuple[str, ...] = PLAIN_MODELS):
        self.device = device
        self.models = models

    def set_of(self, key: str) -> tuple[str, ...]:
        """The models that this one is compiled with."""
        return self.models if key in self.models else NESTED_MODELS

    def eval_pdf(self, key: str, mat: dict, wi, wo) -> tuple[np.ndarray, np.ndarray]:
        wi, wo = self._vectors(wi, wo)
        value = wp.empty(len(wi), dtype=wp.vec3, device=self.device)
        pdf = wp.empty(len(wi), dtype=wp.float32, device=self.device)
        self._launch("eval", key, mat, [wi, wo], [value, pdf])
        return value.numpy().astype(float), pdf.numpy().astype(float)

    def sample(self, key: str, mat: dict, wi, uvw) -> np.ndarray:
        wi, uvw = self._vectors(wi, uvw)
        return self._structs("sample", BsdfSample, key, mat, [wi, uvw])

    def eval_vjp(self, key: str, mat: dict, wi, wo, w) -> np.ndarray:
        wi, wo = self._vectors(wi, wo)
        return self._structs("eval_vjp", functions_of(self.set_of(key)).adjoint, key, mat, [wi, wo, wp.vec3(*w)])

    def scatter(self, key: str, mat: dict, wi, lobe: int) -> np.ndarray:
        return self._structs("scatter", Scattered, key, mat, [*self._vectors(wi), lobe])

    def scatter_vjp(self, key: str, mat: dict, wi, lobe: int, w, a_wo) -> np.ndarray:
        inputs = [*self._vectors(wi), lobe, wp.vec3(*w), wp.vec3(*a_wo)]
        return self._structs("scatter_vjp", functions_of(self.set_of(key)).adjoint, key, mat, inputs)

    def _vectors(self, *arrays) -> list[wp.array]:
        broadcast = np.broadcast_arrays(*(np.atleast_2d(a) for a in arrays))
        return [wp.array(np.ascontiguousarray(a, np.float32), dtype=wp.vec3, device=self.device) for a in broadcast]

    def _structs(self, name: str, dtype, key: str, mat: dict, inputs: list) -> np.ndarray:
        out = wp.empty(inputs[0].shape, dtype=dtype, device=self.device)
        self._launch(name, key, mat, inputs, [out])
        return out.numpy()

    def _launch(self, name: str, key: str, mat: dict, inputs: list, outputs: list) -> None:
        models = self.set_of(key)
        m = functions_of(models).record()
        for value in values_of(key):
            setattr(m, value.name, wp.vec3(*mat[value.name]) if value.color else float(mat[value.name]))
        declared, variant = declaration_of(key)
        tables = []  # held until the launch is over
        for table in declared.tables(variant):
            numbers = MAKERS[table.maker](table.variant, *(float(rounded(mat[name])) for name in table.of))
            tables.append(wp.array(numbers, dtype=wp.float32, device=self.device))
            setattr(m, table.name, tables[-1].ptr)
        model, dim = models.index(key), inputs[0].shape
        wp.launch(make_kernels(models)[name], dim=dim, inputs=[model, m, *inputs], outputs=outputs, device=self.device)
        if tables:
            wp.synchronize_device(self.device)


def members(adjoint: np.ndarray) -> list[str]:
    """Names of a material's values in an adjoint, without those of tables."""
    dtype = adjoint["material"].dtype
    return [name for name in dtype.names if dtype[name].base.kind == "f"]


def all_finite(adjoint: np.ndarray) -> bool:
    """Whether nothing of a partial derivative is infinite or no number."""
    fields = [adjoint["material"][name] for name in members(adjoint)] + [adjoint["wi"], adjoint["wo"]]
    return all(np.all(np.isfinite(x)) for x in fields)


def uniform(seed: int, n: int) -> np.ndarray:
    return np.random.default_rng(seed).random((n, 3), dtype=np.float32)


def delta_samples(bsdf: Launcher, key: str, mat: dict, wi: np.ndarray, uvw: np.ndarray) -> dict[int, np.ndarray]:
    """Samples of each delta lobe."""
    s = bsdf.sample(key, mat, wi, uvw)
    return {lobe: s[s["lobe"] == lobe] for lobe in lobes_of(key)}
