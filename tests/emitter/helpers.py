"""A scene that is one light and nothing else, and the kernels that ask it for samples, values and derivatives."""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

import warp_psdr as psdr
from warp_psdr.kernels import constants as c
from warp_psdr.kernels.emitter.dispatch import make_lights
from warp_psdr.kernels.structs import Emitter, Scene, Texture
from warp_psdr.scene.lights.light_sampling import build_env_distribution, with_guide

ALL_KINDS = (
    c.EMITTER_CONSTANT,
    c.EMITTER_ENVMAP,
    c.EMITTER_POINT,
    *sorted(c.SPOTS),
    c.EMITTER_PROJECTOR,
    c.EMITTER_DIRECTIONAL,
)
BOTH = ("pose", "radiance")
ROTATION = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
ENVIRONMENTS = (c.EMITTER_CONSTANT, c.EMITTER_ENVMAP)
#: Normalising the direction first moves the weights of texels by some float32 roundings, relative to the brightest one.
SAME_LOOKUP = 1e-5


def pose(rotation=ROTATION, translation=(0.0, 0.0, 0.0)):
    m = np.eye(4, dtype=np.float32)
    m[:3, :3] = rotation
    m[:3, 3] = translation
    return m


def struct_array(kind, records, device):
    return wp.array(records, dtype=kind, device=device)


class Light:
    """One light in a scene without surfaces.

    ``where`` tells the flat range of each of its parameters; what lies beyond ``named`` is none.
    """

    def __init__(
        self,
        kind,
        device="cpu",
        *,
        radiance,
        to_world=None,
        position=None,
        scale=None,
        angles=None,
        projected=None,
        compensated=False,
    ):
        radiance = np.asarray(radiance, np.float32)
        parts = {
            "unused": np.full(3, 7.0),
            "radiance": radiance,
            "to_world": to_world,
            "position": position,
            "scale": scale,
            "angles": angles,
            "projected": projected,
        }
        self.where, offset, flat = {}, 0, []
        for name, part in parts.items():
            if part is not None:
                part = np.asarray(part, np.float32).ravel()
                self.where[name] = slice(offset, offset + part.size)
                offset += part.size
                flat.append(part)
        self.named = offset
        self.values = np.concatenate([*flat, np.eye(3, dtype=np.float32).ravel()])
        self.device = device
        self.kind = kind
        texture = Texture()
        texture.offset = self.where["radiance"].start
        texture.channels = radiance.shape[-1]
        texture.kind = c.TEXTURE_CONSTANT
        e = Emitter()
        e.kind = kind
        e.texture = 0
        if radiance.ndim == 3:
            texture.kind = c.TEXTURE_BITMAP
            texture.height, texture.width, texture.to_uv = *radiance.shape[:2], offset
        for name in ("to_world", "position"):
            if name in self.where:
                e.to_world = self.where[name].start
        e.scale = self.where["scale"].start if scale is not None else 0
        e.cutoff = self.where["angles"].start if angles is not None else 0
        scene = Scene()
        image = Texture()
        if projected is not None:
            image.kind, image.channels = c.TEXTURE_BITMAP, projected.shape[2]
            image.height, image.width = projected.shape[:2]
            image.offset, image.to_uv = self.where["projected"].start, offset
            e.projected = 1
        scene.textures = struct_array(Texture, [texture, image], device)
        scene.emitters = struct_array(Emitter, [e], device)
        scene.environment = 0
        marginal = conditional = np.zeros(1, np.float32)
        if radiance.ndim == 3:
            marginal, conditional = map(with_guide, build_env_distribution(radiance, compensated))
        scene.env_marginal = wp.array(marginal, device=device)
        scene.env_conditional = wp.array(conditional, device=device)
        self.scene = scene

    def at(self, values=None):
        self.scene.values = wp.array(self.values if values is None else values, dtype=wp.float32, device=self.device)
        return self.scene

    def sample(self, x, u, values=None, kinds=None):
        n = len(x)
        out = {
            "wi": wp.zeros(n, dtype=wp.vec3, device=self.device),
            "radiance": wp.zeros(n, dtype=wp.vec3, device=self.device),
            "distance": wp.zeros(n, dtype=wp.float32, device=self.device),
            "pdf": wp.zeros(n, dtype=wp.float32, device=self.device),
            "delta": wp.zeros(n, dtype=wp.int32, device=self.device),
        }
        inputs = [self.at(values), to_vec(x, 3, self.device), to_vec(u, 2, self.device)]
        kernel = sample_kernel(kinds or (self.kind,))
        wp.launch(kernel, dim=n, inputs=inputs, outputs=list(out.values()), device=self.device)
        return SimpleNamespace(**{name: array.numpy() for name, array in out.items()})

    def evaluate(self, direction, values=None, kinds=None):
        """Radiance (N, 3) and density (N,) of the environment, the same from one look-up as from two."""
        n = len(direction)
        radiance, both_radiance = (wp.zeros(n, dtype=wp.vec3, device=self.device) for _ in range(2))
        pdf, both_pdf = (wp.zeros(n, dtype=wp.float32, device=self.device) for _ in range(2))
        inputs = [self.at(values), to_vec(direction, 3, self.device)]
        kernel = eval_kernel(kinds or (self.kind,))
        outputs = [radiance, pdf, both_radiance, both_pdf]
        wp.launch(kernel, dim=n, inputs=inputs, outputs=outputs, device=self.device)
        np.testing.assert_array_equal(both_pdf.numpy(), pdf.numpy())
        one, two = radiance.numpy(), both_radiance.numpy()
        np.testing.assert_allclose(two, one, rtol=SAME_LOOKUP, atol=SAME_LOOKUP * np.abs(one).max())
        return radiance.numpy(), pdf.numpy()

    def vjp(self, role, target, x, w, a_wi, wanted=BOTH, kinds=None):
        """Adjoint of x (or of the direction), forward sums, and the target afterwards."""
        n = len(x)
        # Reverse mode sums in double precision, in memory of float32 (``kernels/sink.py``).
        stored = np.asarray(target, np.float64).view(np.float32) if role == "reverse" else target
        target = wp.array(stored, dtype=wp.float32, device=self.device)
        x_out = wp.zeros(n, dtype=wp.vec3, device=self.device)
        dot_out = wp.zeros(n, dtype=wp.float32, device=self.device)
        inputs = [self.at(), target, *(to_vec(v, 3, self.device) for v in (x, w, a_wi))]
        kernel = vjp_kernel(kinds or (self.kind,), role, wanted, self.kind in ENVIRONMENTS)
        wp.launch(kernel, dim=n, inputs=inputs, outputs=[x_out, dot_out], device=self.device)
        after = target.numpy()
        return x_out.numpy(), dot_out.numpy(), after.view(np.float64) if role == "reverse" else after


