"""A small scene and a fit of it, as files: a wall with a 4 x 4 texture under a uniform sky, seen by two cameras."""

from pathlib import Path

import numpy as np

import warp_psdr as psdr
from warp_psdr import image_io

TEXTURE = "wall.bsdf.reflectance.data"
SKY = "sky.radiance.value"
TRUTH = np.random.default_rng(11).uniform(0.1, 0.9, size=(4, 4, 3)).astype(np.float32)

CAMERA = """
    <sensor type="perspective">
        <float name="fov" value="36"/>
        <transform name="to_world"><lookat origin="{x}, 0, 3" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="12"/> <integer name="height" value="10"/> <rfilter type="box"/>
        </film>
    </sensor>
"""
SCENE = f"""
<scene version="3.0.0">
    <integrator type="path"> <integer name="max_depth" value="3"/> </integrator>
    {CAMERA.format(x=0.0)} {CAMERA.format(x=0.4)}
    <emitter type="constant" id="sky"> <rgb name="radiance" value="1, 1, 1"/> </emitter>
    <shape type="rectangle" id="wall">
        <bsdf type="diffuse">
            <texture type="bitmap" name="reflectance">
                <string name="filename" value="texture.exr"/> <boolean name="raw" value="true"/>
            </texture>
        </bsdf>
    </shape>
</scene>
"""
CONFIG = """
scene = "scene.xml"
targets = ["target_0.exr", "target_1.exr"]
output = "out"
iterations = {iterations}
checkpoint_every = 3
views_per_step = 1
spp = 4
final_spp = 16
lr_half_life = 20

[parameters."wall.bsdf.reflectance.data"]
lr = 0.05
initial = 0.5
"""


def write_scene(folder: Path) -> Path:
    """Write the scene, with the true texture, and return its file."""
    image_io.write_image(folder / "texture.exr", TRUTH)
    path = folder / "scene.xml"
    path.write_text(SCENE)
    return path


def write_fit(folder: Path, iterations: int = 8) -> Path:
    """Write the scene, targets that it renders, and a configuration that has to find the texture."""
    scene = psdr.load_file(write_scene(folder))
    for sensor in range(2):
        image = psdr.render(scene, sensor=sensor, spp=128, seed=1000 + sensor).numpy()
        image_io.write_image(folder / f"target_{sensor}.exr", image)
    path = folder / "fit.toml"
    path.write_text(CONFIG.format(iterations=iterations))
    return path
