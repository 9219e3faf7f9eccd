"""The primal image: estimators that must share a mean, light selection, finite values, and Mitsuba's ``path``."""

import numpy as np
import pytest
from scipy import stats

import warp_psdr as psdr
from tests.path.helpers import SCENES, SIGNIFICANCE, assert_mean, assert_same_mean, batches, blocks
from tests.peer import MITSUBA_ROUNDING

BOX = SCENES / "cornell_box.xml"

HEAD = """<scene version="3.0.0"><integrator type="path"><integer name="max_depth" value="{depth}"/></integrator>
<sensor type="perspective"><float name="fov" value="40"/>
    <transform name="to_world"><lookat origin="0, -4, 2.5" target="0, 0, 0.4" up="0, 0, 1"/></transform>
    <film type="hdrfilm"><integer name="width" value="24"/><integer name="height" value="24"/><rfilter type="box"/>
    </film></sensor>
<shape type="rectangle" id="floor"><transform name="to_world"><scale value="2"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.7, 0.5, 0.3"/></bsdf></shape>
"""
SKY = '<emitter type="constant"><rgb name="radiance" value="0.6, 0.8, 1"/></emitter>'
LAMP = """<shape type="rectangle"><transform name="to_world"><scale value="0.4"/><rotate x="1" angle="150"/>
    <translate x="0.5" y="-0.5" z="2"/></transform><emitter type="area"><rgb name="radiance" value="9, 8, 7"/></emitter>
    </shape>"""


def object_scene(bsdf, lights, shape="cube", depth=5, extra=""):
    body = f'<shape type="{shape}" id="object">{extra}<transform name="to_world"><scale value="0.6"/>'
    body += f'<rotate z="1" angle="30"/><translate z="0.7"/></transform>{bsdf}</shape>{lights}</scene>'
    return HEAD.format(depth=depth) + body


def rough(distribution, alpha):
    return f"""<bsdf type="roughconductor"><string name="material" value="Au"/>
        <string name="distribution" value="{distribution}"/>{alpha}</bsdf>"""


def principled(kind="principled", **numbers):
    given = "".join(f'<float name="{name}" value="{value}"/>' for name, value in numbers.items())
    color = '<rgb name="base_color" value="0.7, 0.4, 0.2"/>'
    return f'<bsdf type="{kind}"><float name="roughness" value="0.4"/>{color}{given}</bsdf>'


#: Small versions of what the renderer supports, each compared with Mitsuba. Where Mitsuba's shape is analytic and ours
#: tessellated, the shape is a cube.
MITSUBA_CASES = {
    "diffuse under a lamp": object_scene("", LAMP),
    "sky and lamp": object_scene("", SKY + LAMP),
    "glass": object_scene('<bsdf type="dielectric"/>', SKY + LAMP, depth=8),
    "thin glass": object_scene(
        """<bsdf type="thindielectric"><rgb name="specular_reflectance" value="0.9, 0.8, 0.7"/>
        <rgb name="specular_transmittance" value="0.6, 0.8, 1"/></bsdf></shape><shape type="rectangle"><transform
        name="to_world"><scale value="2"/><translate z="1.5"/></transform><bsdf type="null"/>""",
        SKY + LAMP,
        depth=8,
    ),
    "mirror": object_scene('<bsdf type="conductor"><string name="material" value="Cu"/></bsdf>', SKY + LAMP),
    "rough GGX": object_scene(rough("ggx", '<float name="alpha" value="0.3"/>'), SKY + LAMP),
    "rough Beckmann": object_scene(rough("beckmann", '<float name="alpha" value="0.15"/>'), LAMP),
    "anisotropic": object_scene(
        rough("ggx", '<float name="alpha_u" value="0.05"/><float name="alpha_v" value="0.4"/>'), LAMP
    ),
    "plastic": object_scene('<bsdf type="plastic"><boolean name="nonlinear" value="true"/></bsdf>', SKY + LAMP),
    "rough plastic": object_scene('<bsdf type="roughplastic"><float name="alpha" value="0.2"/></bsdf>', SKY + LAMP),
    "rough glass": object_scene(
        """<bsdf type="roughdielectric"><string name="distribution" value="ggx"/><float name="alpha" value="0.3"/>
        <rgb name="specular_transmittance" value="0.6, 0.8, 1"/></bsdf>""",
        SKY + LAMP,
        depth=8,
    ),
    "principled": object_scene(principled(metallic=0.3, anisotropic=0.5, sheen=0.6, clearcoat=0.9, flatness=0.4), LAMP),
    "principled glass": object_scene(principled(spec_trans=0.7, spec_tint=0.4, eta=1.4), SKY + LAMP, depth=8),
    "paper": object_scene(principled(kind="principledthin", diff_trans=1.2, sheen=0.5), SKY + LAMP, depth=8),
    "point, spot and sun": object_scene(
        "",
        """<emitter type="point"><point name="position" x="1" y="-1" z="1.5"/><rgb name="intensity" value="1, 2, 3"/>
        </emitter><emitter type="spot"><transform name="to_world"><lookat origin="-1, -1, 2" target="0, 0, 0"
        up="0, 0, 1"/></transform><rgb name="intensity" value="6, 4, 2"/><float name="cutoff_angle" value="25"/>
        </emitter><emitter type="directional"><vector name="direction" x="0.3" y="0.5" z="-1"/></emitter>""",
    ),
    "hidden emitters": object_scene("", SKY + LAMP).replace(
        "</integrator>", '<boolean name="hide_emitters" value="true"/></integrator>'
    ),
    "two sides": object_scene(
        """<bsdf type="twosided"><bsdf type="diffuse"><rgb name="reflectance" value="0.1, 0.5, 0.9"/></bsdf>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.9, 0.5, 0.1"/></bsdf></bsdf>""",
        SKY + LAMP,
        extra='<boolean name="flip_normals" value="true"/>',
    ),
}