def to_vec(v, n, device):
    return wp.array(np.asarray(v, np.float32), dtype=wp.vec3 if n == 3 else wp.vec2, device=device)


@functools.cache
def sample_kernel(kinds):
    sample = make_lights(kinds, None, ()).sample

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(
        scene: Scene,
        x: wp.array(dtype=wp.vec3),
        u: wp.array(dtype=wp.vec2),
        wi_out: wp.array(dtype=wp.vec3),
        radiance_out: wp.array(dtype=wp.vec3),
        distance_out: wp.array(dtype=wp.float32),
        pdf_out: wp.array(dtype=wp.float32),
        delta_out: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        s = sample(scene, scene.emitters[0], x[i], u[i])
        wi_out[i] = s.wi
        radiance_out[i] = s.radiance
        distance_out[i] = s.distance
        pdf_out[i] = s.pdf
        delta_out[i] = s.delta

    return kernel


@functools.cache
def eval_kernel(kinds):
    lights = make_lights(kinds, None, ())
    environment_eval, environment_pdf = lights.environment_eval, lights.environment_pdf
    environment_eval_pdf = lights.environment_eval_pdf

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(
        scene: Scene,
        direction: wp.array(dtype=wp.vec3),
        radiance_out: wp.array(dtype=wp.vec3),
        pdf_out: wp.array(dtype=wp.float32),
        both_radiance_out: wp.array(dtype=wp.vec3),
        both_pdf_out: wp.array(dtype=wp.float32),
    ):
        i = wp.tid()
        radiance_out[i] = environment_eval(scene, direction[i])
        pdf_out[i] = environment_pdf(scene, direction[i])
        radiance, pdf = environment_eval_pdf(scene, direction[i])
        both_radiance_out[i] = radiance
        both_pdf_out[i] = pdf

    return kernel


@functools.cache
def vjp_kernel(kinds, role, wanted, environment):
    lights = make_lights(kinds, role, wanted)
    sample, sample_vjp, environment_vjp = lights.sample, lights.sample_vjp, lights.environment_vjp

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        x: wp.array(dtype=wp.vec3),
        w: wp.array(dtype=wp.vec3),
        a_wi: wp.array(dtype=wp.vec3),
        x_out: wp.array(dtype=wp.vec3),
        dot_out: wp.array(dtype=wp.float32),
    ):
        i = wp.tid()
        if wp.static(environment):
            adjoint = environment_vjp(scene, target, x[i], w[i])
            x_out[i] = adjoint.x
            dot_out[i] = adjoint.dot
        else:
            e = scene.emitters[0]
            wi = sample(scene, e, x[i], wp.vec2(0.0, 0.0)).wi
            adjoint = sample_vjp(scene, target, e, x[i], wi, w[i], a_wi[i])
            x_out[i] = adjoint.x
            dot_out[i] = adjoint.dot

    return kernel


