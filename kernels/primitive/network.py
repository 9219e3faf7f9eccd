"""Signed distances by a network: the surface phi = 0 of a multi-layer perceptron in [0, 1]^3, in front of its pose.

A layer is z = W a + bias. The activation, softplus or a sine, applies to all layers but the last, which is a single
number. The first layer takes q, and for each frequency k the sines and cosines of 2^k pi q. The flat values hold the
pose, a head, the layers (weights in rows, then biases), the same packed for SIMD, and the cells. A cell holds a number
from bounds (``network_bounds.py`` of the host): its reach as on grids, or minus the greatest second derivative of
phi in it along a unit vector. The head holds the cells along an axis, layers, frequencies, activation (0: softplus, 1:
sine) and its beta or omega, the offsets of the packed weights and the cells, and the widths of the input and of each
layer. All sizes are read at run time, so networks of all sizes run in one kernel.

Derivation: ``docs/theory/implicit.md#networks``.
"""

import functools

import warp as wp

from warp_psdr.kernels.primitive.affine import step_off_primitive
from warp_psdr.kernels.primitive.network_source import ALONG, PULL, SINKS, TYPES
from warp_psdr.kernels.primitive.sdfgrid import Grid
from warp_psdr.kernels.reading import load_float
from warp_psdr.kernels.step import LEAVE
from warp_psdr.kernels.structs import Scene, Triangle

#: Values of the pose, and of the head behind it.
POSE, HEAD = 16, 20
#: Layers and numbers in one, at most.
MOST_LAYERS, MOST_WIDTH = 8, 128
#: Rows of the packed weights: widths are rounded up to so many.
BLOCK = 16
#: Words of the head: where the cells start, and how far off the surface rays start, in the box, that rounding of phi
#: does not let meet it again.
CELLS_WORD, STEP_WORD = 6, 16
#: Words of the head: the greatest slope of phi where it is at most a level, 0 while nobody has asked, and that level,
#: which is so much of the box at the slope that the surface has.
SLOPE_WORD, LEVEL_WORD = 17, 18
LEVEL = 0.15


@wp.func
def network_of(scene: Scene, tri: Triangle) -> Grid:
    """The cells of a network, as those of a grid; ``first`` is the place of its head, and there are no nodes."""
    g = Grid()
    g.first = tri.i0 + wp.static(POSE)
    g.nx = wp.int32(load_float(scene.values, g.first)) + 1
    g.ny = g.nx
    g.nz = g.nx
    g.reach = g.first + wp.int32(load_float(scene.values, g.first + wp.static(CELLS_WORD)))
    g.cells = wp.vec3(wp.float32(g.nx - 1), wp.float32(g.nx - 1), wp.float32(g.nx - 1))
    g.high = g.cells
    return g


@wp.func
def network_cell(scene: Scene, g: Grid, i: wp.int32, j: wp.int32, k: wp.int32) -> wp.float32:
    """What is known of a cell: its reach, or minus the bound of the second derivatives of phi in it."""
    return load_float(scene.values, g.reach + (k * (g.ny - 1) + j) * (g.nx - 1) + i)


@wp.func
def step_off_network(scene: Scene, tri: Triangle) -> wp.float32:
    """Distance, world units, at which the rays that leave a network start."""
    size = wp.max(wp.max(wp.length(tri.p0), wp.length(tri.p1)), wp.length(tri.p2))
    step = load_float(scene.values, tri.i0 + wp.static(POSE + STEP_WORD))
    return wp.max(step_off_primitive(scene, tri), step * size)


@wp.func
def clear_of_network(scene: Scene, tri: Triangle) -> wp.float32:
    """Depth, world units, below a silhouette from which on no ray is taken to meet the surface on its far side.

    That is where float32 tells the sign of phi, and the roundings of the ray besides.
    """
    size = wp.max(wp.max(wp.length(tri.p0), wp.length(tri.p1)), wp.length(tri.p2))
    reach = wp.max(wp.abs(tri.normal) + wp.abs(tri.p0) + wp.abs(tri.p1) + wp.abs(tri.p2))
    return load_float(scene.values, tri.i0 + wp.static(POSE + STEP_WORD)) * size + LEAVE * reach


def network_text(text: str) -> str:
    """Return C++ with the sizes of networks put in."""
    for name, value in (("BLOCK", BLOCK), ("WIDTH", MOST_WIDTH), ("LAYERS", MOST_LAYERS), ("HEADER", HEAD)):
        text = text.replace(f"${name}", str(value))
    return text


@wp.func_native(network_text(TYPES + ALONG))
def phi_along(values: wp.array(dtype=wp.float32), place: wp.int32, q: wp.vec3, w: wp.vec3) -> wp.vec2:
    """(phi, its derivative along w); ``place`` is that of the head."""
    return wp.vec2(0.0, 0.0)


def _pull(role: str) -> str:
    start, sink, end = SINKS[role]
    return network_text(TYPES + PULL.replace("$START", start).replace("$SINK", sink) + end)


@wp.func_native(_pull(""))
def pull_phi(values: wp.array(dtype=wp.float32), place: wp.int32, q: wp.vec3, a_phi: wp.float32, w: wp.vec3) -> wp.vec4:
    """(a_phi grad phi + H w, phi)."""
    return wp.vec4(0.0, 0.0, 0.0, 0.0)


@functools.cache
def make_network_sink(role: str):
    """Return ``accumulate(values, target, place, q, a_phi, w) -> float``: adjoints a_phi of phi, and w of its gradient.

    With one direction w that is the derivative by the weights of a_phi phi + w . grad phi: one sweep back through the
    layers and their rates. What is returned is a sink's number (``kernels/sink.py``).
    """

    @wp.func_native(_pull(role))
    def accumulate_network(
        values: wp.array(dtype=wp.float32),
        target: wp.array(dtype=wp.float32),
        place: wp.int32,
        q: wp.vec3,
        a_phi: wp.float32,
        w: wp.vec3,
    ) -> wp.float32:
        return wp.float32(0.0)

    return accumulate_network
