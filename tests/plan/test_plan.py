"""The plan: what it says, what is compiled, and that nothing else is."""

import dataclasses
import sys

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.gradients import scenes
from tests.plan.generated import generated
from warp_psdr.estimate import passes
from warp_psdr.kernels import path as path_module
from warp_psdr.kernels.bsdf import dispatch
from warp_psdr.kernels.bsdf.model import Model
from warp_psdr.kernels.primal import make_primal_kernel
from warp_psdr.rows.table import TABLE, row_of

INTEGRATOR = psdr.PathIntegrator(max_depth=4, boundary=None)
#: Words of models that a scene of diffuse surfaces and one area light has no use for.
FOREIGN = ("microfacet", "ggx", "beckmann", "roughness", "alpha_u", "fresnel", "dielectric", "conductor", "refract")
FOREIGN += ("envmap", "env_cell", "environment_eval", "constant_eval", "spot", "point_sample", "directional_sample")


def diffuse_scene():
    scene = scenes.gap_scene()
    scene["floor"]["bsdf"] = {"type": "diffuse", "reflectance": scenes.rgb(0.5, 0.4, 0.3)}
    del scene["floor"]["vertex_color"]
    scene["ceiling"]["emitter"]["radiance"] = scenes.rgb(1.0, 1.0, 1.0)
    return psdr.load_dict({"type": "scene", **scene})


@pytest.fixture(scope="module")
def diffuse():
    scene = diffuse_scene()
    return scene, psdr.traverse(scene)


def functions_of(kernel):
    """Generated source without the records, whose fields are the same in every scene, and without file names.

    ``structs.Scene`` names its environment arrays whether they are used or not.
    """
    lines = generated(kernel)[1].splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("static") and "_atomic" not in line)
    return "\n".join(lines[first:]).lower()


@pytest.mark.parametrize("kind", ["primal", "reverse"])
def test_a_diffuse_scene_holds_no_code_of_other_models(diffuse, kind):
    scene, _params = diffuse
    plan = psdr.plan(scene, names=["floor.bsdf.reflectance.value"], integrator=INTEGRATOR)
    kernel = make_primal_kernel(plan.config) if kind == "primal" else passes.camera_gradient_kernels(plan, "reverse")[0]
    source = functions_of(kernel)
    assert "diffuse" in source  # the search looks at the right text
    found = {}
    for word in FOREIGN:
        lines = [line for line in source.splitlines() if word in line and "var_environment" not in line]
        if lines:
            found[word] = lines[:3]
    assert not found


def test_the_search_finds_foreign_code():
    scene, _params = scenes.load("rough")
    source = functions_of(make_primal_kernel(psdr.plan(scene, integrator=INTEGRATOR).config))
    assert "ggx" in source or "microfacet" in source


def module_hash(scene, names):
    """Hashes of the primal and of the reverse kernel, freshly generated."""
    for module in list(sys.modules.values()):
        if getattr(module, "__name__", "").startswith("warp_psdr.kernels"):
            for value in list(vars(module).values()):
                if hasattr(value, "cache_clear"):
                    value.cache_clear()
    plan = psdr.plan(scene, names=names, integrator=INTEGRATOR)
    kernels = make_primal_kernel(plan.config), passes.camera_gradient_kernels(plan, "reverse")[0]
    return [k.module.get_module_hash() for k in kernels]


