"""Networks of signed distances for tests: random layers whose last one is fitted, and their values in float64."""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Net:
    layers: list[tuple[np.ndarray, np.ndarray]]
    frequencies: int
    sine: bool
    scale: float

    def hidden(self, x: np.ndarray) -> np.ndarray:
        parts = [x]
        for k in range(self.frequencies):
            parts += [np.sin(2.0**k * np.pi * x), np.cos(2.0**k * np.pi * x)]
        a = np.concatenate(parts, axis=-1)
        for weight, bias in self.layers[: len(self.layers) - (self.layers[-1][0].shape[0] == 1)]:
            z = self.scale * (a @ weight.T + bias)
            a = np.sin(z) if self.sine else np.logaddexp(0.0, z) / self.scale
        return a

    def phi(self, x: np.ndarray) -> np.ndarray:
        """Values (...) at points (..., 3) of [0, 1]^3, float64."""
        return (self.hidden(x) @ self.layers[-1][0].T + self.layers[-1][1])[..., 0]

    def plugin(self, **more) -> dict:
        found = {"type": "neuralsdf", "frequencies": self.frequencies, **more}
        found |= {"activation": "sine", "omega": self.scale} if self.sine else {"beta": self.scale}
        for n, (weight, bias) in enumerate(self.layers):
            found |= {f"layer{n}.weight": weight, f"layer{n}.bias": bias}
        return found

    def grid(self, count: int) -> np.ndarray:
        """Values (Z, Y, X) at nodes."""
        at = np.linspace(0.0, 1.0, count)
        z, y, x = np.meshgrid(at, at, at, indexing="ij")
        return self.phi(np.stack([x, y, z], axis=-1))


def sphere(x: np.ndarray) -> np.ndarray:
    return np.linalg.norm(x - 0.5, axis=-1) - 0.32


def blob(x: np.ndarray) -> np.ndarray:
    return sphere(x) + 0.05 * np.sin(9 * x[..., 0]) * np.sin(8 * x[..., 1] + 1.0) * np.sin(10 * x[..., 2])


def neck(x: np.ndarray) -> np.ndarray:
    """Two spheres, blended."""
    a = np.linalg.norm(x - [0.36, 0.45, 0.5], axis=-1) - 0.2
    b = np.linalg.norm(x - [0.68, 0.55, 0.5], axis=-1) - 0.16
    return -0.05 * np.log(np.exp(-a / 0.05) + np.exp(-b / 0.05))


@functools.cache
def bowl(radius: float = 0.3, scale: float = 4.0) -> Net:
    """Return a network of one layer of eight neurons, in pairs that face each other: nearly a ball, and cheap."""
    axes = np.array([[1.0, 0.1, 0.0], [-0.1, 1.0, 0.15], [0.0, -0.15, 1.0], [0.4, 0.4, 0.4]])
    weight = np.float32(np.concatenate([axes, -axes])).astype(float)
    bias = np.float32(-0.5 * weight.sum(axis=1)).astype(float)
    first, last = (weight, bias), np.ones((1, len(weight)))
    around = np.random.default_rng(0).standard_normal((4000, 3))
    around *= radius / np.linalg.norm(around, axis=1, keepdims=True)
    level = Net([first, (last, np.zeros(1))], 0, False, scale).phi(0.5 + around).mean()
    return Net([first, (last, np.float32([-level]).astype(float))], 0, False, scale)


@functools.cache
def fitted(
    target: Callable = blob,
    widths: tuple[int, ...] = (32, 32),
    frequencies: int = 0,
    sine: bool = False,
    scale: float = 10.0,
    gain: float = 3.0,
) -> Net:
    """Return a network near a function, random but for its last layer; all its numbers are float32's."""
    rng = np.random.default_rng(0)
    layers, count = [], 3 + 6 * frequencies
    for n, width in enumerate(widths):
        weight = rng.standard_normal((width, count)) * (1.0 if n else gain) / np.sqrt(count)
        bias = 0.3 * rng.standard_normal(width) if n else -(weight[:, :3] * rng.random((width, 3))).sum(axis=1)
        layers.append((weight.astype(np.float32).astype(float), bias.astype(np.float32).astype(float)))
        count = width
    x = rng.random((20000, 3))
    given = Net(layers, frequencies, sine, scale).hidden(x)
    given = np.concatenate([given, np.ones((len(given), 1))], axis=1)
    y = target(x)
    weighted = given / (0.05 + np.abs(y))[:, None]
    found = np.linalg.solve(
        weighted.T @ weighted + 1e-6 * len(x) * np.eye(count + 1), weighted.T @ (y / (0.05 + np.abs(y)))
    ).astype(np.float32)
    return Net([*layers, (found[None, :-1].astype(float), found[-1:].astype(float))], frequencies, sine, scale)
