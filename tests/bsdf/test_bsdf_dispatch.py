"""Dispatch over the scattering models: it changes no bit, and compiles nothing of models that a scene has not."""

from pathlib import Path

import numpy as np
import pytest
import warp as wp

from tests.bsdf.helpers import (
    ALL_MODELS,
    EXAMPLES,
    GGX,
    Launcher,
    lobes_of,
    make_kernels,
    members,
    random_directions,
    values_of,
)
from warp_psdr.kernels.bsdf.dispatch import declaration_of, make_bsdf
from warp_psdr.kernels.constants import LOBE_DELTA_REFLECTION

#: Models whose dispatch is checked in every run of the tests; the others' kernels are compiled in slow ones.
FEW_KERNELS = ("diffuse", GGX, "plastic")


@pytest.fixture
def bsdf(device: str) -> Launcher:
    return Launcher(device)


#: Warp warns that the library is bound to this processor; only its source is read.
ignore_native = pytest.mark.filterwarnings("ignore:compile_aot_module")


def generated_source(models: tuple[str, ...], folder: Path) -> str:
    for kernel in make_kernels(models).values():
        wp.compile_aot_module(kernel.module, device="cpu", module_dir=folder)
    return "".join(path.read_text() for path in folder.glob("*.cpp")).lower()


@ignore_native
def test_one_model_compiles_nothing_of_the_others(tmp_path: Path) -> None:
    source = generated_source(("diffuse",), tmp_path)
    assert "diffuse_eval" in source and "diffuse_sample" in source
    for other in ("microfacet", "ggx", "beckmann", "dielectric", "conductor", "plastic", "fresnel", "alpha", "delta_"):
        assert other not in source
    # Nor is there anything to choose from.
    assert "var_model ==" not in source and "var_model !=" not in source


@ignore_native
def test_one_distribution_compiles_nothing_of_the_other(tmp_path: Path) -> None:
    source = generated_source((GGX,), tmp_path)
    assert "ggx_ndf" in source and "beckmann" not in source and "diffuse" not in source


@pytest.mark.parametrize("models", [("diffuse",), ("conductor", "dielectric"), ALL_MODELS], ids=str)
def test_lobes_are_known_by_the_number_of_a_model(models: tuple[str, ...], device: str) -> None:
    f = make_bsdf(models)

    @wp.kernel(module="unique", enable_backward=False)
    def ask(
        smooth_out: wp.array(dtype=wp.bool),
        delta_out: wp.array(dtype=wp.bool),
        transmits_out: wp.array(dtype=wp.bool),
        null_out: wp.array(dtype=wp.bool),
        mirrors_out: wp.array(dtype=wp.bool),
    ):
        model = wp.tid()
        smooth_out[model] = f.has_smooth(model)
        delta_out[model] = f.has_delta(model)
        transmits_out[model] = f.transmits(model)
        null_out[model] = f.has_null(model)
        mirrors_out[model] = f.mirrors(model)

    answers = [wp.empty(len(models), dtype=wp.bool, device=device) for _ in range(5)]
    wp.launch(ask, len(models), [], answers, device=device)
    declared = [declaration_of(key)[0] for key in models]
    asked = ("has_smooth", "has_delta", "transmits", "has_null", "mirrors")
    expected = [[getattr(m, name) for m in declared] for name in asked]
    assert [answer.numpy().tolist() for answer in answers] == expected


def test_functions_that_no_model_provides_are_absent() -> None:
    smooth, delta = make_bsdf(("diffuse", GGX)), make_bsdf(("conductor", "dielectric"))
    assert smooth.scatter is None and smooth.scatter_vjp is None
    assert delta.eval is None and delta.pdf is None and delta.eval_vjp is None


@pytest.mark.parametrize(
    "key", [pytest.param(key, marks=[] if key in FEW_KERNELS else [pytest.mark.slow]) for key in ALL_MODELS]
)
def test_dispatch_changes_no_bit(bsdf: Launcher, device: str, key: str) -> None:
    wi, wo = (random_directions(np.random.default_rng(13), 50) for _ in range(2))
    mat, w = EXAMPLES[key].materials[0], (0.3, 0.5, 0.7)
    alone = Launcher(device, (key,))
    if declaration_of(key)[0].has_smooth:
        for mine, other in zip(bsdf.eval_pdf(key, mat, wi, wo), alone.eval_pdf(key, mat, wi, wo), strict=True):
            require_equal(device, mine, other)
        equal_adjoints(key, device, *(f.eval_vjp(key, mat, wi, wo, w) for f in (bsdf, alone)))
    else:
        value, pdf = bsdf.eval_pdf(key, mat, wi, wo)
        assert np.all(value == 0.0) and np.all(pdf == 0.0)
    for lobe in lobes_of(key):
        require_equal(device, *(f.scatter(key, mat, wi, lobe) for f in (bsdf, alone)))
        equal_adjoints(key, device, *(f.scatter_vjp(key, mat, wi, lobe, w, w) for f in (bsdf, alone)))
    if not lobes_of(key):
        assert np.all(bsdf.scatter(key, mat, wi, LOBE_DELTA_REFLECTION)["value"] == 0.0)


def require_equal(device: str, mine: np.ndarray, other: np.ndarray, name: str = "") -> None:
    """Require equal bits; on CUDA, whose compiler fuses products and sums by what stands beside them, equal numbers."""
    if mine.dtype.names:
        for member in mine.dtype.names:
            require_equal(device, mine[member], other[member], member)
    elif device == "cpu":
        np.testing.assert_array_equal(mine, other, err_msg=name)
    else:
        np.testing.assert_allclose(mine, other, rtol=1e-5, atol=1e-6 * np.abs(other).max(), err_msg=name)


def equal_adjoints(key: str, device: str, mine: np.ndarray, other: np.ndarray) -> None:
    """Require equal derivatives, and none by a value that the model does not declare."""
    own = [value.name for value in values_of(key)]
    for name in members(mine):
        expected = other["material"][name] if name in own else np.zeros_like(mine["material"][name])
        require_equal(device, mine["material"][name], expected, name)
    for name in ("wi", "wo"):
        require_equal(device, mine[name], other[name], name)


@pytest.mark.parametrize("models", [(), ("conductor", "diffuse"), ("diffuse", "diffuse"), ("phong",), (0,)], ids=str)
def test_bad_model_sets_are_named(models: tuple) -> None:
    with pytest.raises(ValueError, match="each once and in this order"):
        make_bsdf(models)


@pytest.mark.slow
def test_all_models_compile_for_cuda(tmp_path: Path) -> None:
    for kernel in make_kernels(ALL_MODELS).values():
        assert wp.compile_aot_module(kernel.module, arch=90, module_dir=tmp_path)