def test_an_unused_feature_leaves_the_kernels_of_other_scenes_alone(diffuse, monkeypatch):
    scene, _params = diffuse
    names = ["floor.bsdf.reflectance.value"]
    before = module_hash(scene, names)
    assert before == module_hash(scene, names)  # the hash does not depend on the process's history

    def never(record, variant):
        raise AssertionError("the factory of a model that the scene does not use was called")

    monkeypatch.setitem(dispatch.VARIANTS, "never", (Model("never", (), (), never), ""))
    assert module_hash(scene, names) == before
    # A changed feature that is in use does change it.
    diffuse_model, variant = dispatch.VARIANTS["diffuse"]

    def make_half(record, variant):
        other = diffuse_model.make(record, variant)

        @wp.func
        def half_diffuse(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
            return 0.5 * other.eval(mat, wi, wo)

        return other._replace(eval=half_diffuse)

    halved = dataclasses.replace(diffuse_model, make=make_half)
    monkeypatch.setitem(dispatch.VARIANTS, "diffuse", (halved, variant))
    assert module_hash(scene, names) != before
    monkeypatch.undo()
    assert module_hash(scene, names) == before


@pytest.mark.slow
def test_one_albedo_compiles_no_geometry(diffuse):
    scene, _params = diffuse
    albedo = psdr.plan(scene, names=["floor.bsdf.reflectance.value"], integrator=INTEGRATOR)
    everything = psdr.plan(scene, names=list(scene.parameters), integrator=INTEGRATOR)
    assert not albedo.wanted.geometry and everything.wanted.geometry
    assert [slot.name for slot in albedo.config.surfaces.material] == ["reflectance"]
    assert albedo.wanted.material == (True,)
    words = ("barycentrics_dot", "connection_vjp", "normalize_vjp", "accumulate_vertex", "camera_vjp")
    small, large = (functions_of(passes.camera_gradient_kernels(plan, "reverse")[0]) for plan in (albedo, everything))
    # A function's own definition is emitted as "static ... name_0("; closures of what is not called are not.
    assert [w for w in words if f" {w}_" in small] == []
    assert [w for w in words if f" {w}_" in large], "the words are out of date"
    assert len(small) < 0.85 * len(large)  # the paths are the same in both


@pytest.mark.smoke
def test_the_plan_says_what_and_why(diffuse):
    scene, params = diffuse
    params.requires_grad_only("floor.bsdf.reflectance.value")
    plan = psdr.plan(scene, params, integrator=INTEGRATOR)
    table = {item: (decision, reason) for item, decision, reason in plan.lines}
    assert table["materials"] == ("diffuse", "no dispatch")
    assert table["lights"][0] == "area"
    assert table["depth"] == ("4", "at most 4 vertices")
    assert table["differentiated"][0] == "floor.bsdf.reflectance.value"
    assert table["moving vertices"][0] == "no"
    assert table["interior"] == ("record and sweep, K = 4", "the whole path fits, one trace")
    assert table["boundary term"] == ("not run", "no requested parameter moves a discontinuity")
    for item, (decision, reason) in table.items():
        assert decision and reason, f"{item} has no decision or no reason"
    text = str(plan)
    assert len(text.splitlines()) == len(plan.lines)
    assert all(part in text for line in plan.lines for part in line)
    params.requires_grad_only()
    assert "no parameter is requested" in str(psdr.plan(scene, params, integrator=INTEGRATOR))


def test_the_plan_of_a_richer_scene():
    scene, _params = scenes.load("plane")
    table = dict(line[:2] for line in psdr.plan(scene, integrator=psdr.PathIntegrator()).lines)
    assert table["lights"] == "envmap, point, spot, directional"
    assert "bitmap" in table["material values"]
    assert table["texture coordinates"] == "yes"
    assert table["depth"] == "-1"
    assert table["sampler"] == "sobol"
    table = dict(line[:2] for line in psdr.plan(scenes.load("brushed")[0]).lines)
    assert table["materials"] == "diffuse, roughconductor (beckmann)"
    assert table["anisotropy"] == "yes"


def test_depth_one_compiles_no_scattering(diffuse):
    scene, _params = diffuse
    plan = psdr.plan(scene, integrator=psdr.PathIntegrator(max_depth=1))
    assert not plan.config.scatter
    assert "diffuse" not in functions_of(make_primal_kernel(plan.config))


@pytest.mark.parametrize(
    ("block", "depth", "expected"),
    [
        (8, 4, (4, 1)),
        (8, 8, (8, 1)),
        (8, 9, (8, 2)),
        (3, 16, (3, 8)),
        (1, 5, (1, 8)),
        (8, 64, (8, 8)),
        (8, -1, (8, 64)),
    ],
)
def test_blocks(diffuse, block, depth, expected):
    integrator = psdr.PathIntegrator(max_depth=depth, interior=psdr.interior.Replay(block=block))
    plan = psdr.plan(diffuse[0], names=["floor.bsdf.reflectance.value"], integrator=integrator)
    assert (plan.kept.block, plan.kept.blocks) == expected
    assert depth < 0 or plan.kept.longest >= depth


def test_textbook_replay_is_a_method_of_its_own(diffuse):
    integrator = psdr.PathIntegrator(max_depth=64, interior=psdr.interior.Textbook())
    plan = psdr.plan(diffuse[0], names=["floor.bsdf.reflectance.value"], integrator=integrator)
    assert plan.kept.longest == 0 and plan.kept.bias
    _item, decision, reason = next(line for line in plan.lines if line[0] == "interior")
    assert decision == "textbook replay" and "factors that are exactly zero are lost" in reason
    assert psdr.plan(diffuse[0], integrator=integrator).interior is None, "nothing is differentiated"


def test_every_interior_method_has_a_row_beside_every_boundary_method():
    methods = [kind() for kind in psdr.interior.Method.__subclasses__()]
    assert {type(m) for m in methods} == {m for m, _kind in TABLE}
    terms = [None, psdr.boundary.PathSpace(), psdr.boundary.EdgeSampling(), psdr.boundary.Projective()]
    assert all(row_of(method, term).label for method in methods for term in terms)

    class Another(psdr.interior.Method):
        pass

    message = r"interior\.Another\(\) has no kernel beside PathSpace\(\); use interior\.Replay\(\)"
    with pytest.raises(ValueError, match=message):
        row_of(Another(), terms[1])


def test_a_name_that_is_none_is_refused_with_one_that_is(diffuse):
    with pytest.raises(KeyError, match=r"no parameter 'floor.bsdf.reflectance'; did you mean 'floor"):
        psdr.plan(diffuse[0], names=["floor.bsdf.reflectance"])


def test_moving_discontinuities_are_named_and_never_left_out_in_silence(diffuse):
    scene, params = diffuse
    name = "ceiling.vertex_positions"
    params.requires_grad_only("floor.bsdf.reflectance.value", name)
    left_out = psdr.plan(scene, params, integrator=INTEGRATOR)
    assert len(left_out.discontinuities) == 1 and left_out.discontinuities[0].startswith(name)
    line = next(line for line in left_out.lines if line[0] == "boundary term")
    assert line[1] == "left out" and name in line[2] and "boundary=None" in line[2]
    params.requires_grad_only("floor.bsdf.reflectance.value")
    assert psdr.plan(scene, params, integrator=psdr.PathIntegrator()).discontinuities == ()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_depth": 0}, "max_depth: got 0"),
        ({"max_depth": -2}, "max_depth: got -2"),
        ({"max_depth": 1 << 32}, "max_depth: got 4294967296, expected at most"),
        ({"rr_depth": 1 << 31}, "rr_depth: got 2147483648, expected at most"),
        ({"max_depth": 2.0}, "max_depth: expected an integer"),
        ({"max_depth": True}, "max_depth: expected an integer"),
        ({"rr_depth": 0}, "rr_depth: got 0"),
        ({"rr_depth": "5"}, "rr_depth: expected an integer"),
        ({"sampler": "halton"}, "sampler: got 'halton'"),
        ({"interior": "replay"}, "interior: got 'replay'"),
        ({"boundary": False}, "boundary: got False"),
        ({"boundary": "none"}, "boundary: got 'none'"),
    ],
)
def test_a_bad_integrator_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        psdr.PathIntegrator(**options)


