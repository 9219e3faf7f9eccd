"""Compiler options, and the Warp modules that kernels without variants share.

Every run of the compiler costs as much as a small kernel, and a module is compiled whole. Kernels therefore share a
module if whoever needs one of them needs most of them. A kernel that joins later changes the module's name in the cache
and compiles it anew, so code that compiles a module imports all of its ``FILES`` first.
"""

import platform

import warp as wp

#: Loops over lanes compute in SIMD where each lane reads a table. Without the flag, the compiler makes all that an
#: address is computed from scalar where it holds gathers for slow (AMD's AVX2). It changes nothing with AVX-512.
ADDRESSES_IN_LANES = "-target-feature +fast-gather " if platform.machine() in ("x86_64", "AMD64") else ""


def wide_vectors() -> dict[str, str | int]:
    """Return the options of a module: vectors of 512 bits where the processor has them.

    By itself the compiler makes loops over lanes of 256 bits, lest some processors clock lower: ray queries have
    brought them there in any case. The user's flags come behind, and win. All kernels ask for it, for Warp's headers
    are parsed once for each string of flags. Launches on the CPU have one thread a block: where that is a module's
    default too, its functions are hashed for one number of threads, not for two.
    """
    flags = wp.config.cpu_compiler_flags
    flags = "-march=native" if flags is None else flags
    return {"block_dim": 1, "cpu_compiler_flags": f"-mprefer-vector-width=512 {ADDRESSES_IN_LANES}{flags}"}


def shared(name: str) -> str:
    """Return the name of a module that kernels share, with its options set."""
    wp.set_module_options(wide_vectors(), module=name)
    return name


#: Builds a scene's records and finishes images and gradients.
SCENE = shared("warp_psdr.scene")
#: Pulls gradients back from vertices and normals to what they are computed from.
DERIVED_VJP = shared("warp_psdr.derived_vjp")
#: The same in forward mode.
DERIVED_JVP = shared("warp_psdr.derived_jvp")
#: Lists edges and triangles for the boundary terms, on the host's processor.
LISTS = shared("warp_psdr.lists")
#: Warp's headers alone.
HEADERS = shared("warp_psdr.headers")
#: Losses of images, and of grids.
LOSS = shared("warp_psdr.loss")
GRID_LOSS = shared("warp_psdr.grid_loss")
#: Files of ``kernels`` whose kernels share a module.
FILES = {
    SCENE: ("films", "primitive.affine", "reduction", "shape.normals", "shape.transform", "surface"),
    DERIVED_VJP: ("shape.normals", "shape.transform"),
    DERIVED_JVP: ("shape.normals", "shape.transform"),
    LISTS: ("boundary.edge_lists", "boundary.edge_wedges", "boundary.film_clip", "boundary.shading_normals.bent_faces"),
    HEADERS: ("headers",),
}


def pairs_module(width: int) -> str:
    """Return the module of the kernels that find where triangles meet; see ``boundary/pairs.py``."""
    return shared(f"warp_psdr.pairs{width}")
