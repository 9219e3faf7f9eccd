"""The two traps of Warp 1.19 that ``kernels/autodiff.py`` is there for, and that no kernel falls into them.

What Warp has built once in a process, or finds in its kernel cache, keeps the adjoints that it got then; so the first
trap is looked for in processes of their own, with an empty cache, in the source that was really compiled.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from tests.gradients import scenes
from warp_psdr.kernels.autodiff import anchor, differentiable

EMPTY = "reverse mode disabled"
ROOT = Path(__file__).resolve().parents[1]
#: Seconds; a compiler that hangs, not one that is slow.
PATIENCE = 500

#: Three nested functions, built for their value first; then the outermost is differentiated. In 1.19 ``wp.grad`` asks
#: for the adjoints of a function and of its direct callees, but not for those of callees that were built before. Once
#: with the mark, once without, in kernels of their own.
NESTED = """
import warp as wp
from warp_psdr.kernels.autodiff import differentiable

wp.config.log_level = wp.LOG_WARNING
found = []
"""
NESTED_ONCE = """
@wp.func
def {name}_leaf(a: wp.float32) -> wp.float32:
    return a * a * a

@wp.func
def {name}_inner(a: wp.float32) -> wp.float32:
    return 2.0 * {name}_leaf(a)

{mark}
@wp.func
def {name}_outer(a: wp.float32) -> wp.float32:
    return {name}_inner(a) + 0.0 * a

@wp.kernel(module="unique", enable_backward=False)
def {name}(a: wp.float32, out: wp.array(dtype=wp.float32)):
    out[0] = {name}_outer(a)
    out[1] = wp.grad({name}_outer)(a)

out = wp.zeros(2, dtype=wp.float32, device="cpu")
wp.launch({name}, dim=1, inputs=[3.0, out], device="cpu")
found += list(out.numpy())
print(*found)
"""

#: Reverse and forward mode of everything that a scene has; prints the sum of all gradients' magnitudes.
RENDERED = """
import numpy as np
import warp as wp
import warp_psdr.kernels.autodiff as autodiff
if {unmarked}:
    autodiff.differentiable = lambda f: f
import warp_psdr as psdr
from tests.gradients import scenes

wp.config.log_level = wp.LOG_WARNING
scene, params = scenes.load({scene!r})
names = {names!r} or list(params)
integrator = psdr.PathIntegrator(max_depth=3, boundary=None)
params.requires_grad(*names)
psdr.render_backward(scene, params, np.ones((scenes.SIZE, scenes.SIZE, 3), np.float32), spp=1, integrator=integrator)
psdr.render_forward(scene, params, dict.fromkeys(names, 1.0), spp=1, integrator=integrator)
print(sum(float(np.abs(params[n].grad.numpy()).sum()) for n in names))
"""


def run_alone(script, folder):
    """Run a script in a process of its own; return the numbers of its last line and the C++ source it compiled."""
    folder.mkdir()
    (folder / "script.py").write_text(script)
    environment = os.environ | {"WARP_CACHE_PATH": str(folder / "cache"), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(folder / "script.py")]
    result = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment, timeout=PATIENCE)
    assert result.returncode == 0, result.stderr
    sources = [path.read_text() for path in (folder / "cache").rglob("*.cpp")]
    return [float(v) for v in result.stdout.splitlines()[-1].split()], sources


def adjoints(source):
    """Names of the adjoint functions that are called and have a body, and of those that are called and are empty."""
    # Warp emits "static void adj_NAME(parameters) { body }", and calls "adj_NAME(arguments);" inside bodies.
    bodies = {}
    for match in re.finditer(r"^static [^\n]*\b(adj_\w+)\($", source, flags=re.MULTILINE):
        end = source.find("\n}", match.end())
        bodies[match.group(1)] = bodies.get(match.group(1), "") + source[match.end() : end]
    calls = set(re.findall(r"^\s+(adj_\w+)\(", source, flags=re.MULTILINE)) & bodies.keys()
    empty = {name for name in calls if EMPTY in bodies[name]}
    return calls - empty, empty


@pytest.mark.slow
def test_a_callee_that_was_built_for_its_value_keeps_its_derivative_by_the_mark(tmp_path):
    # Without the mark it is silently lost: the reason for ``differentiable``, and the proof that the search finds the
    # trap. Where the last line fails, Warp has repaired it and the mark may go.
    kernels = {"marked": "@differentiable", "unmarked": ""}
    script = NESTED + "".join(NESTED_ONCE.format(name=name, mark=mark) for name, mark in kernels.items())
    numbers, sources = run_alone(script, tmp_path / "run")
    assert numbers == [54.0, 54.0, 54.0, 0.0]
    full, empty = (set().union(*sets) for sets in zip(*map(adjoints, sources), strict=True))
    assert "adj_marked_leaf_0" in full and not any("_marked" in name for name in empty)
    assert any("_unmarked" in name for name in empty)


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

    out = wp.zeros(2, dtype=wp.float32, device="cpu")
    wp.launch(kernel, dim=1, inputs=[3.0, out], device="cpu")
    np.testing.assert_allclose(out.numpy(), [6.0, 3.0])


FAST = ("rough",)


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n in FAST else pytest.mark.slow) for n in scenes.SCENES])
def test_no_compiled_kernel_calls_an_empty_adjoint(name, tmp_path):
    numbers, sources = run_alone(RENDERED.format(unmarked=False, scene=name, names=[]), tmp_path / "run")
    assert numbers[0] > 0.0
    differentiated = [source for source in sources if adjoints(source)[0]]
    # Reverse and forward mode; otherwise the search looked at nothing.
    assert len(differentiated) >= 2
    assert [adjoints(source)[1] for source in sources if adjoints(source)[1]] == []


@pytest.mark.slow
def test_kernels_lose_derivatives_without_the_mark(tmp_path):
    names = ["floor.bsdf.alpha.value"]
    lost, sources = run_alone(RENDERED.format(unmarked=True, scene="rough", names=names), tmp_path / "unmarked")
    assert lost == [0.0]
    assert any(adjoints(source)[1] for source in sources)
    kept, _sources = run_alone(RENDERED.format(unmarked=False, scene="rough", names=names), tmp_path / "marked")
    assert kept[0] > 1.0
