"""The two traps of Warp 1.19 that ``kernels/autodiff.py`` is there for, and that no kernel falls into them."""

import re

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.gradients import scenes
from warp_psdr.kernels.autodiff import anchor, differentiable
from warp_psdr.kernels.interior.replay import make_replay_kernel

EMPTY = "reverse mode disabled"


def nested_pair(mark):
    """A kernel that builds ``outer`` for its value first and differentiates it afterwards; ``mark`` decorates it."""

    @wp.func
    def inner(a: wp.float32) -> wp.float32:
        return a * a * a

    @mark
    @wp.func
    def outer(a: wp.float32) -> wp.float32:
        return inner(a) + 0.0 * a

    @wp.func
    def value_first(a: wp.float32) -> wp.float32:
        return outer(a)

    @wp.kernel(module="unique", enable_backward=False)
    def both(a: wp.float32, out: wp.array(dtype=wp.float32)):
        out[0] = value_first(a)
        out[1] = wp.grad(outer)(a)

    return both


def run(kernel, *inputs, size=2):
    out = wp.zeros(size, dtype=wp.float32, device="cpu")
    wp.launch(kernel, dim=1, inputs=[*inputs, out], device="cpu")
    return out.numpy()


def test_a_callee_that_was_built_for_its_value_keeps_its_derivative():
    np.testing.assert_allclose(run(nested_pair(differentiable), 3.0), [27.0, 27.0])


def test_without_the_mark_the_derivative_is_silently_lost():
    # The reason for ``differentiable``. Where this fails, Warp has repaired it and the mark may go.
    value, derivative = run(nested_pair(lambda f: f), 3.0)
    assert value == 27.0
    assert derivative == 0.0


def test_the_mark_reaches_the_whole_call_tree():
    @wp.func
    def leaf(a: wp.float32) -> wp.float32:
        return wp.sin(a)

    @wp.func
    def middle(a: wp.float32) -> wp.float32:
        return leaf(a) * 2.0

    @differentiable
    @wp.func
    def top(a: wp.float32) -> wp.float32:
        return middle(a)

    assert all(f.adj.force_adjoint_codegen for f in (top, middle, leaf))


def test_the_anchor_is_the_identity_and_moves_its_caller_behind_what_it_calls():
    @wp.func
    def square(a: wp.float32) -> wp.float32:
        return a * a

    @wp.func
    def slope(a: wp.float32) -> wp.float32:
        return wp.grad(square)(a)

    @wp.func
    def caller(a: wp.float32) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)
        return slope(a)

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(a: wp.float32, out: wp.array(dtype=wp.float32)):
        out[0] = caller(a)
        out[1] = anchor(a)

    np.testing.assert_allclose(run(kernel, 3.0), [6.0, 3.0])


# -- generated code ----------------------------------------------------------------------------------------------------


def empty_adjoints_that_are_called(source):
    """Names of adjoint functions with an empty body that some other function calls."""
    # Adjoints are emitted as "static void adj_NAME(parameters) { body }", calls as "adj_NAME(arguments);".
    bodies = {}
    for match in re.finditer(r"^static [^\n]*\b(adj_\w+)\($", source, flags=re.MULTILINE):
        end = source.find("\n}", match.end())
        bodies.setdefault(match.group(1), "")
        bodies[match.group(1)] += source[match.end() : end]
    assert bodies, "no adjoint function found; has the form of the generated code changed?"
    empty = {name for name, body in bodies.items() if EMPTY in body}
    calls = set(re.findall(r"^\s+(adj_\w+)\(", source, flags=re.MULTILINE))
    return sorted(empty & calls), bodies, calls


def source_of(kernel, folder):
    """The C++ source that Warp generates for a kernel's module."""
    wp.compile_aot_module(kernel.module, device="cpu", module_dir=folder)
    return "\n".join(path.read_text() for path in folder.glob("*.cpp"))


def test_the_search_finds_the_trap(tmp_path):
    bad, _, _ = empty_adjoints_that_are_called(source_of(nested_pair(lambda f: f), tmp_path / "bad"))
    assert any("inner" in name for name in bad)
    good, _, _ = empty_adjoints_that_are_called(source_of(nested_pair(differentiable), tmp_path / "good"))
    assert not good


FAST = ("gap",)


@pytest.mark.parametrize("role", ["reverse", "forward"])
@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n in FAST else pytest.mark.slow) for n in scenes.SCENES])
def test_no_replay_kernel_calls_an_empty_adjoint(name, role, tmp_path):
    scene, params = scenes.load(name)
    plan = psdr.plan(scene, names=list(params), integrator=psdr.PathIntegrator(max_depth=3, boundary=None))
    kernel = gradient_kernel(plan, role)
    bad, bodies, calls = empty_adjoints_that_are_called(source_of(kernel, tmp_path))
    assert not bad
    # What is differentiated is called, with a body; otherwise the search looked at nothing.
    assert len(calls & bodies.keys()) > 5


def gradient_kernel(plan, role):
    """The kernel that render_backward or render_forward launches."""
    import sys

    render = sys.modules["warp_psdr.render"]
    if hasattr(render, "_gradient_kernel"):
        return render._gradient_kernel(plan, role)
    return make_replay_kernel(plan.config, plan.wanted, role, plan.block, plan.blocks)
