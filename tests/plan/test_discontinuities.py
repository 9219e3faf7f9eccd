"""What the plan lists as a moving discontinuity, and that drivers refuse to leave it out in silence."""

import numpy as np
import pytest

import warp_psdr as psdr


def scene_with(*, card: bool = True, **objects):
    """Load a camera, a card to look at, and more."""
    camera = {
        "type": "perspective",
        "to_world": psdr.Transform.look_at((0, 0, 4), (0, 0, 0)),
        "film": {"type": "hdrfilm", "width": 4, "height": 3},
    }
    objects |= {"card": {"type": "rectangle"}} if card else {}
    return psdr.load_dict({"type": "scene", "camera": camera, **objects})


def spot(cutoff: float, beam: float) -> dict:
    to_world = psdr.Transform.look_at((0, 0, 3), (0, 0, 0))
    return {"type": "spot", "cutoff_angle": cutoff, "beam_width": beam, "to_world": to_world}


def moving(scene, name: str) -> tuple[str, ...]:
    params = psdr.traverse(scene)
    params.requires_grad(name)
    integrator = psdr.PathIntegrator(max_depth=2, boundary=None)
    return psdr.plan(scene, params, integrator=integrator).discontinuities


@pytest.mark.parametrize("name", ["lamp.to_world", "lamp.cutoff_angle", "lamp.beam_width"])
def test_a_spot_without_a_soft_edge_has_a_moving_edge(name: str) -> None:
    (reason,) = moving(scene_with(lamp=spot(20.0, 20.0)), name)
    assert reason.startswith(name) and "hard edge of the cone" in reason


@pytest.mark.parametrize("name", ["lamp.cutoff_angle", "lamp.beam_width"])
def test_a_spot_with_a_soft_edge_has_none(name: str) -> None:
    scene = scene_with(lamp=spot(20.0, 15.0))
    assert moving(scene, name) == ()
    (reason,) = moving(scene, "lamp.to_world")
    assert "hard shadows" in reason and "cone" not in reason
    # The angles of now count, not those of the file.
    params = psdr.traverse(scene)
    params["lamp.beam_width"] = 20.0
    params.update()
    assert "hard edge of the cone" in moving(scene, name)[0]


def test_a_beam_wider_than_the_cone_is_refused() -> None:
    with pytest.raises(ValueError, match="beam_width is 25 and cutoff_angle 20"):
        scene_with(lamp=spot(20.0, 25.0))


@pytest.mark.parametrize(
    ("name", "light"),
    [
        ("lamp.position", {"type": "point", "position": [0, 0, 3]}),
        ("lamp.to_world", {"type": "directional", "direction": [0, 0, -1]}),
        ("lamp.to_world", spot(20.0, 20.0)),
    ],
)
def test_moved_lights_without_extent_move_hard_shadows(name: str, light: dict) -> None:
    (reason,) = moving(scene_with(lamp=light), name)
    assert "hard shadows" in reason
    assert moving(scene_with(lamp=light, sky={"type": "constant"}, card=False), name) == ()


def test_what_is_bright_moves_nothing() -> None:
    scene = scene_with(
        lamp=spot(20.0, 20.0),
        point={"type": "point"},
        sky={"type": "envmap", "bitmap": np.ones((4, 8, 3), np.float32)},
        glass={"type": "sphere", "bsdf": {"type": "dielectric"}},
    )
    for name in ("lamp.intensity.value", "point.intensity.value", "sky.data", "sky.scale", "sky.to_world"):
        assert moving(scene, name) == ()
    assert "interface" in moving(scene, "glass.bsdf.eta")[0]


def test_nothing_is_left_out_in_silence() -> None:
    scene = scene_with(lamp=spot(20.0, 20.0))
    params = psdr.traverse(scene)
    params.requires_grad("lamp.cutoff_angle")
    with pytest.raises(ValueError, match="hard edge of the cone"):
        psdr.render_backward(scene, params, np.ones((3, 4, 3)), integrator=psdr.PathIntegrator(max_depth=2), spp=1)
    with pytest.raises(ValueError, match="hard edge of the cone"):
        psdr.render_forward(scene, params, {"lamp.cutoff_angle": 1.0}, integrator=psdr.PathIntegrator(max_depth=2))


GLASS = {"type": "sphere", "bsdf": {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.2}}


def test_glass_has_mitsubas_name_for_its_index_of_refraction() -> None:
    params = psdr.traverse(scene_with(glass=GLASS, sky={"type": "constant"}))
    assert params["glass.bsdf.eta"].numpy().tolist() == pytest.approx([1.25])
    assert "glass.bsdf.eta.value" not in params


