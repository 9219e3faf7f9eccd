"""The source that Warp generates for a kernel, without compiling it."""

import warp as wp
from warp._src.context import ModuleBuilder  # what generates source; there is no public way to it


def generated(kernel: wp.Kernel) -> tuple[ModuleBuilder, str]:
    """Return what generates a kernel's module for the CPU, and its C++ source with comments."""
    options = kernel.module.resolve_options(wp.config, block_dim=1) | {"output_arch": None, "block_dim": 1}
    builder = ModuleBuilder(kernel.module, options, target="cpu")
    return builder, builder.codegen("cpu")
