"""Scenes without media: nothing of their device code is that of media. Sources are generated, not compiled."""

import pytest

import warp_psdr as psdr
from tests.gradients import scenes
from tests.gradients.configs import TOGETHER
from tests.media.scenes import blended_by_grids
from tests.plan.generated import generated
from warp_psdr.estimate import passes

INTEGRATOR = psdr.PathIntegrator(max_depth=4, boundary=None)
OF_MEDIA = ("warp_psdr.kernels.medium.", "warp_psdr.kernels.phase.")
NAMES = ["gap", "sunny", "glass", "plane, lens", "projected", "checkered", "mirror", "rough window", "principled glass"]
NAMES += ["instanced", "leaf", "bumped"]
FAST = ("gap",)


def modules_of(kernel):
    """Names of the modules that define functions and structs in a kernel's source."""
    builder, source = generated(kernel)
    functions = [f for f in builder.functions if f.func is not None]
    assert len(functions) > 50 and all(f.native_func in source for f in functions)
    return {f.func.__module__ for f in functions} | {s.cls.__module__ for s in builder.structs}


def of_media(modules):
    return sorted(name for name in modules if name.startswith(OF_MEDIA))


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n not in FAST)) for n in NAMES])
def test_images_and_gradients_hold_no_code_of_media(name):
    scene, params = scenes.load(name)
    params.requires_grad_only(*TOGETHER[name])
    plan = psdr.plan(scene, names=params.requested, integrator=INTEGRATOR)
    assert plan.config.media is None
    for kernel in (passes.image_kernel(scene, plan, 0), passes.camera_gradient_kernels(plan, "reverse")[0]):
        modules = modules_of(kernel)
        assert "warp_psdr.kernels.path" in modules and of_media(modules) == []


def test_the_search_finds_media():
    scene = psdr.load_dict(blended_by_grids())
    found = of_media(modules_of(passes.image_kernel(scene, psdr.plan(scene, integrator=INTEGRATOR), 0)))
    for part in ("medium.flight", "medium.volume", "phase.blendphase", "phase.tabphase"):
        assert f"warp_psdr.kernels.{part}" in found