SLOW = ("plastic", "rough plastic", "rough glass", "principled", "paper", "principled glass")


@pytest.mark.slow_rows(
    "glass",
    "rough GGX",
    "hidden emitters",
    "point, spot and sun",
    "thin glass",
    "mirror",
    "rough Beckmann",
    "anisotropic",
    "two sides",
)
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in MITSUBA_CASES]
)
def test_equals_mitsuba(name):
    """Blocks of 6 x 6 pixels have the mean of Mitsuba's ``path``."""
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    ours = batches(psdr.load_string(MITSUBA_CASES[name]), spp=16)
    scene = mitsuba.load_string(MITSUBA_CASES[name])
    theirs = np.stack([np.array(mitsuba.render(scene, spp=16, seed=i)) for i in range(len(ours))]).astype(np.float64)
    assert_same_mean(blocks(ours, 6), blocks(theirs, 6), name, MITSUBA_ROUNDING)


def test_cornell_box_equals_mitsuba():
    """The file in ``scenes`` unchanged, with the border, where its tent filter ends."""
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    ours = batches(psdr.load_file(BOX, resolution=32), spp=16)
    scene = mitsuba.load_file(str(BOX), resolution=32)
    theirs = np.stack([np.array(mitsuba.render(scene, spp=16, seed=i)) for i in range(len(ours))]).astype(np.float64)
    assert_same_mean(blocks(ours, 8), blocks(theirs, 8), "Cornell box", 1e-2)
    assert_same_mean(ours[:, 0].mean(axis=1), theirs[:, 0].mean(axis=1), "Cornell box, first row", 1e-2)


@pytest.mark.slow
def test_samplers_agree():
    scene = psdr.load_file(BOX, resolution=32)
    sobol, independent = (batches(scene, spp=16, max_depth=6, sampler=s) for s in ("sobol", "independent"))
    assert_same_mean(blocks(sobol, 8), blocks(independent, 8), "samplers")
    # Sobol points are the default because they are better: less variance at the same number of samples.
    assert np.median(sobol.var(axis=0)) < 0.9 * np.median(independent.var(axis=0))


@pytest.mark.slow_rows("1")
@pytest.mark.parametrize("rr_depth", [1, 3])
def test_russian_roulette_keeps_the_mean(rr_depth):
    scene = psdr.load_file(BOX, resolution=32)
    with_roulette, without = (batches(scene, spp=16, max_depth=8, rr_depth=d) for d in (rr_depth, 1000))
    assert_same_mean(blocks(with_roulette, 8), blocks(without, 8), "Russian roulette")
    # It does end paths, or there is nothing to compare.
    assert not np.array_equal(with_roulette, without)


