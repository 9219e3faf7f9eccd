"""Mitsuba 3 as the renderer of ``rings.py``: the same mesh, light, loss, steps and rates."""

import numpy as np
import rings_data as data
from common import import_mitsuba

from warp_psdr.topology.laplacian import Smoother


class UniformAdam:
    """The steps of ``psdr.optim.LargeSteps``, on NumPy arrays: Mitsuba's own need a package more (cholespy).

    Args:
        vertices: (N, 3) where it starts.
        faces: (M, 3).
        weight: of the Laplacian.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, weight: float):
        self.vertices, self._smoother = np.asarray(vertices, np.float64), Smoother(vertices, faces, weight)
        self._m = self._v = np.zeros(self.vertices.shape)
        self._steps = 0

    def step(self, gradient: np.ndarray, rate: float) -> None:
        """Move the vertices against a gradient (N, 3)."""
        smoothed = self._smoothed(gradient)
        first, second = data.BETAS
        self._steps += 1
        self._m = first * self._m + (1.0 - first) * smoothed
        self._v = second * self._v + (1.0 - second) * smoothed**2
        size = np.sqrt(self._v.max() / (1.0 - second**self._steps)) + 1e-8
        self.vertices -= self._smoothed(rate / (1.0 - first**self._steps) / size * self._m)

    def _smoothed(self, values: np.ndarray) -> np.ndarray:
        return self._smoother.scatter(self._smoother.solve(self._smoother.gather(values)))


class Theirs:
    """Mitsuba's ``prb_projective``, or its ``prb`` without a boundary term, and its Adam; large steps for the vertices.

    Its camera has no pixel aspect, so both focal lengths are their mean, half a percent off at most. Guiding is off:
    each gradient builds the octree anew, which took 70 s of processor time a view, 100 times as long as the rest.

    Args:
        ring: photographs and cameras.
        model: where it starts.
        stage: steps, rates and weights.
        depth: of paths.
        boundary: whether silhouettes are differentiated.
        threads: of Dr.Jit.
    """

    name = "Mitsuba"

    def __init__(
        self, ring: data.Ring, model: data.Model, stage: data.Stage, *, depth: int, boundary: bool, threads: int
    ):
        self._mi, self._dr = import_mitsuba(threads)
        mi, dr = self._mi, self._dr
        self._faces, self._stage = model.faces, stage
        self._scene = mi.load_dict(self._described(ring, model))
        method = {"type": "prb_projective", "guiding": "none"} if boundary else {"type": "prb"}
        self._integrator = mi.load_dict({**method, "max_depth": depth, "hide_emitters": True})
        self._targets = [mi.TensorXf(photograph) for photograph in ring.linear]
        self._params = mi.traverse(self._scene)
        first, second = data.BETAS
        options = {"beta_1": first, "beta_2": second}
        self._adam = mi.ad.Adam(lr=1.0, **options)
        self._rates = {name: rate for name, rate in stage.rates.items() if rate > 0.0 and name != data.SHAPE}
        for name, rate in self._rates.items():
            self._adam[name] = self._params[name]
            self._adam.set_learning_rate({name: rate})
        self._uniform = None
        if stage.rates[data.SHAPE] > 0.0:
            self._uniform = UniformAdam(model.vertices, model.faces, stage.smooth)
            dr.enable_grad(self._params[data.SHAPE])
        dr.eval(self._targets)

    def _described(self, ring: data.Ring, model: data.Model) -> dict:
        mi = self._mi
        mesh = mi.Mesh("object", len(model.vertices), len(model.faces), props=self._paint())
        mesh.add_attribute(data.ALBEDO.rpartition(".")[2], 3, np.float32(model.albedo).ravel())
        params = mi.traverse(mesh)
        params["vertex_positions"] = np.float32(model.vertices).ravel()
        params["faces"] = np.uint32(model.faces).ravel()
        params.update()
        scene = {"type": "scene", "object": mesh}
        scene["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(np.float32(model.light))}
        return scene | {f"view_{i:02}": self._sensor(ring.sensor(i)) for i in range(len(ring.views))}

    def _paint(self):
        props = self._mi.Properties()
        texture = {"type": "mesh_attribute", "name": data.ALBEDO.rpartition(".")[2]}
        props["bsdf"] = self._mi.load_dict({"type": "diffuse", "reflectance": texture})
        props["face_normals"] = True
        return props

    def _sensor(self, ours: dict) -> dict:
        mean = np.sqrt(ours.pop("pixel_aspect", 1.0))
        ours["fov"] = float(np.degrees(2.0 * np.arctan(np.tan(np.radians(0.5 * ours["fov"])) / mean)))
        ours["to_world"] = self._mi.ScalarTransform4f(ours["to_world"])
        return ours

    def step(self, views: list[int], seed: int, scale: float) -> float:
        """Make one step and return its loss."""
        mi, dr = self._mi, self._dr
        self._params.update(self._adam)
        total = 0.0
        for k in views:
            image = mi.render(
                self._scene, self._params, sensor=k, integrator=self._integrator,
                spp=data.SPP, spp_grad=data.SPP_GRADIENT, seed=seed + k, seed_grad=seed + k + len(self._targets),
            )  # fmt: skip
            loss = dr.mean(dr.square(image - self._targets[k]), axis=None) / len(views)
            dr.backward(loss)
            total += float(loss.array[0])
        self._adam.set_learning_rate({name: rate * scale for name, rate in self._rates.items()})
        self._adam.step()
        for name in self._rates:
            most = 1.0 if name == data.ALBEDO else np.inf
            self._adam[name] = dr.clip(dr.detach(self._adam[name]), 0.0, most)
        if self._uniform is not None:
            gradient = np.array(dr.grad(self._params[data.SHAPE])).reshape(-1, 3)
            self._uniform.step(gradient, self._stage.rates[data.SHAPE] * scale)
            self._params[data.SHAPE] = mi.Float(np.float32(self._uniform.vertices.ravel()))
            dr.enable_grad(self._params[data.SHAPE])
        self._params.update(self._adam)
        return total

    def image(self, view: int, spp: int, seed: int) -> np.ndarray:
        """Return what a camera sees, (H, W, 3)."""
        rendered = self._mi.render(self._scene, sensor=view, integrator=self._integrator, spp=spp, seed=seed)
        return np.array(rendered)

    def model(self) -> data.Model:
        """Return what has been found."""
        vertices = np.array(self._params[data.SHAPE]).reshape(-1, 3)
        albedo = np.array(self._params[data.ALBEDO]).reshape(-1, 3)
        light = np.array(self._params[data.LIGHT])[:, 1:-1, :3]
        return data.Model(vertices, self._faces, albedo, light)
