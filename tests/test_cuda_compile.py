"""Every kernel of the library compiles for CUDA, on a machine without a GPU.

The kernels are discovered: those at module level join by themselves, and a factory (a function that defines a kernel)
that is not listed here fails ``test_every_factory_is_listed``.
"""

import ast
import functools
import importlib
import pkgutil
from pathlib import Path

import pytest
import warp as wp

import warp_psdr.kernels
from tests.config_helpers import EVERYTHING, OTHERS, SIMPLE, everything, wanted
from tests.cuda_configs import (
    ALBEDO,
    ALL_LIGHTS,
    CONNECTED,
    CONNECTED_LIGHTS,
    CONNECTED_THROUGH,
    CUBIC,
    CURVES,
    DISTANCES,
    EMISSION,
    EXACT,
    EXACT_LIGHTS,
    GEOMETRY,
    GLOSSY,
    GLOWING,
    GRIDS,
    IRRADIANCE,
    JOINED,
    JOINED_LIGHTS,
    JOINED_THROUGH,
    MAPPED,
    MATERIALS,
    MEDIA,
    MIRROR_LIGHTS,
    MIRRORS,
    MIRRORS_LENS,
    MIRRORS_PARALLEL,
    NOTED,
    NOTED_MATERIALS,
    ORTHOGRAPHIC,
    ORTHOGRAPHIC_SMOOTH,
    SPHERE,
    SPLAT,
    SPLAT_GAUSSIAN,
    SPLINE,
    TEXTURED,
    THIN_LENS,
    THIN_LENS_SMOOTH,
    THROUGH,
)
from warp_psdr.kernels import constants as c
from warp_psdr.kernels.boundary.guiding.projective import BLOCKED_LIGHT, SCATTERED
from warp_psdr.kernels.boundary.signed_distance.warp_field import WarpOptions
from warp_psdr.kernels.bsdf.motion import MOVED_BY
from warp_psdr.kernels.interior.gradient_request import GradientRequest
from warp_psdr.kernels.interior.shape_parameters import branched_values
from warp_psdr.kernels.loss import relative_squared
from warp_psdr.kernels.vertex import PathConfig

#: Compute capability 9.0.
ARCHITECTURE = 90
#: Factories of kernels that run on the CPU only, and why.
CPU_ONLY = {
    "bvh.build.make_build": "the wide BVH is a CPU structure; wp.Mesh traces on CUDA",
    "bvh.refit.make_refit": "the wide BVH is a CPU structure; wp.Mesh traces on CUDA",
    "interior.replay._make_lane_kernel": "paths side by side are for SIMD; make_replay_kernel has one a thread on CUDA",
}

#: Factories that another one makes their kernels for.
MADE_BY = {
    "interior.radiative.make_radiative_kernel": "interior.path_order.make_path_order_kernel",
    "interior.textbook.make_textbook_kernel": "interior.path_order.make_path_order_kernel",
}


def moving_camera(config):
    return wanted(config, camera=True)


def moving_shapes(config):
    return wanted(config, shapes=True)


def moving(config):
    return wanted(config, "ior", shapes=True, camera=True, bends=True)


def all_of(config):
    return everything(
        config,
        to_uv=True,
        shapes=True,
        texcoords=True,
        radiance=True,
        lights=("radiance", "pose"),
        camera=True,
        bends=True,
    )


def still(config):
    """Textbook replay takes no moving vertices behind delta lobes."""
    return everything(config, radiance=True, lights=("radiance", "pose"))


#: Rough metal, and paint with a mirror's reflection, under an area light.


def roughness_of(config):
    """The roughnesses of metal."""
    return GradientRequest(material=tuple(slot.name in MOVED_BY for slot in config.material))


def shapes_of(config):
    """The material values that are branched."""
    return GradientRequest(material=branched_values(config, everything(config)))


def media(config):
    """All of media, and what does not move beside them."""
    everywhere = ("sigma_t", "albedo", "scale", "emission", "phase")
    return everything(config, to_uv=True, radiance=True, lights=("radiance",), media=everywhere)


def moving_among_media(config):
    return wanted(config, shapes=True, texcoords=True, lights=("pose",), camera=True)


