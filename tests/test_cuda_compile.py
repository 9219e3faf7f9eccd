"""Every kernel of the library compiles for CUDA, on a machine without a GPU.

The kernels are discovered: those at module level join by themselves, and a factory (a function that defines a kernel)
that is not listed in ``cuda_factories.py`` fails ``test_every_factory_is_listed``.
"""

import ast
import functools
import importlib
import pkgutil
from pathlib import Path

import pytest
import warp as wp

import warp_psdr.kernels
from tests.cuda_factories import FACTORIES, FOR_FILMS, MADE_BY

#: Compute capability 9.0.
ARCHITECTURE = 90
#: Factories of kernels that run on the CPU only, and why.
CPU_ONLY = {
    "boundary.path_space.crossing.make_crossing_packets": "the wide BVH is a CPU structure",
    "bvh.build.make_build": "the wide BVH is a CPU structure; wp.Mesh traces on CUDA",
    "bvh.refit.make_refit": "the wide BVH is a CPU structure; wp.Mesh traces on CUDA",
    "interior.replay._make_lane_kernel": "paths side by side are for SIMD; make_replay_kernel has one a thread on CUDA",
    "interior.forward_lanes.make_lane_forward_kernel": "the same, of make_forward_kernel",
}


def device_modules():
    """Import every module of the device code and return {dotted name within it: module}."""
    package = warp_psdr.kernels
    names = [m.name for m in pkgutil.walk_packages(package.__path__, package.__name__ + ".")]
    assert len(names) > 30, f"only {names} found"
    return {name.removeprefix(package.__name__ + "."): importlib.import_module(name) for name in names}


@functools.cache
def module_kernels():
    """Kernels defined at module level: (dotted name, kernel)."""
    found = {}
    for name, module in device_modules().items():
        for key, value in vars(module).items():
            if isinstance(value, wp.Kernel) and value.func.__module__ == module.__name__:
                found[f"{name}.{key}"] = value
    return found


def is_kernel(node):
    """Whether a function is decorated with ``wp.kernel`` (``@wp.kernel`` or ``@wp.kernel(...)``)."""
    decorators = [d.func if isinstance(d, ast.Call) else d for d in node.decorator_list]
    return any(ast.unparse(d) in ("wp.kernel", "warp.kernel", "kernel") for d in decorators)


def factories():
    """Top-level functions that define kernels, by dotted name, and the number of kernels at module level."""
    found, plain = set(), 0
    for name, module in device_modules().items():
        for node in ast.parse(Path(module.__file__).read_text(encoding="utf-8")).body:
            if isinstance(node, ast.FunctionDef):
                plain += is_kernel(node)
                if any(isinstance(n, ast.FunctionDef) and n is not node and is_kernel(n) for n in ast.walk(node)):
                    found.add(f"{name}.{node.name}")
    return found, plain


@pytest.fixture(scope="module")
def compile_for_cuda(tmp_path_factory):
    """Return ``compile(kernel)``; skip, saying so, where Warp was built without the CUDA compiler."""
    folder = tmp_path_factory.mktemp("cuda")

    @wp.kernel(module="unique", enable_backward=False)
    def probe(values_out: wp.array(dtype=wp.float32)):
        values_out[wp.tid()] = 1.0

    @functools.cache  # kernels share modules
    def compile_module(module):
        files = wp.compile_aot_module(module, arch=ARCHITECTURE, module_dir=folder)
        outputs = [Path(f) for f in files if Path(f).suffix in (".ptx", ".cubin")]
        assert outputs and all(f.stat().st_size > 0 for f in outputs), f"no CUDA code among {files}"
        return outputs

    def compile_kernel(kernel):
        return compile_module(kernel.module)

    try:
        compile_kernel(probe)
    except RuntimeError as error:
        pytest.skip(f"this build of Warp cannot compile for CUDA (NVRTC): {error}")
    return compile_kernel


def test_every_factory_is_listed():
    """A new factory of kernels has to say in ``cuda_factories.py`` with which arguments it is compiled."""
    found, plain = factories()
    assert found == set(FACTORIES) - set(MADE_BY) | set(MADE_BY.values()) | set(CPU_ONLY) | FOR_FILMS
    assert plain == len(module_kernels()) > 0


@pytest.mark.parametrize("name", sorted(module_kernels()))
def test_kernel_compiles(name, compile_for_cuda):
    compile_for_cuda(module_kernels()[name])


@pytest.mark.slow_rows("make_primary_kernel-reverse, simple", "make_replay_kernel-simple")
@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        pytest.param(name, arguments, marks=marks, id=f"{name.rpartition('.')[2]}-{label}")
        for name, variants in FACTORIES.items()
        for label, arguments, marks in variants
    ],
)
def test_factory_compiles(name, arguments, compile_for_cuda):
    module, _, factory = name.rpartition(".")
    made = getattr(importlib.import_module(f"warp_psdr.kernels.{module}"), factory)(*arguments)
    kernels = [k for k in (made if isinstance(made, tuple) else (made,)) if isinstance(k, wp.Kernel)]
    assert kernels
    for kernel in kernels:
        compile_for_cuda(kernel)


def test_device_errors_are_found(compile_for_cuda):
    """What compiles for the CPU only does fail here."""

    @wp.func_native('return __builtin_cpu_supports("avx2") ? 1.0f : a;')
    def host_only(a: wp.float32) -> wp.float32: ...

    @wp.kernel(module="unique", enable_backward=False)
    def bad(values_out: wp.array(dtype=wp.float32)):
        values_out[wp.tid()] = host_only(values_out[0])

    with pytest.raises(Exception, match=r"(?i)compil|cuda|nvrtc|build"):
        compile_for_cuda(bad)