@pytest.mark.slow
def test_both_modes_agree_on_an_index_of_refraction() -> None:
    scene = scene_with(glass=GLASS, sky={"type": "envmap", "bitmap": np.linspace(0, 9, 96).reshape(4, 8, 3)})
    params = psdr.traverse(scene)
    params.requires_grad("glass.bsdf.eta")
    options = {"integrator": psdr.PathIntegrator(max_depth=6, boundary=None), "spp": 16}
    psdr.render_backward(scene, params, np.ones((3, 4, 3)), **options)
    total = psdr.render_forward(scene, params, {"glass.bsdf.eta": 1.0}, **options).numpy().sum()
    assert total != 0.0
    # Absorbs float32 rounding: the two modes add the same terms in different orders.
    assert params["glass.bsdf.eta"].grad.numpy()[0] == pytest.approx(total, rel=1e-3)


@pytest.mark.parametrize(
    ("bsdf", "light", "name", "match"),
    [
        (
            {"type": "mask", "opacity": {"type": "checkerboard"}, "bsdf": {"type": "diffuse"}}, {"type": "point"},
            "lamp.position", "light of 'lamp' passes shape 'veil'.*a texture of 'veil' has steps.*bilinear",
        ),
        (
            {"type": "mask", "bsdf": {"type": "plastic"}}, {"type": "constant"}, "card.to_world",
            r"'veil', a 'mask\(plastic\)', scatters smoothly, reflects as a mirror and lets light pass",
        ),
    ],
)  # fmt: skip
def test_what_moves_beside_a_null_lobe_is_refused_by_name(bsdf: dict, light: dict, name: str, match: str) -> None:
    scene = scene_with(
        veil={"type": "rectangle", "to_world": psdr.Transform.translate([0, 0, 0.1]), "bsdf": bsdf}, lamp=light
    )
    params = psdr.traverse(scene)
    params.requires_grad(name)
    with pytest.raises(ValueError, match=match):
        psdr.plan(scene, params, integrator=psdr.PathIntegrator(max_depth=3))
    # What moves nothing is not.
    params.requires_grad_only("card.bsdf.reflectance.value")
    assert psdr.plan(scene, params, integrator=psdr.PathIntegrator(max_depth=3)).config.through


@pytest.mark.parametrize(
    ("bsdf", "light", "name"),
    [
        ({"type": "null"}, {"type": "point"}, "card.to_world"),
        ({"type": "null"}, {"type": "point"}, "lamp.position"),
        ({"type": "null"}, {"type": "directional"}, "camera.to_world"),
        ({"type": "thindielectric"}, spot(20.0, 15.0), "veil.to_world"),
    ],
)
def test_shadow_rays_to_lights_of_no_area_pass_null_lobes_while_something_moves(bsdf, light, name) -> None:
    veil = {"type": "rectangle", "to_world": psdr.Transform.translate([0, 0, 0.1]), "bsdf": bsdf}
    scene = scene_with(veil=veil, lamp=light)
    plan = psdr.plan(scene, names=[name], integrator=psdr.PathIntegrator(max_depth=3))
    assert plan.config.points_pass and not plan.config.through and plan.boundary is not None
    assert "those of lights of no area" in str(plan)


def test_where_shadow_rays_pass_no_null_lobe_the_error_says_what_does() -> None:
    veil = {"type": "rectangle", "to_world": psdr.Transform.translate([0, 0, 0.1]), "bsdf": {"type": "null"}}
    ball = {"type": "sphere", "radius": 0.1, "exact": True}
    for scene, options, match in (
        (scene_with(veil=veil, lamp={"type": "point"}, ball=ball), {}, "without triangles; give them triangles"),
        (
            scene_with(veil=veil, lamp={"type": "point"}),
            {"boundary": psdr.boundary.WarpedArea()},
            r"WarpedArea\(\) does not know it; use boundary.PathSpace\(\)",
        ),
        (
            scene_with(veil={"type": "cube", "bsdf": {"type": "thindielectric"}}, lamp={"type": "point"}),
            {},
            "another part of it on either side of its creases",
        ),
    ):
        with pytest.raises(ValueError, match=match):
            psdr.plan(scene, names=["card.to_world"], integrator=psdr.PathIntegrator(max_depth=3, **options))


@pytest.mark.parametrize("name", ["card.to_world", "lamp.position", "camera.to_world"])
def test_what_moves_beside_a_null_lobe_is_taken_where_its_light_is_left_out(name: str) -> None:
    veil = {"type": "rectangle", "to_world": psdr.Transform.translate([0, 0, 0.1]), "bsdf": {"type": "null"}}
    scene = scene_with(veil=veil, lamp={"type": "point"})
    plan = psdr.plan(scene, names=[name], integrator=psdr.PathIntegrator(max_depth=3, caustics=False))
    assert plan.discontinuities and not plan.config.through
    assert "caustics=False leaves out" in str(plan)
    # Paths find the light of lamps with an area: shadow rays pass.
    area = scene_with(veil=veil, lamp={"type": "rectangle", "emitter": {"type": "area"}})
    assert psdr.plan(area, names=[], integrator=psdr.PathIntegrator(max_depth=3, caustics=False)).config.through