def random_map(height=6, width=8, seed=0):
    return np.random.default_rng(seed).random((height, width, 3)).astype(np.float32)


def ramps(height=6, width=7):
    """An image that is linear in its rows and columns, so that a look-up between its centres has no kinks."""
    row, column = np.mgrid[:height, :width]
    steps = [(0.05, 0.1), (-0.06, 0.08), (0.1, -0.04)]
    return np.stack([0.5 + a * row + b * column for a, b in steps], axis=-1).astype(np.float32)


def sun_map(height=16, width=32, row=5, column=31, sky=0.5):
    data = np.full((height, width, 3), sky, np.float32)
    data[row, column] = 4e4
    return data


def half_black_map():
    data = random_map(12, 10, 3)
    data[:, 3:8] = 0.0
    return data


def envmap(data, device="cpu", rotation=ROTATION, scale=1.5, **more):
    return Light(c.EMITTER_ENVMAP, device, radiance=data, to_world=pose(rotation), scale=[scale], **more)


def light_frame_directions(theta, phi):
    s = np.sin(theta)
    return np.stack([s * np.sin(phi), np.cos(theta), -s * np.cos(phi)], axis=-1)


def lights_to_differentiate():
    skewed = ROTATION * 1.3 + 0.05 * np.random.default_rng(12).normal(size=(3, 3))
    spot_axis = ROTATION[:, 2]
    gray = random_map()[..., :1]
    return {
        "constant": {"kind": c.EMITTER_CONSTANT, "radiance": [0.3, 0.5, 0.7]},
        "gray constant": {"kind": c.EMITTER_CONSTANT, "radiance": [0.4]},
        "envmap": {"kind": c.EMITTER_ENVMAP, "radiance": random_map(), "to_world": pose(), "scale": [1.5]},
        "skewed envmap": {"kind": c.EMITTER_ENVMAP, "radiance": random_map(), "to_world": pose(skewed), "scale": [0.5]},
        "gray envmap": {
            "kind": c.EMITTER_ENVMAP,
            "radiance": gray,
            "to_world": pose(),
            "scale": [2.0],
        },
        "black envmap": {"kind": c.EMITTER_ENVMAP, "radiance": 0.0 * random_map(), "to_world": pose(), "scale": [1.0]},
        "point": {"kind": c.EMITTER_POINT, "radiance": [3.0, 2.0, 1.0], "position": [0.2, -0.1, 1.5]},
        "gray point": {"kind": c.EMITTER_POINT, "radiance": [2.0], "position": [0.2, -0.1, 1.5]},
        "spot": {
            "kind": c.EMITTER_SPOT,
            "radiance": [3.0, 2.0, 1.0],
            "to_world": pose(translation=-1.5 * spot_axis),
            "angles": [40.0, 5.0],
        },
        "skewed spot": {
            "kind": c.EMITTER_SPOT,
            "radiance": [2.0],
            "to_world": pose(skewed, -1.5 * spot_axis),
            "angles": [60.0, 5.0],
        },
        "textured spot": {
            "kind": c.EMITTER_TEXTURED_SPOT,
            "radiance": [3.0, 2.0, 1.0],
            "to_world": pose(translation=-1.5 * spot_axis),
            "angles": [40.0, 5.0],
            "projected": ramps(),
        },
        "skewed textured spot": {
            "kind": c.EMITTER_TEXTURED_SPOT,
            "radiance": [2.0],
            "to_world": pose(skewed, -1.5 * spot_axis),
            "angles": [60.0, 5.0],
            "projected": ramps()[..., :1],
        },
        "projector": {
            "kind": c.EMITTER_PROJECTOR,
            "radiance": ramps(),
            "to_world": pose(translation=-1.5 * spot_axis),
            "scale": [1.5],
            "angles": [60.0],
        },
        "skewed projector": {
            "kind": c.EMITTER_PROJECTOR,
            "radiance": [0.7],
            "to_world": pose(skewed, -1.5 * spot_axis),
            "scale": [0.5],
            "angles": [70.0],
        },
        "directional": {"kind": c.EMITTER_DIRECTIONAL, "radiance": [3.0, 2.0, 1.0], "to_world": pose()},
        "skewed directional": {"kind": c.EMITTER_DIRECTIONAL, "radiance": [2.0], "to_world": pose(skewed)},
    }


