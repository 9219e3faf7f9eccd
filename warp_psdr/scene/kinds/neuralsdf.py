"""Shapes that are the zero set of a network: the reader and the layout (``kernels/primitive/network.py``)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_psdr.arrays import read_archive
from warp_psdr.kernels.primitive.network import (
    BLOCK,
    CELLS_WORD,
    HEAD,
    MOST_LAYERS,
    MOST_WIDTH,
    POSE,
    SLOPE_WORD,
    STEP_WORD,
)
from warp_psdr.kernels.primitive.network_kind import NETWORK
from warp_psdr.options.words import words
from warp_psdr.scene.errors import error
from warp_psdr.scene.kinds.kind import Geometry
from warp_psdr.scene.kinds.network_bounds import cells_of, single, steepness, values_of
from warp_psdr.scene.kinds.zero_set import ZeroSet
from warp_psdr.scene.layout import SHAPE_GRID, Layout

if TYPE_CHECKING:
    from warp_psdr.scene.plugins import Properties
    from warp_psdr.scene.scene import Scene

#: Most sines and cosines: 2^9 pi x is resolved by float32.
MOST_FREQUENCIES = 10
#: Bytes of a file's arrays: many times what the largest network takes in float64.
MOST_BYTES = 1 << 26
_SAVE = "save its layers with numpy.savez"
#: Cells of the box along an axis that may be asked for.
CELLS = (16, 32, 64, 128)
#: Values up to which float32 sums of squares do not overflow.
LARGEST = 1.0e15
#: Rounding of phi over its slope, times which is where rays start; and points at which it is measured.
CLEAR, POINTS = 4.0, 4096
#: Activation -> the parameter that scales it, and its default.
ACTIVATIONS = {"softplus": ("beta", 100.0), "sine": ("omega", 30.0)}
_KINKS = ("relu", "leaky_relu", "leakyrelu", "elu", "prelu", "relu6", "hardtanh", "abs")
_NAME = re.compile(r"layer(\d+)\.(weight|bias)")


@dataclass(eq=False)
class Network(ZeroSet):
    """Signed distances in [0, 1]^3 by a multi-layer perceptron."""

    plugin = name = "neuralsdf"
    device = NETWORK
    instead = "sample it at the nodes of a 'sdfgrid', or extract its triangles (psdr.sdf.to_mesh)"

    layers: list[tuple[np.ndarray, np.ndarray]]  #: weights (out, in) and biases (out,), float64
    frequencies: int  #: of the sines and cosines of 2^k pi x that the first layer takes beside x
    sine: bool  #: the activation is a sine; else softplus
    scale: float  #: its omega, or beta
    count: int  #: cells of the box along an axis
    cells: np.ndarray | None = None  #: (Z, Y, X) what is known of cells of the box, as the kernels read it

    @classmethod
    def read(cls, props: Properties, to_world: np.ndarray) -> tuple[Geometry, np.ndarray]:
        """Take the layers.

        Raises:
            ValueError: there are none, they do not chain, they are not finite or too large, or an activation has kinks.
        """
        return _read(props), to_world

    @property
    def nodes(self) -> tuple[int, int, int]:
        """Number of the corners of cells along x, y and z."""
        return self.count + 1, self.count + 1, self.count + 1

    @property
    def knows(self) -> frozenset[str]:
        """It is a mirror or glass, and no more besides."""
        return words("mirrors", "mirror", "glass")

    def parameters(self) -> dict[str, np.ndarray]:
        """Return the weights and the biases of each layer."""
        return {
            f"layer{n}.{what}": values
            for n, layer in enumerate(self.layers)
            for what, values in zip(("weight", "bias"), layer, strict=True)
        }

    def with_parameters(self, values: Mapping[str, np.ndarray]) -> Network:
        """Return the network with other weights and biases, by their names, as float64."""
        pairs = ((values[f"layer{n}.weight"], values[f"layer{n}.bias"]) for n in range(len(self.layers)))
        layers = [(weight.astype(np.float64), bias.astype(np.float64)) for weight, bias in pairs]
        return replace(self, layers=layers, cells=None)

    def lay(self, layout: Layout, path: str, shape: int, pose: int) -> int:
        """Lay out the head, the layers, and what is derived from them."""
        head, weights, cells = derived(self, self.cells)
        layout.add_values(head)
        for name, values in self.parameters().items():
            layout.add(f"{path}.{name}", values, SHAPE_GRID, owner=shape)
        layout.add_values(weights)
        layout.add_values(cells)
        return pose

    def follow(self, scene: Scene, shape: int, state: Any) -> Any:
        """Let head, packed weights and cells follow the layers.

        Raises:
            ValueError: the weights overflow.
        """
        network = network_now(scene, shape)
        problem = overflow(network)
        if problem:
            raise ValueError(f"{scene.description.shapes[shape].path}: {problem}; scale the weights down")
        head, weights, cells = derived(network)
        place = scene.builder.frames[shape] + POSE
        for offset, values in ((0, head), (int(head[CELLS_WORD - 1]), weights), (int(head[CELLS_WORD]), cells)):
            flat = np.ascontiguousarray(values, np.float32).reshape(-1)
            scene.values[place + offset : place + offset + flat.size].assign(flat)

    @classmethod
    def describe(cls, shapes: Sequence[tuple[str, Geometry]]) -> list[tuple[str, str, str]]:
        """Return a line about each."""
        lines = []
        for path, network in shapes:
            assert isinstance(network, Network)
            widths = [str(network.layers[0][0].shape[1]), *(str(w.shape[0]) for w, _b in network.layers)]
            activation = f"{'sine, omega' if network.sine else 'softplus, beta'} {network.scale:g}"
            why = f"{activation}; rays go from cell to cell, and by bounds of its second derivatives in each"
            lines.append((f"network {path}", " - ".join(widths), why))
        return lines


def _read(props: Properties) -> Network:
    if props.has("face_normals"):
        raise error(props.where, f"'face_normals' on a '{props.type}'", "leave it out: its normals are smooth")
    frequencies = props.integer("frequencies", 0, minimum=0, maximum=MOST_FREQUENCIES)
    count = props.integer("cells", 32)
    if count not in CELLS:
        raise error(props.place("cells"), f"got {count}", f"give one of: {', '.join(map(str, CELLS))}")
    activation, scale = _activation(props)
    arrays, places = _arrays(props)
    layers = _chained(props, arrays, places, 3 + 6 * frequencies)
    network = Network(layers, frequencies, activation == "sine", scale, count)
    props.context.count(sum(w.size + b.size for w, b in layers), props.where)
    problem = overflow(network)
    if problem:
        raise error(props.where, problem, "scale the weights down")
    network.cells = cells_of(network, network.count)
    if (network.cells > 0.0).all():
        props.context.note(f"{props.where}: phi has one sign in the box [0, 1]^3, so the shape is empty")
    return network


def _activation(props: Properties) -> tuple[str, float]:
    name = props.take("activation", "softplus")
    if name not in ACTIVATIONS:
        kinks = isinstance(name, str) and name.lower() in _KINKS
        why = ", whose kinks are creases of the surface that no term follows" if kinks else ""
        raise error(props.place("activation"), f"got {name!r}{why}", f"give one of: {', '.join(ACTIVATIONS)}")
    for other, (key, _default) in ACTIVATIONS.items():
        if other != name and props.has(key):
            raise error(props.place(key), f"'{key}' beside the activation '{name}'", f"'{key}' is that of '{other}'")
    key, default = ACTIVATIONS[name]
    return name, props.number(key, default, minimum=0.0, exclusive=True)


def _arrays(props: Properties) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the layers' arrays by name, and their places for messages."""
    given = [key for key in props.node if isinstance(key, str) and _NAME.fullmatch(key)]
    values = {key: props.take(key) for key in given}
    if not props.has("filename"):
        return values, {key: props.place(key) for key in given}
    place = props.place("filename")
    file = props.context.file(props.take("filename"), place)
    if given:
        raise error(props.where, f"got filename and {given[0]}", "give the layers in one place")
    try:
        found = read_archive(file, MOST_BYTES)
    except ValueError as problem:
        raise error(place, f"'{file.name}' is no .npz file that can be read ({problem})", _SAVE) from None
    other = [key for key in found if not _NAME.fullmatch(key)]
    if other:
        raise error(place, f"'{file.name}' holds '{other[0]}'", "name its arrays layer0.weight, layer0.bias, ...")
    return found, {key: f"{place}, array '{key}'" for key in found}