#: Configurations that together hold every model, texture kind, light, sampler and filter.
THIRDS = {"materials": MATERIALS, "textures": TEXTURED, "lights": ALL_LIGHTS, "others": OTHERS}
FAST, SLOW = (), (pytest.mark.slow,)
SHADED = [(str(shading), (DISTANCES, "reverse", True, shading), SLOW) for shading in (False, True)]
SMOOTH = ("cubic", (CUBIC, "reverse", True, False, True), SLOW)
NEURAL = ("networks", (CUBIC, "reverse", True, False, True, True), SLOW)


def unlit(config):
    """The camera paths of edge sampling look for no light."""
    return PathConfig(**{**vars(config), "area": (), "lights": ()})


#: factory: (label, arguments, marks)
FACTORIES = {
    "adam.make_adam": [("masked", (True,), FAST), ("plain", (False,), FAST)],
    "adam.make_count_unusable": [("", (), FAST)],
    "primitive.redistance.make_sweep_kernel": [("", (), FAST)],
    "primitive.redistance.make_mesh_distance_kernel": [("", (), FAST)],
    "loss.make_terms": [("relative", (relative_squared,), FAST)],
    "loss.make_sums": [("", (), FAST)],
    "loss.make_grid_terms": [("", (), SLOW)],
    "loss.make_total": [("", (), SLOW)],
    "aov.make_aov_kernel": [("textures", (TEXTURED,), FAST), ("materials", (MATERIALS,), SLOW)],
    "trace.make_trace_kernel": [
        ("image", (SIMPLE, False, c.RFILTER_BOX), FAST),
        ("interior", (SIMPLE, True, None), SLOW),
    ],
    "primal.make_primal_kernel": [
        ("simple", (SIMPLE,), FAST),
        ("grids of distances", (DISTANCES,), SLOW),
        ("cubic grids, networks", (CUBIC,), SLOW),
        ("exact lights", (EXACT,), SLOW),
        ("curves", (CURVES,), SLOW),
        ("emission", (EMISSION,), SLOW),
        ("orthographic", (ORTHOGRAPHIC,), SLOW),
        ("thin lens", (THIN_LENS,), SLOW),
        ("irradiance meter", (IRRADIANCE,), SLOW),
        ("others", (OTHERS,), SLOW),
        ("everything", (EVERYTHING,), SLOW),
        ("through", (THROUGH,), SLOW),
        ("media", (MEDIA,), SLOW),
        ("grids", (GRIDS,), SLOW),
        ("bidirectional", (JOINED_LIGHTS,), SLOW),
    ],
    "interior.bidirectional.make_bidirectional_kernel": [
        ("reverse", (JOINED, ALBEDO, "reverse", 4, 1), FAST),
        ("lights, blocks", (JOINED_LIGHTS, still(JOINED_LIGHTS), "reverse", 4, 4), SLOW),
        ("through", (JOINED_THROUGH, still(JOINED_THROUGH), "forward", 4, 1), SLOW),
    ],
    "connection.make_connected_image_kernel": [
        ("lights", (CONNECTED_LIGHTS,), SLOW),
        ("through", (CONNECTED_THROUGH,), SLOW),
    ],
    "interior.connected.make_connected_kernel": [
        ("reverse", (CONNECTED, ALBEDO, "reverse"), SLOW),
        ("lights", (CONNECTED_LIGHTS, still(CONNECTED_LIGHTS), "forward"), SLOW),
    ],
    "interior.light_tracing.make_light_replay_kernel": [
        ("simple", (SIMPLE, ALBEDO, 4, 1), FAST),
        ("blocks, lights", (ALL_LIGHTS, still(ALL_LIGHTS), 4, 4), SLOW),
        ("materials", (MATERIALS, everything(MATERIALS, radiance=True), 4, 1), SLOW),
        ("textures", (TEXTURED, everything(TEXTURED, radiance=True, to_uv=True), 4, 1), SLOW),
    ],
    "interior.light_tracing.make_light_forward_kernel": [
        ("simple", (SIMPLE, ALBEDO), SLOW),
        ("lights", (ALL_LIGHTS, still(ALL_LIGHTS)), SLOW),
        ("materials", (MATERIALS, everything(MATERIALS, radiance=True)), SLOW),
    ],
    "light_tracing.make_light_image_kernel": [
        ("simple", (SIMPLE,), FAST),
        ("lights", (ALL_LIGHTS,), SLOW),
        ("thin lens", (THIN_LENS,), SLOW),
        ("materials", (MATERIALS,), SLOW),
        ("through", (THROUGH,), SLOW),
        ("weighted", (JOINED_THROUGH,), SLOW),
    ],
    "splat.make_splat_kernel": [("tent", (SPLAT,), FAST), ("gaussian", (SPLAT_GAUSSIAN,), SLOW)],
    "interior.replay.make_replay_kernel": [
        ("simple", (SIMPLE, GEOMETRY, 8, 1), FAST),
        ("blocks", (SIMPLE, ALBEDO, 8, 4), SLOW),
        ("orthographic", (ORTHOGRAPHIC, moving_camera(ORTHOGRAPHIC), 4, 1), SLOW),
        ("thin lens", (THIN_LENS, moving_camera(THIN_LENS), 4, 1), SLOW),
        *[(name, (config, all_of(config), 4, 1), SLOW) for name, config in THIRDS.items()],
        ("through", (THROUGH, still(THROUGH), 4, 1), SLOW),
        ("grids of distances", (DISTANCES, GEOMETRY, 4, 1), SLOW),
        ("cubic grids, networks", (CUBIC, GEOMETRY, 4, 1), SLOW),
        ("exact lights", (EXACT, GEOMETRY, 4, 1), SLOW),
        ("curves", (CURVES, GEOMETRY, 4, 1), SLOW),
    ],
    "interior.forward.make_forward_kernel": [
        ("simple", (SIMPLE, ALBEDO), FAST),
        ("orthographic", (ORTHOGRAPHIC, moving_camera(ORTHOGRAPHIC)), SLOW),
        ("thin lens", (THIN_LENS, moving_camera(THIN_LENS)), SLOW),
        *[(name, (config, all_of(config)), SLOW) for name, config in THIRDS.items()],
        ("through", (THROUGH, still(THROUGH)), SLOW),
        ("grids of distances", (DISTANCES, GEOMETRY), SLOW),
        ("cubic grids, networks", (CUBIC, GEOMETRY), SLOW),
        ("curves", (CURVES, GEOMETRY), SLOW),
    ],
    "interior.media_replay.make_media_replay_kernel": [
        ("reverse", (MEDIA, media(MEDIA), "reverse", 8, 8), SLOW),
        ("forward", (MEDIA, media(MEDIA), "forward", 4, 4), SLOW),
        ("grids", (GRIDS, media(GRIDS), "reverse", 4, 4), SLOW),
        ("emission and microflakes", (GLOWING, media(GLOWING), "reverse", 4, 4), SLOW),
        ("ratio tracking", (GRIDS, media(GRIDS), "forward", 4, 4, True), SLOW),
    ],
    "interior.media_motion_replay.make_media_motion_kernel": [
        ("reverse", (MEDIA, moving_among_media(MEDIA), "reverse", 4, 4), SLOW),
        ("forward", (MEDIA, moving_among_media(MEDIA), "forward", 4, 4), SLOW),
        ("grids", (GRIDS, wanted(GRIDS, shapes=True, camera=True, media=("pose",)), "reverse", 4, 4), SLOW),
    ],
    "boundary.path_space.media_secondary.make_media_secondary_kernel": [
        ("reverse", (MEDIA, "reverse", True, True, True), SLOW),
        ("forward", (MEDIA, "forward", True, False, False), SLOW),
        ("grids", (GRIDS, "reverse", True, False, True, True), SLOW),
    ],
    "transfer.radiative_transfer.make_transfer_kernel": [
        ("reverse", (MEDIA, moving_among_media(MEDIA), "reverse", 4, 4, True), SLOW),
        ("forward, no edges", (MEDIA, moving_among_media(MEDIA), "forward", 4, 4, False), SLOW),
    ],
    "interior.textbook.make_textbook_kernel": [
        ("reverse, simple", (SIMPLE, ALBEDO, "reverse"), FAST),
        ("forward, simple", (SIMPLE, ALBEDO, "forward"), SLOW),
        ("reverse, materials", (MATERIALS, still(MATERIALS), "reverse"), SLOW),
        ("reverse, lights", (ALL_LIGHTS, all_of(ALL_LIGHTS), "reverse"), SLOW),
    ],
    "interior.radiative.make_radiative_kernel": [
        ("reverse, simple", (SIMPLE, ALBEDO, "reverse", False), SLOW),
        ("forward, lights", (ALL_LIGHTS, all_of(ALL_LIGHTS), "forward", False), SLOW),
        ("linear, materials", (MATERIALS, still(MATERIALS), "reverse", True), SLOW),
    ],
    "interior.branch.make_branch_kernel": [
        ("reverse", (GLOSSY, shapes_of(GLOSSY), "reverse", 16), SLOW),
        ("forward", (GLOSSY, shapes_of(GLOSSY), "forward", 4), SLOW),
        ("decomposed", (GLOSSY, shapes_of(GLOSSY), "reverse", 16, True), SLOW),
    ],
    "interior.attached.make_attached_kernel": [
        ("reverse", (GLOSSY, roughness_of(GLOSSY), "reverse", True, "attached"), SLOW),
        ("forward, weights", (GLOSSY, roughness_of(GLOSSY), "forward", False, "attached"), SLOW),
    ],
    "interior.antithetic.make_pair_kernel": [
        ("reverse", (GLOSSY, moving_camera(GLOSSY), "reverse"), SLOW),
        ("forward", (MAPPED, everything(MAPPED, to_uv=True), "forward"), SLOW),
    ],
    "interior.film_antithetic.make_film_antithetic_kernel": [
        ("reverse", (SPLAT, all_of(SPLAT), "reverse", 4, True), SLOW),
        ("forward, one by one", (SPLAT_GAUSSIAN, all_of(SPLAT_GAUSSIAN), "forward", 4, False), SLOW),
    ],
    "boundary.shading_normals.indirect_terminator.make_indirect_terminator_kernel": [
        ("reverse, materials", (MATERIALS, "reverse", True), SLOW),
        ("forward, textures", (TEXTURED, "forward", False), SLOW),
    ],
    "boundary.path_space.intersection_curve.make_intersection_curve_kernel": [
        ("reverse, simple", (SIMPLE, "reverse", False), SLOW),
        ("forward, textures", (TEXTURED, "forward", True), SLOW),
        ("reverse, lights", (ALL_LIGHTS, "reverse", False), SLOW),
        ("indirect, lights", (ALL_LIGHTS, "reverse", False, True), SLOW),
        ("noted, simple", (NOTED, "forward", False), SLOW),
    ],
    "boundary.shading_normals.geometric_horizon.make_geometric_horizon_kernel": [
        ("reverse, materials", (MATERIALS, "reverse", True), SLOW),
        ("forward, textures", (TEXTURED, "forward", False), SLOW),
        ("indirect, materials", (MATERIALS, "reverse", False, True), SLOW),
    ],
    "boundary.specular.line_search.make_line_search_kernel": [
        ("reverse, materials", (MATERIALS, moving(MATERIALS), "reverse", False), SLOW),
        ("forward, mirror under lights", (MIRROR_LIGHTS, moving(MIRROR_LIGHTS), "forward", True), SLOW),
        ("reverse, mirrors alone", (MIRRORS, moving(MIRRORS), "reverse", False), SLOW),
        ("reverse, mirrors, orthographic", (MIRRORS_PARALLEL, moving_camera(MIRRORS_PARALLEL), "reverse", False), SLOW),
        ("forward, mirrors, thin lens", (MIRRORS_LENS, moving_camera(MIRRORS_LENS), "forward", False), SLOW),
        ("noted, materials", (NOTED_MATERIALS, moving(NOTED_MATERIALS), "reverse", False), SLOW),
    ],
    "boundary.path_space.primary.make_primary_kernel": [
        ("reverse, simple", (SIMPLE, "reverse", False), FAST),
        ("forward, materials", (MATERIALS, "forward", True), SLOW),
        ("reverse, textures", (TEXTURED, "reverse", True), SLOW),
        ("reverse, orthographic", (ORTHOGRAPHIC, "reverse", True), SLOW),
        ("forward, thin lens", (THIN_LENS, "forward", True), SLOW),
        ("samples, simple", (SIMPLE, "samples", False), SLOW),
        ("noted, simple", (NOTED, "reverse", False), SLOW),
    ],
    "boundary.path_space.flat_creases.make_flat_creases_kernel": [
        ("reverse, simple", (SIMPLE, "reverse", False), SLOW),
        ("forward, materials", (GLOSSY, "forward", True), SLOW),
        ("reverse, textures", (TEXTURED, "reverse", True), SLOW),
        ("reverse, lights", (ALL_LIGHTS, "reverse", False), SLOW),
        ("reverse, orthographic", (ORTHOGRAPHIC, "reverse", True), SLOW),
        ("forward, thin lens", (THIN_LENS, "forward", True), SLOW),
        ("samples, simple", (SIMPLE, "samples", False), SLOW),
        ("noted, simple", (NOTED, "reverse", False), SLOW),
    ],
    "boundary.silhouette.grid_foreground.make_foreground_grid_kernel": [*SHADED, SMOOTH, NEURAL],
    "boundary.silhouette.grid_primary.make_primary_grid_kernel": [*SHADED, SMOOTH, NEURAL],
    "boundary.silhouette.grid_secondary.make_secondary_grid_kernel": [
        *SHADED,
        ("cubic", (CUBIC, "reverse", True, True, False, True), SLOW),
        ("networks", (CUBIC, "reverse", True, True, False, True, True), SLOW),
    ],
    "boundary.silhouette.tube_foreground.make_foreground_tube_kernel": [("curves", (CURVES, "reverse", True), SLOW)],
    "boundary.silhouette.tube_primary.make_primary_tube_kernel": [("curves", (CURVES, "reverse", True), SLOW)],
    "boundary.silhouette.tube_secondary.make_secondary_tube_kernel": [
        ("curves", (CURVES, "reverse", True, False), SLOW)
    ],
    "boundary.signed_distance.reparametrised.make_reparametrised_kernel": [
        ("reverse", (SPHERE, moving_shapes(SPHERE), "reverse", WarpOptions()), SLOW),
        ("forward, neural, grid", (SPLINE, moving_shapes(SPLINE), "forward", WarpOptions(neural=True)), SLOW),
    ],
    "boundary.signed_distance.film_border.make_film_border_kernel": [
        ("reverse", (SPHERE, "reverse", WarpOptions()), SLOW),
        ("forward, neural", (SPHERE, "forward", WarpOptions(neural=True)), SLOW),
    ],
    "boundary.crossing.film.make_film_crossing_kernel": [("reverse", (EXACT, "reverse", True), SLOW)],
    "boundary.crossing.vertex.make_vertex_crossing_kernel": [
        ("reverse", (EXACT, "reverse", True), SLOW),
        ("indirect, lights", (EXACT_LIGHTS, "forward", False, True), SLOW),
    ],
    "boundary.silhouette.primary.make_primary_silhouette_kernel": [("reverse", (EXACT, "reverse", True), SLOW)],
    "boundary.silhouette.secondary.make_secondary_silhouette_kernel": [
        ("reverse", (EXACT, "reverse", True, False), SLOW),
        ("indirect, lights", (EXACT_LIGHTS, "forward", False, True, True), SLOW),
    ],
    "boundary.path_space.secondary.make_secondary_kernel": [
        ("reverse, simple", (SIMPLE, "reverse", False, False), SLOW),
        ("forward, textures", (TEXTURED, "forward", True, False), SLOW),
        ("reverse, lights", (ALL_LIGHTS, "reverse", True, True), SLOW),
        ("reverse, guided, lights", (ALL_LIGHTS, "reverse", False, False, True), SLOW),
        ("target, textures", (TEXTURED, "target", False, False), SLOW),
        ("forward, orthographic", (ORTHOGRAPHIC, "forward", True, False), SLOW),
        ("reverse, thin lens", (THIN_LENS, "reverse", True, False), SLOW),
        ("samples, simple", (SIMPLE, "samples", False, False), SLOW),
        ("indirect, simple", (SIMPLE, "reverse", False, False, False, True), SLOW),
        ("indirect, guided, lights", (ALL_LIGHTS, "forward", True, True, True, True), SLOW),
        ("indirect target, textures", (TEXTURED, "target", False, False, False, True), SLOW),
        ("noted, simple", (NOTED, "reverse", False, False), SLOW),
    ],
    "boundary.guiding.projective.make_seeds_kernel": [
        ("blocked, simple", (SIMPLE, BLOCKED_LIGHT), SLOW),
        ("blocked, lights", (ALL_LIGHTS, BLOCKED_LIGHT), SLOW),
        ("scattered, materials", (MATERIALS, SCATTERED), SLOW),
    ],
    "boundary.guiding.ends.make_ends_kernel": [("simple", (SIMPLE,), SLOW), ("lights", (ALL_LIGHTS,), SLOW)],
    "boundary.guiding.facing.make_facing_kernel": [("simple", (SIMPLE,), SLOW), ("lights", (ALL_LIGHTS,), SLOW)],
    "boundary.guiding.photons.make_importons_kernel": [("simple", (SIMPLE,), SLOW), ("materials", (MATERIALS,), SLOW)],
    "boundary.guiding.photons.make_photons_kernel": [("simple", (SIMPLE,), SLOW), ("lights", (ALL_LIGHTS,), SLOW)],
    "boundary.shading_normals.terminator.make_terminator_kernel": [
        ("reverse, materials", (MATERIALS, "reverse", True), SLOW),
        ("reverse, orthographic", (ORTHOGRAPHIC_SMOOTH, "reverse", True), SLOW),
        ("forward, thin lens", (THIN_LENS_SMOOTH, "forward", True), SLOW),
        ("noted, materials", (NOTED_MATERIALS, "reverse", False), SLOW),
    ],
    "boundary.edge_sampling.edge_sampling.make_edge_sampling_kernel": [
        ("reverse, simple", (SIMPLE, unlit(SIMPLE), "reverse", False, True, 16), SLOW),
        ("forward, flat", (SIMPLE, unlit(SIMPLE), "forward", True, False, 64), SLOW),
        ("forward, materials", (GLOSSY, unlit(GLOSSY), "forward", True, True, 16), SLOW),
        ("reverse, textures", (TEXTURED, unlit(TEXTURED), "reverse", True, True, 16), SLOW),
        ("forward, orthographic", (ORTHOGRAPHIC, unlit(ORTHOGRAPHIC), "forward", True, True, 16), SLOW),
        ("reverse, thin lens", (THIN_LENS, unlit(THIN_LENS), "reverse", True, True, 16), SLOW),
        ("reverse, lights", (ALL_LIGHTS, unlit(ALL_LIGHTS), "reverse", False, True, 16), SLOW),
        ("indirect, lights", (ALL_LIGHTS, unlit(ALL_LIGHTS), "reverse", False, True, 16, True), SLOW),
        ("noted, simple", (NOTED, unlit(NOTED), "reverse", False, True, 16), SLOW),
    ],
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

    def compile_kernel(kernel):
        files = wp.compile_aot_module(kernel.module, arch=ARCHITECTURE, module_dir=folder)
        outputs = [Path(f) for f in files if Path(f).suffix in (".ptx", ".cubin")]
        assert outputs and all(f.stat().st_size > 0 for f in outputs), f"no CUDA code among {files}"
        return outputs

    try:
        compile_kernel(probe)
    except RuntimeError as error:
        pytest.skip(f"this build of Warp cannot compile for CUDA (NVRTC): {error}")
    return compile_kernel


def test_every_factory_is_listed():
    """A new factory of kernels has to say here with which arguments it is compiled."""
    found, plain = factories()
    assert found == set(FACTORIES) - set(MADE_BY) | set(MADE_BY.values()) | set(CPU_ONLY)
    assert plain == len(module_kernels()) > 0


@pytest.mark.parametrize("name", sorted(module_kernels()))
def test_kernel_compiles(name, compile_for_cuda):
    compile_for_cuda(module_kernels()[name])


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
