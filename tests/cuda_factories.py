"""With which arguments the factories of kernels are compiled for CUDA: a row each, or ``MADE_BY``."""

import pytest

from tests.config_helpers import EVERYTHING, OTHERS, SIMPLE, changed, everything, wanted
from tests.cuda_configs import (
    ALBEDO,
    ALL_LIGHTS,
    CAMERAS,
    CAUSTICS,
    CONNECTED,
    CONNECTED_LIGHTS,
    CONNECTED_THROUGH,
    CUBIC,
    CURVES,
    DISTANCES,
    DISTANCES_LIGHTS,
    EMISSION,
    EXACT,
    EXACT_LIGHTS,
    EXACT_MEDIA,
    EXACT_MIRRORS,
    FLAKY,
    FLOW,
    GEOMETRY,
    GLOSSY,
    GLOWING,
    GRID_MIRRORS,
    GRIDS,
    IRRADIANCE,
    JOINED,
    JOINED_LIGHTS,
    JOINED_THROUGH,
    MAPPED,
    MATERIALS,
    MEDIA,
    MEDIA_MIRRORS,
    MIRROR_LIGHTS,
    MIRRORS,
    MIRRORS_DISTORTED,
    MIRRORS_LENS,
    MIRRORS_PARALLEL,
    NETWORK,
    NEURAL_MIRRORS,
    NOTED,
    NOTED_MATERIALS,
    ORTHOGRAPHIC,
    ORTHOGRAPHIC_SMOOTH,
    POINTS_PASS,
    SHOWN_DEPTH,
    SHOWN_NORMAL,
    SLIDING_MIRRORS,
    SPHERE,
    SPLAT,
    SPLAT_GAUSSIAN,
    SPLINE,
    STEPPED,
    TEXTURED,
    THIN_LENS,
    THIN_LENS_SMOOTH,
    THROUGH,
    TIMED,
    TIMED_GAUSSIAN,
    all_of,
    media,
    moving_among_media,
    still,
)
from warp_psdr.kernels import constants as c
from warp_psdr.kernels.boundary.guiding.path_segments import BLOCKED_LIGHT, SCATTERED
from warp_psdr.kernels.boundary.signed_distance.warp_field import WarpOptions
from warp_psdr.kernels.boundary.warped_area.auxiliary import WarpedOptions
from warp_psdr.kernels.boundary.warped_area.rotation import RotationOptions
from warp_psdr.kernels.bsdf.motion import MOVED_BY
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.shape_parameters import branched_values
from warp_psdr.kernels.loss import relative_squared