LIGHTS = lights_to_differentiate()


def queries(name, light):
    """Points (or directions, for environments), weights: where no kink lies within reach of the differences."""
    rng = np.random.default_rng(13)
    n = 40
    if light.kind == c.EMITTER_ENVMAP:
        # Inside the cells of the light's frame, not in those at the poles, whose derivatives vary fast.
        m = light.values[light.where["to_world"]].reshape(4, 4)[:3, :3].astype(np.float64)
        column, row = rng.integers(0, 8, n), rng.integers(1, 4, n)
        fx, fy = rng.uniform(0.25, 0.75, (2, n))
        x = light_frame_directions(np.pi * (row + fy) / 5, 2.0 * np.pi * (column + 0.5 + fx) / 8) @ m.T
        x /= np.linalg.norm(x, axis=1, keepdims=True)
    elif light.kind in c.SPOTS:
        # Within the falloff.
        angles = light.values[light.where["angles"]]
        m = light.values[light.where["to_world"]].reshape(4, 4)
        axis = m[:3, 2] / np.linalg.norm(m[:3, 2])
        across = np.cross(axis, rng.normal(size=(n, 3)))
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        angle = np.radians(rng.uniform(angles[1] + 8.0, angles[0] - 8.0, n))[:, None]
        x = m[:3, 3] + (np.cos(angle) * axis + np.sin(angle) * across) * rng.uniform(1.0, 2.0, (n, 1))
    elif light.kind == c.EMITTER_PROJECTOR:
        # Inside of the frame, between the centres of the outermost texels.
        m = light.values[light.where["to_world"]].reshape(4, 4).astype(np.float64)
        half = 0.55 * np.tan(np.radians(0.5 * light.values[light.where["angles"]][0]))
        local = np.concatenate([rng.uniform(-half, half, (n, 2)), np.ones((n, 1))], axis=1)
        x = m[:3, 3] + (local * rng.uniform(1.0, 2.0, (n, 1))) @ m[:3, :3].T
    else:
        x = rng.normal(size=(n, 3)) * 0.3
    return x.astype(np.float32), rng.normal(size=(n, 3)), rng.normal(size=(n, 3))


def floor_under(light, size=16):
    """Return a floor under a light, for `load_dict`; the camera sees nothing else."""
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "camera": {
            "type": "perspective",
            "fov": 40.0,
            "to_world": psdr.Transform.look_at([0.0, -1.0, 4.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
            "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
        },
        "floor": {"type": "rectangle", "to_world": psdr.Transform.scale(3.0), "bsdf": {"type": "diffuse"}},
        "lamp": {
            "to_world": psdr.Transform.look_at([1.0, 0.5, 2.5], [0.1, 0.2, 0.0], [0.3, 1.0, 0.0]),
            **light,
        },
    }