@pytest.mark.slow
def test_roulette_through_glass_keeps_the_mean():
    """Radiance grows by the squared index inside glass; the survival probability must not depend on that."""
    scene = psdr.load_string(MITSUBA_CASES["glass"])
    with_roulette, without = (batches(scene, spp=16, max_depth=10, rr_depth=d) for d in (2, 1000))
    assert_same_mean(blocks(with_roulette, 6), blocks(without, 6), "Russian roulette through glass")


@pytest.mark.slow
def test_a_thousand_lights():
    """Selection among 1,000 lights of very different power is unbiased: the sum of the closed forms."""
    rng = np.random.default_rng(3)
    position = rng.uniform([-4, -4, 0.5], [4, 4, 3.0], (1000, 3))
    intensity = 10.0 ** rng.uniform(-4, 0, (1000, 3))
    lights = "".join(
        f'<emitter type="point"><point name="position" x="{p[0]}" y="{p[1]}" z="{p[2]}"/>'
        f'<rgb name="intensity" value="{i[0]}, {i[1]}, {i[2]}"/></emitter>'
        for p, i in zip(position, intensity, strict=True)
    )
    head = HEAD.replace('name="fov" value="40"', 'name="fov" value="0.01"').replace("0, 0, 0.4", "0, 0, 0")
    scene = psdr.load_string(head.format(depth=2) + lights + "</scene>")
    distance = np.linalg.norm(position, axis=1)
    expected = np.array([0.7, 0.5, 0.3]) / np.pi * (intensity * (position[:, 2] / distance**3)[:, None]).sum(axis=0)
    images = batches(scene, count=4, spp=64, max_depth=2)
    assert_mean(images.reshape(-1, 3), expected, "1,000 lights")


def test_light_is_selected_by_power():
    """With one strong light among weak ones, selection by power leaves little noise."""
    lights = "".join(
        f'<emitter type="point"><point name="position" x="{x}" y="0" z="1"/>'
        f'<float name="intensity" value="{i}"/></emitter>'
        for x, i in [(0.0, 100.0), *((0.1 * k, 0.01) for k in range(50))]
    )
    scene = psdr.load_string(HEAD.format(depth=2) + lights + "</scene>")
    images = batches(scene, count=16, spp=4, max_depth=2)
    floor = images.mean(axis=0) > 1.0
    assert floor.any()
    # Uniform selection among 51 lights would have a relative deviation of sqrt(50 / 4) = 3.5.
    assert np.median((images.std(axis=0) / images.mean(axis=0).clip(1e-9))[floor]) < 0.2


@pytest.mark.slow
def test_extreme_scenes_stay_finite():
    """Grazing light, tiny roughness, a light that touches a surface, indices near 1: finite and not negative."""
    lamp = LAMP.replace('z="2"', 'z="0.05"')
    for bsdf, lights in [
        (rough("ggx", '<float name="alpha" value="0.001"/>'), lamp + SKY),
        (rough("beckmann", '<float name="alpha_u" value="0.001"/><float name="alpha_v" value="1"/>'), lamp),
        ('<bsdf type="dielectric"><float name="int_ior" value="1.0000001"/></bsdf>', lamp + SKY),
        ('<bsdf type="dielectric"><float name="int_ior" value="1"/><float name="ext_ior" value="3"/></bsdf>', SKY),
        ('<bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>', lamp),
    ]:
        images = batches(psdr.load_string(object_scene(bsdf, lights, "sphere")), count=1, spp=16, max_depth=-1)
        assert images.min() >= 0.0 and images.max() > 0.0


def test_seeds_give_independent_images():
    """Neighbouring seeds are uncorrelated, equal seeds are equal bit for bit."""
    scene = psdr.load_file(BOX, resolution=32)
    images = batches(scene, count=64, spp=4, max_depth=4)
    again = batches(scene, count=1, spp=4, max_depth=4)
    np.testing.assert_array_equal(images[0], again[0])
    noise = images - images.mean(axis=0)
    # A sample counts for several pixels, and bright ones are rare: pairs of images are independent draws, not pixels.
    pairs = [np.corrcoef(a.reshape(-1), b.reshape(-1))[0, 1] for a, b in zip(noise[0::2], noise[1::2], strict=True)]
    # Centring on the mean of 64 leaves a correlation of -1/63 between two of them.
    z = (np.mean(pairs) + 1.0 / 63.0) / stats.sem(pairs)
    assert abs(z) < stats.t.isf(SIGNIFICANCE, len(pairs) - 1)