@pytest.mark.parametrize("block", [-1, 0, 65, 8.0, True, None])
def test_a_bad_block_is_refused(block):
    named = r".*is interior\.Textbook\(\)" if block == 0 else ""
    with pytest.raises(ValueError, match=f"block: got{named}"):
        psdr.interior.Replay(block=block)


def test_options_are_frozen_and_keyword_only():
    integrator = psdr.PathIntegrator()
    with pytest.raises(dataclasses.FrozenInstanceError):
        integrator.max_depth = 3
    with pytest.raises(TypeError):
        psdr.PathIntegrator(3)
    assert hash(psdr.PathIntegrator(max_depth=3)) == hash(psdr.PathIntegrator(max_depth=3))


def test_the_scene_file_names_the_integrator(diffuse):
    node = {"type": "scene", **scenes.gap_scene(), "integrator": {"type": "path", "max_depth": 3, "rr_depth": 7}}
    plan = psdr.plan(psdr.load_dict(node))
    assert (plan.max_depth, plan.rr_depth) == (3, 7)
    assert psdr.plan(diffuse[0]).max_depth == -1


@pytest.mark.parametrize("spp", [0, -1, 1.5, "4", True])
def test_a_bad_sample_count_is_refused(diffuse, spp):
    scene, params = diffuse
    params.requires_grad_only("floor.bsdf.reflectance.value")
    ones = np.ones((scenes.SIZE, scenes.SIZE, 3), np.float32)
    for call in (
        lambda: psdr.render(scene, spp=spp),
        lambda: psdr.render_backward(scene, params, ones, spp=spp),
        lambda: psdr.render_forward(scene, params, {"floor.bsdf.reflectance.value": 1.0}, spp=spp),
    ):
        with pytest.raises(ValueError, match="spp: got"):
            call()


def test_slots_per_vertex_leave_room_for_both_decisions():
    # Slot 0 is the camera's; two vertices must never share one.
    used = [0] + [k + path_module.SLOTS_PER_VERTEX * depth for depth in range(50) for k in (1, 2)]
    assert len(set(used)) == len(used)