#: Factories whose kernels another one returns for scenes before a transient film, in a row of its own.
FOR_FILMS = {
    "interior.time_gated_forward.make_time_gated_forward_kernel",
    "boundary.path_space.timed_primary.make_timed_primary_kernel",
    "boundary.path_space.timed_secondary.make_timed_secondary_kernel",
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


def roughness_of(config):
    """The roughnesses of metal."""
    return GradientRequest(material=tuple(slot.name in MOVED_BY for slot in config.surfaces.material))


def shapes_of(config):
    """The material values that are branched."""
    return GradientRequest(material=branched_values(config.surfaces, everything(config)))


#: Configurations that together hold every model, texture kind, light, sampler and filter.
THIRDS = {"materials": MATERIALS, "textures": TEXTURED, "lights": ALL_LIGHTS, "others": OTHERS}
FAST, SLOW = (), (pytest.mark.slow,)


def unlit(config):
    """The camera paths of edge sampling look for no light."""
    return changed(config, area=(), others=())


#: factory: (label, arguments, marks)
FACTORIES = {
    "adam.make_adam": [("masked", (True,), FAST), ("plain", (False,), FAST)],
    "adam.make_count_unusable": [("", (), FAST)],
    "boundary.path_space.crossing.make_crossing_triangles": [("", (), FAST)],
    "boundary.touching.make_touching_pairs": [("", (1,), FAST)],
    "primitive.redistance.make_sweep_kernel": [("", (), FAST)],
    "primitive.redistance.make_mesh_distance_kernel": [("", (), FAST)],
    "loss.make_terms": [("relative", (relative_squared, 3), FAST), ("of one channel", (relative_squared, 1), SLOW)],
    "loss.make_sums": [("", (), FAST)],
    "loss.make_grid_terms": [("", (), SLOW)],
    "loss.make_total": [("", (), SLOW)],
    "aov.make_aov_kernel": [("textures", (TEXTURED,), SLOW), ("materials", (MATERIALS,), SLOW)],
    "trace.make_trace_kernel": [
        ("image", (SIMPLE, False, c.RFILTER_BOX), SLOW),
        ("interior", (SIMPLE, True, None), SLOW),
    ],
    "trace.make_media_trace_kernel": [
        ("image", (MEDIA, False, False, False, c.RFILTER_BOX), SLOW),
        ("interior", (GRIDS, True, True, False, None), SLOW),
    ],
    "primal.make_primal_kernel": [
        ("simple", (SIMPLE,), FAST),
        ("grids of distances", (DISTANCES,), SLOW),
        ("cubic grids, networks", (CUBIC,), SLOW),
        ("exact lights", (EXACT,), SLOW),
        ("curves", (CURVES,), SLOW),
        ("emission", (EMISSION,), SLOW),
        *[(name, (config,), SLOW) for name, config in CAMERAS.items()],
        ("irradiance meter", (IRRADIANCE,), SLOW),
        ("others", (OTHERS,), SLOW),
        ("everything", (EVERYTHING,), SLOW),
        ("through", (THROUGH,), SLOW),
        ("media", (MEDIA,), SLOW),
        ("grids", (GRIDS,), SLOW),
        ("bidirectional", (JOINED_LIGHTS,), SLOW),
    ],
    "interior.bidirectional.make_bidirectional_kernel": [
        ("reverse", (JOINED, ALBEDO, "reverse", 4, 1), SLOW),
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
        ("simple", (SIMPLE, ALBEDO, 4, 1), SLOW),
        ("blocks, lights", (ALL_LIGHTS, still(ALL_LIGHTS), 4, 4), SLOW),
        ("materials", (MATERIALS, everything(MATERIALS, radiance=True), 4, 1), SLOW),
        ("textures", (TEXTURED, everything(TEXTURED, radiance=True, to_uv=True), 4, 1), SLOW),
    ],
    "interior.light_tracing.make_light_forward_kernel": [
        ("simple", (SIMPLE, ALBEDO), SLOW),
        ("lights", (ALL_LIGHTS, still(ALL_LIGHTS)), SLOW),
        ("materials", (MATERIALS, everything(MATERIALS, radiance=True)), SLOW),
    ],
    "interior.light_motion_replay.make_light_motion_kernel": [
        ("materials", (MATERIALS, everything(MATERIALS, shapes=True, bends=True), 4), SLOW),
    ],
    "interior.light_motion_replay.make_light_motion_forward_kernel": [
        ("lights", (ALL_LIGHTS, everything(ALL_LIGHTS, shapes=True), 4), SLOW),
    ],
    "light_tracing.make_light_image_kernel": [
        ("simple", (SIMPLE,), SLOW),
        ("caustics", (CAUSTICS,), SLOW),
        ("lights", (ALL_LIGHTS,), SLOW),
        ("thin lens", (THIN_LENS,), SLOW),
        ("materials", (MATERIALS,), SLOW),
        ("through", (THROUGH,), SLOW),
        ("weighted", (JOINED_THROUGH,), SLOW),
    ],
    "splat.make_splat_kernel": [("tent", (SPLAT,), SLOW), ("gaussian", (SPLAT_GAUSSIAN,), SLOW)],
    "transient.make_transient_kernel": [("box", (TIMED,), SLOW), ("gaussian", (TIMED_GAUSSIAN,), SLOW)],
    "interior.time_gated.make_time_gated_kernel": [
        ("lights and shapes", (TIMED, wanted(TIMED, shapes=True, lights=("pose",)), 4), SLOW),
    ],
    "interior.replay.make_replay_kernel": [
        ("simple", (SIMPLE, GEOMETRY, 8, 1), FAST),
        ("blocks", (SIMPLE, ALBEDO, 8, 4), SLOW),
        *[(name, (config, moving_camera(config), 4, 1), SLOW) for name, config in CAMERAS.items()],
        *[(name, (config, all_of(config), 4, 1), SLOW) for name, config in THIRDS.items()],
        ("through", (THROUGH, still(THROUGH), 4, 1), SLOW),
        ("lights behind sheets", (POINTS_PASS, moving(POINTS_PASS), 4, 1), SLOW),
        ("grids of distances", (DISTANCES, GEOMETRY, 4, 1), SLOW),
        ("cubic grids, networks", (CUBIC, GEOMETRY, 4, 1), SLOW),
        ("flow along normals", (FLOW, GEOMETRY, 4, 1), SLOW),
        ("exact lights", (EXACT, GEOMETRY, 4, 1), SLOW),
        ("curves", (CURVES, GEOMETRY, 4, 1), SLOW),
    ],
    "interior.forward.make_forward_kernel": [
        ("simple", (SIMPLE, ALBEDO), SLOW),
        ("time bins", (TIMED, wanted(TIMED, shapes=True, lights=("pose",))), SLOW),
        *[(name, (config, moving_camera(config)), SLOW) for name, config in CAMERAS.items()],
        *[(name, (config, all_of(config)), SLOW) for name, config in THIRDS.items()],
        ("through", (THROUGH, still(THROUGH)), SLOW),
        ("grids of distances", (DISTANCES, GEOMETRY), SLOW),
        ("cubic grids, networks", (CUBIC, GEOMETRY), SLOW),
        ("flow along normals", (FLOW, GEOMETRY), SLOW),
        ("curves", (CURVES, GEOMETRY), SLOW),
    ],
    "interior.media_replay.make_media_replay_kernel": [
        ("reverse", (MEDIA, media(MEDIA), "reverse", 8, 8), SLOW),
        ("forward", (MEDIA, media(MEDIA), "forward", 4, 4), SLOW),
        ("grids", (GRIDS, media(GRIDS), "reverse", 4, 4), SLOW),
        ("emission and microflakes", (GLOWING, media(GLOWING), "reverse", 4, 4), SLOW),
        ("grids of microflakes", (FLAKY, media(FLAKY), "reverse", 4, 4), SLOW),
        ("ratio tracking", (GRIDS, media(GRIDS), "forward", 4, 4, True), SLOW),
    ],
    "interior.media_textbook.make_media_textbook_kernel": [
        ("reverse", (MEDIA, media(MEDIA), "reverse"), SLOW),
        ("forward, grids", (GRIDS, media(GRIDS), "forward"), SLOW),
    ],
    "interior.media_motion_replay.make_media_motion_kernel": [
        ("reverse", (MEDIA, moving_among_media(MEDIA), "reverse", 4, 4), SLOW),
        ("forward", (MEDIA, moving_among_media(MEDIA), "forward", 4, 4), SLOW),
        ("grids", (GRIDS, wanted(GRIDS, shapes=True, camera=True, media=("pose",)), "reverse", 4, 4), SLOW),
        ("reverse, mirrors", (MEDIA_MIRRORS, moving_among_media(MEDIA_MIRRORS), "reverse", 4, 4), SLOW),
    ],
    "boundary.path_space.media_secondary.make_media_secondary_kernel": [
        ("reverse", (MEDIA, "reverse", True, True, True), SLOW),
        ("forward", (MEDIA, "forward", True, False, False), SLOW),
        ("grids", (GRIDS, "reverse", True, False, True, True), SLOW),
    ],
    "boundary.shading_normals.media_indirect_terminator.make_media_indirect_terminator_kernel": [
        ("reverse", (MEDIA, "reverse", True, False), SLOW),
        ("forward, grids", (GRIDS, "forward", False, True), SLOW),
    ],
    "boundary.shading_normals.media_horizon.make_media_horizon_kernel": [
        ("reverse", (MEDIA, "reverse", True, False), SLOW),
        ("forward, grids", (GRIDS, "forward", False, True), SLOW),
    ],
    "transfer.radiative_transfer.make_transfer_kernel": [
        ("reverse", (MEDIA, moving_among_media(MEDIA), "reverse", 4, 4, True), SLOW),
        ("forward, no edges", (MEDIA, moving_among_media(MEDIA), "forward", 4, 4, False), SLOW),
    ],
    "interior.textbook.make_textbook_kernel": [
        ("reverse, simple", (SIMPLE, ALBEDO, "reverse"), SLOW),
        ("forward, simple", (SIMPLE, ALBEDO, "forward"), SLOW),
        ("reverse, materials", (MATERIALS, still(MATERIALS), "reverse"), SLOW),
        ("reverse, lights", (ALL_LIGHTS, all_of(ALL_LIGHTS), "reverse"), SLOW),
    ],
    "interior.radiative.make_radiative_kernel": [
        ("reverse, simple", (SIMPLE, ALBEDO, "reverse", False), SLOW),
        ("forward, lights", (ALL_LIGHTS, all_of(ALL_LIGHTS), "forward", False), SLOW),
        ("linear, materials", (MATERIALS, still(MATERIALS), "reverse", True), SLOW),
    ],
    "interior.phase_branch.make_phase_branch_kernel": [
        ("reverse", (GRIDS, "reverse", 16, True), SLOW),
        ("forward", (MEDIA, "forward", 16, False), SLOW),
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
        ("resampled", (MAPPED, everything(MAPPED, to_uv=True), "reverse", 16), SLOW),
    ],
    "interior.property.make_property_kernel": [
        ("reverse, depth", (SHOWN_DEPTH, GEOMETRY, "reverse"), FAST),
        ("forward, normal", (SHOWN_NORMAL, GEOMETRY, "forward"), SLOW),
    ],
    "interior.film_antithetic.make_film_antithetic_kernel": [
        ("reverse", (SPLAT, all_of(SPLAT), "reverse", 4, True), SLOW),
        ("forward, one by one", (SPLAT_GAUSSIAN, all_of(SPLAT_GAUSSIAN), "forward", 4, False), SLOW),
    ],
    "interior.pixel_border.make_pixel_border_kernel": [
        ("reverse", (SPLAT, all_of(SPLAT), "reverse", True), SLOW),
    ],
    "boundary.shading_normals.indirect_terminator.make_indirect_terminator_kernel": [
        ("reverse, materials", (MATERIALS, "reverse", True), SLOW),
        ("forward, textures", (TEXTURED, "forward", False), SLOW),
        ("reverse, exact shapes", (EXACT, "reverse", True), SLOW),
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
        ("reverse, exact shapes", (EXACT, "reverse", True), SLOW),
    ],
    "boundary.specular.long_chains.make_long_chains_kernel": [("materials", (MATERIALS,), SLOW)],
    "boundary.specular.long_chains.make_long_media_chains_kernel": [("mirrors", (MEDIA_MIRRORS,), SLOW)],
    "boundary.specular.media_line_search.make_media_line_search_kernel": [
        ("reverse", (MEDIA_MIRRORS, moving(MEDIA_MIRRORS), "reverse", False, False), SLOW),
        ("forward, grids", (GRID_MIRRORS, moving(GRID_MIRRORS), "forward", False, True), SLOW),
    ],
    "boundary.specular.line_search.make_line_search_kernel": [
        ("reverse, materials", (MATERIALS, moving(MATERIALS), "reverse", False), SLOW),
        ("forward, mirror under lights", (MIRROR_LIGHTS, moving(MIRROR_LIGHTS), "forward", True), SLOW),
        ("reverse, lights behind sheets", (POINTS_PASS, moving(POINTS_PASS), "reverse", True), SLOW),
        ("reverse, mirrors alone", (MIRRORS, moving(MIRRORS), "reverse", False), SLOW),
        ("reverse, mirrors, orthographic", (MIRRORS_PARALLEL, moving_camera(MIRRORS_PARALLEL), "reverse", False), SLOW),
        ("forward, mirrors, thin lens", (MIRRORS_LENS, moving_camera(MIRRORS_LENS), "forward", False), SLOW),
        ("forward, distortion", (MIRRORS_DISTORTED, moving_camera(MIRRORS_DISTORTED), "forward", False), SLOW),
        ("noted, materials", (NOTED_MATERIALS, moving(NOTED_MATERIALS), "reverse", False), SLOW),
        ("reverse, exact shapes", (EXACT_MIRRORS, moving(EXACT_MIRRORS), "reverse", True), SLOW),
        ("reverse, grids and curves", (SLIDING_MIRRORS, moving(SLIDING_MIRRORS), "reverse", True), SLOW),
        ("forward, networks", (NEURAL_MIRRORS, moving(NEURAL_MIRRORS), "forward", True), SLOW),
    ],
    "boundary.path_space.primary.make_primary_kernel": [
        ("reverse, steps", (STEPPED, "reverse", True), SLOW),
        ("reverse, simple", (SIMPLE, "reverse", False), FAST),
        ("forward, materials", (MATERIALS, "forward", True), SLOW),
        ("reverse, textures", (TEXTURED, "reverse", True), SLOW),
        *[(f"forward, {name}", (config, "forward", True), SLOW) for name, config in CAMERAS.items()],
        ("samples, simple", (SIMPLE, "samples", False), SLOW),
        ("noted, simple", (NOTED, "reverse", False), SLOW),
        ("reverse, depth", (SHOWN_DEPTH, "reverse", False), SLOW),
    ],
    "boundary.path_space.sliding_steps.make_sliding_steps_kernel": [
        ("reverse, steps", (STEPPED, "reverse", True), SLOW),
        ("forward, steps", (STEPPED, "forward", False), SLOW),
    ],
    "boundary.path_space.media_sliding_steps.make_media_sliding_steps_kernel": [
        ("reverse", (MEDIA, "reverse", True), SLOW),
    ],
    "boundary.path_space.media_intersection_curve.make_media_intersection_curve_kernel": [
        ("reverse", (MEDIA, "reverse", True, False), SLOW),
    ],
    "boundary.path_space.light_frame.make_light_frame_kernel": [
        ("reverse, lights", (ALL_LIGHTS, "reverse", True, True), SLOW),
        ("forward, lights", (ALL_LIGHTS, "forward", False, False), SLOW),
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
    "boundary.shading_normals.grid_terminator.make_grid_terminator_kernel": [
        ("grids of distances", (DISTANCES, "reverse", True), SLOW),
    ],
    "boundary.shading_normals.grid_indirect_terminator.make_grid_indirect_terminator_kernel": [
        ("grids of distances", (DISTANCES, "reverse", True), SLOW),
    ],
    "boundary.shading_normals.grid_horizon.make_grid_horizon_kernel": [
        ("grids of distances", (DISTANCES, "reverse", True), SLOW),
    ],
    "boundary.shading_normals.grid_light_horizon.make_grid_light_horizon_kernel": [
        ("grids of distances", (DISTANCES_LIGHTS, "reverse", True, True), SLOW),
    ],
    "boundary.silhouette.foreground.make_foreground_kernel": [
        *((family, (DISTANCES, "reverse", True, family), SLOW) for family in ("grid", "grid creases")),
        *((family, (CUBIC, "reverse", True, family), SLOW) for family in ("cubic", "network")),
        ("curves", (CURVES, "reverse", True, "tubes"), SLOW),
        ("samples", (CURVES, "samples", False, "tubes"), SLOW),
    ],
    "boundary.signed_distance.reparametrised.make_reparametrised_kernel": [
        ("reverse", (SPHERE, moving_shapes(SPHERE), "reverse", WarpOptions()), SLOW),
        ("forward, neural, grid", (SPLINE, moving_shapes(SPLINE), "forward", WarpOptions(neural=True)), SLOW),
    ],
    "boundary.signed_distance.film_border.make_film_border_kernel": [
        ("reverse", (SPHERE, "reverse", WarpOptions()), SLOW),
        ("forward, neural", (SPHERE, "forward", WarpOptions(neural=True)), SLOW),
        ("reverse, network", (NETWORK, "reverse", WarpOptions()), SLOW),
        ("reverse, meshes", (SIMPLE, "reverse", WarpedOptions()), SLOW),
    ],
    "boundary.warped_area.warped_area.make_warped_area_kernel": [
        ("reverse", (SIMPLE, moving_shapes(SIMPLE), "reverse", WarpedOptions(), 4), SLOW),
        ("forward, biased", (SIMPLE, moving_shapes(SIMPLE), "forward", WarpedOptions(debias=False), 4), SLOW),
        ("reverse, rotations", (SIMPLE, moving_shapes(SIMPLE), "reverse", RotationOptions(), 4), SLOW),
    ],
    "boundary.warped_area.path_warped_area.make_path_warped_area_kernel": [
        ("reverse", (SIMPLE, moving_shapes(SIMPLE), "reverse", WarpedOptions(), 4), SLOW),
    ],
    "boundary.crossing.film.make_film_crossing_kernel": [("reverse", (EXACT, "reverse", True), SLOW)],
    "boundary.crossing.vertex.make_vertex_crossing_kernel": [
        ("reverse", (EXACT, "reverse", True), SLOW),
        ("indirect, lights", (EXACT_LIGHTS, "forward", False, True), SLOW),
    ],
    "boundary.crossing.media_vertex.make_media_crossing_kernel": [("r", (EXACT_MEDIA, "reverse", True, False), SLOW)],
    "boundary.crossing.film_tube_steps.make_film_tube_steps_kernel": [("reverse", (CURVES, "reverse", True), SLOW)],
    "boundary.crossing.vertex_tube_steps.make_vertex_tube_steps_kernel": [
        ("reverse", (CURVES, "reverse", True), SLOW),
    ],
    "boundary.silhouette.primary.make_primary_silhouette_kernel": [
        ("exact", (EXACT, "reverse", True, "exact"), SLOW),
        *((family, (DISTANCES, "reverse", True, family), SLOW) for family in ("grid", "grid creases")),
        *((family, (CUBIC, "reverse", True, family), SLOW) for family in ("cubic", "network")),
        ("curves", (CURVES, "reverse", True, "tubes"), SLOW),
        ("samples", (DISTANCES, "samples", False, "grid"), SLOW),
    ],
    "boundary.silhouette.secondary.make_secondary_silhouette_kernel": [
        ("reverse", (EXACT, "reverse", True, False, "exact"), SLOW),
        ("samples", (EXACT, "samples", False, False, "exact"), SLOW),
        ("indirect, lights", (EXACT_LIGHTS, "forward", False, True, "exact", False, True), SLOW),
        ("guided", (EXACT_LIGHTS, "reverse", False, True, "exact", True), SLOW),
        ("target", (EXACT_LIGHTS, "target", False, False, "exact"), SLOW),
        ("ends", (EXACT_LIGHTS, "ends", False, False, "exact"), SLOW),
        ("grids", (DISTANCES, "reverse", True, True, "grid"), SLOW),
        ("grids, samples", (DISTANCES, "samples", False, False, "grid"), SLOW),
        *((family, (CUBIC, "reverse", True, True, family), SLOW) for family in ("cubic", "network")),
        ("curves", (CURVES, "reverse", True, False, "tubes"), SLOW),
    ],
    "boundary.silhouette.media_secondary.make_media_secondary_silhouette_kernel": [
        ("reverse", (EXACT_MEDIA, "reverse", True, True, "exact", True), SLOW),
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
        ("indirect, lights behind sheets", (POINTS_PASS, "reverse", True, True, False, True), SLOW),
        ("indirect, guided, lights", (ALL_LIGHTS, "forward", True, True, True, True), SLOW),
        ("indirect target, textures", (TEXTURED, "target", False, False, False, True), SLOW),
        ("noted, simple", (NOTED, "reverse", False, False), SLOW),
    ],
    "boundary.guiding.projective.make_seeds_kernel": [
        ("blocked, simple", (SIMPLE, BLOCKED_LIGHT), SLOW),
        ("blocked, lights", (ALL_LIGHTS, BLOCKED_LIGHT), SLOW),
        ("scattered, materials", (MATERIALS, SCATTERED), SLOW),
        ("blocked, media", (MEDIA, BLOCKED_LIGHT), SLOW),
        ("scattered, media", (MEDIA, SCATTERED), SLOW),
    ],
    "boundary.guiding.projective_exact.make_exact_seeds_kernel": [
        ("blocked lights", (EXACT_LIGHTS, BLOCKED_LIGHT), SLOW),
        ("scattered", (EXACT, SCATTERED), SLOW),
    ],
    "boundary.guiding.ends.make_ends_kernel": [("simple", (SIMPLE,), SLOW), ("lights", (ALL_LIGHTS,), SLOW)],
    "boundary.guiding.facing.make_facing_kernel": [
        ("simple", (SIMPLE.lights,), SLOW),
        ("lights", (ALL_LIGHTS.lights,), SLOW),
    ],
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
    "boundary.edge_sampling.media_edge_sampling.make_media_edge_sampling_kernel": [
        ("reverse", (MEDIA, unlit(MEDIA), "reverse", True, False, True, 16, True, 4, 8), SLOW),
        ("forward, flat", (MEDIA, unlit(MEDIA), "forward", True, False, False, 64, False, 4, 4), SLOW),
        ("grids", (GRIDS, unlit(GRIDS), "reverse", True, True, True, 16, True, 4, 4), SLOW),
    ],
}