def _chained(
    props: Properties, arrays: dict[str, Any], places: dict[str, str], width: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    count = 1 + max((int(key[5:].split(".")[0]) for key in arrays), default=-1)
    names = [f"layer{n}.{what}" for n in range(count) for what in ("weight", "bias")]
    missing = next((name for name in names if name not in arrays), "")
    if count < 2 or missing:
        problem = f"'{missing}' is missing" if missing else f"got {count} layers"
        raise error(props.where, problem, "give layer0.weight, layer0.bias and so on, of 2 layers or more")
    if count > MOST_LAYERS:
        raise error(props.where, f"got {count} layers", f"give {MOST_LAYERS} at most, or {Network.instead}")
    layers = []
    for n in range(count):
        pair = []
        for name, rank in ((f"layer{n}.weight", 2), (f"layer{n}.bias", 1)):
            try:
                value = np.asarray(arrays[name].numpy() if hasattr(arrays[name], "numpy") else arrays[name])
                value = value.astype(np.float64) if value.dtype.kind in "iuf" else np.empty(())
            except (TypeError, ValueError, RuntimeError):
                value = np.empty(())
            if value.ndim != rank:
                shape = f"the shape {value.shape}" if value.ndim else "no array of numbers"
                raise error(places[name], f"got {shape}", "give weights (out, in) and biases (out,)")
            wrong = int((~np.isfinite(value)).sum())
            if wrong:
                raise error(places[name], f"{wrong} of {value.size} values are not finite", "give finite numbers")
            if np.abs(value).max(initial=0.0) > LARGEST:
                raise error(places[name], f"a value of {np.abs(value).max():.3g}", f"give {LARGEST:g} at most")
            pair.append(value.astype(np.float32).astype(np.float64))
        weight, bias = pair
        last = n == count - 1
        if weight.shape[1] != width:
            comes = "x, y, z and the sines and cosines of 'frequencies'" if n == 0 else f"layer{n - 1}"
            raise error(
                places[f"layer{n}.weight"],
                f"got the shape {weight.shape}, and {comes} make {width} numbers",
                f"give (out, {width})",
            )
        if bias.shape != (weight.shape[0],):
            raise error(places[f"layer{n}.bias"], f"got the shape {bias.shape}", f"give ({weight.shape[0]},)")
        if last and weight.shape[0] != 1:
            raise error(places[f"layer{n}.weight"], f"the last layer makes {weight.shape[0]} numbers", "give one")
        if not last and not 1 <= weight.shape[0] <= MOST_WIDTH:
            raise error(places[f"layer{n}.weight"], f"a layer of {weight.shape[0]} numbers", f"give 1 to {MOST_WIDTH}")
        width = weight.shape[0]
        layers.append((weight, bias))
    return layers


def overflow(network: Network) -> str:
    """Return what is wrong with weights whose phi or its derivatives overflow; empty: nothing."""
    size = np.full(3 + 6 * network.frequencies, 2.0**network.frequencies * np.pi)
    with np.errstate(over="ignore"):
        for weight, bias in network.layers:
            size = np.abs(weight) @ size + np.abs(bias)
            if not size.max() * max(network.scale, 1.0) < LARGEST:
                return f"its weights overflow: phi may be as large as {size.max():.3g}"
            if network.sine:
                size = np.maximum(np.minimum(size, 1.0), network.scale * size)
    return ""


def packed(network: Network) -> np.ndarray:
    """Return the weights as the kernels multiply them: of ``BLOCK`` rows the biases, then column by column."""
    parts = []
    for weight, bias in network.layers[:-1]:
        count, width = weight.shape
        rows = -(-count // BLOCK) * BLOCK
        whole = np.zeros((rows, 1 + width))
        whole[:count, 0], whole[:count, 1:] = bias, weight
        parts.append(whole.reshape(rows // BLOCK, BLOCK, 1 + width).transpose(0, 2, 1).ravel())
    weight, bias = network.layers[-1]
    return np.concatenate([*parts, bias, weight.ravel()]).astype(np.float32)


def clearance(network: Network, cells: np.ndarray) -> float:
    """Return how far off the surface, in the box, float32 tells the sign of phi."""
    at = np.argwhere(cells <= 0.0)[:, ::-1]
    if not len(at):
        return 0.0
    points = ((at[:: -(-len(at) // POINTS)] + 0.5) / len(cells)).astype(np.float32)
    exact, gradient = values_of(network, points.astype(np.float64))
    rounding = np.abs(values_of(single(network), points)[0] - exact).max()
    return float(CLEAR * rounding / max(np.median(np.linalg.norm(gradient, axis=1)), 1.0e-30))


def derived(network: Network, cells: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the head, the packed weights and the cells; ``cells`` if they are known."""
    cells = cells_of(network, network.count) if cells is None else cells
    weights = packed(network)
    size = sum(w.size + b.size for w, b in network.layers)
    head = np.zeros(HEAD, np.float32)
    head[: CELLS_WORD + 1] = [
        network.count,
        len(network.layers),
        network.frequencies,
        network.sine,
        network.scale,
        HEAD + size,
        HEAD + size + weights.size,
    ]
    widths = [network.layers[0][0].shape[1], *(w.shape[0] for w, _b in network.layers)]
    head[CELLS_WORD + 1 : CELLS_WORD + 1 + len(widths)] = widths
    head[STEP_WORD] = clearance(network, cells)
    return head, weights, cells


def network_now(scene: Scene, shape: int) -> Network:
    """Return a network of a scene with its weights as they are now."""
    s = scene.description.shapes[shape]
    assert isinstance(s.geometry, Network)
    found = {name: scene.parameters[f"{s.path}.{name}"] for name in s.geometry.parameters()}
    held = scene.values.numpy()
    return s.geometry.with_parameters(
        {name: held[p.offset : p.offset + p.size].reshape(p.shape) for name, p in found.items()}
    )


def network_and_cells(scene: Scene, shape: int) -> tuple[Network, np.ndarray]:
    """Return a network as it is now, and its cells (Z, Y, X) as ``cells_of`` makes them."""
    network = network_now(scene, shape)
    held, head = scene.values.numpy(), scene.builder.frames[shape] + POSE
    n, start = network.count, head + int(held[head + CELLS_WORD])
    return network, held[start : start + n**3].reshape(n, n, n)


def bound_slopes(scene: Scene, shape: int) -> None:
    """Let the head of a network hold a bound of its slopes, unless it does: an edit takes it away."""
    place = scene.builder.frames[shape] + POSE + SLOPE_WORD
    held = scene.values[place : place + 2]
    if held.numpy()[0] == 0.0:
        held.assign(np.array(steepness(*network_and_cells(scene, shape)), np.float32))
