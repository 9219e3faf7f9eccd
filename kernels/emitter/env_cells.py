"""Cells of an image environment: which one a direction meets, and the density of directions within it.

Conventions and density are those of ``envmap.py``. Nothing branches and every load is of one word, so that a loop over
lanes which calls these functions becomes SIMD.
"""

import warp as wp

from warp_psdr.kernels.angles import arctan2, sin_quarter
from warp_psdr.kernels.constants import INV_PI, INV_TWO_PI, ONE_MINUS_EPSILON, TWO_PI
from warp_psdr.kernels.invalid import LARGEST
from warp_psdr.kernels.math import where3
from warp_psdr.kernels.reading import load_float
from warp_psdr.kernels.rng import UNIT
from warp_psdr.kernels.structs import Scene, Texture
from warp_psdr.kernels.texture.texture import texel

#: Share of the samples within a cell that is uniform: bounds what a black texel's derivative is divided by. Where a
#: side of a cell is black, its variance grows as the logarithm of the inverse; that of images grows with the share.
UNIFORM_CELL = 0.01


@wp.struct
class Cell:
    """The four texels around a direction (flat offsets) and its fractional position between them."""

    row: wp.int32
    column: wp.int32
    i00: wp.int32
    i10: wp.int32
    i01: wp.int32
    i11: wp.int32
    fx: wp.float32
    fy: wp.float32


@wp.struct
class CellCorners:
    """The texels at a cell's corners: read once, for the radiance and for the density."""

    t00: wp.vec3
    t10: wp.vec3
    t01: wp.vec3
    t11: wp.vec3


@wp.struct
class CellDensity:
    """Brightness at a cell's corners, with the uniform share mixed in."""

    b00: wp.float32
    b10: wp.float32
    b01: wp.float32
    b11: wp.float32


@wp.func
def load_matrix(values: wp.array(dtype=wp.float32), offset: wp.int32) -> wp.mat33:
    """Linear part of a 4x4 row-major matrix."""
    return wp.mat33(
        load_float(values, offset),
        load_float(values, offset + 1),
        load_float(values, offset + 2),
        load_float(values, offset + 4),
        load_float(values, offset + 5),
        load_float(values, offset + 6),
        load_float(values, offset + 8),
        load_float(values, offset + 9),
        load_float(values, offset + 10),
    )


@wp.func
def cell_at(texture: Texture, row: wp.int32, column: wp.int32) -> Cell:
    cell = Cell()
    cell.row = row
    cell.column = column
    right = wp.where(column + 1 == texture.width, 0, column + 1)
    top = texture.offset + row * texture.width * texture.channels
    bottom = top + texture.width * texture.channels
    cell.i00 = top + column * texture.channels
    cell.i10 = top + right * texture.channels
    cell.i01 = bottom + column * texture.channels
    cell.i11 = bottom + right * texture.channels
    return cell


@wp.func
def locate(texture: Texture, v: wp.vec3) -> Cell:
    """Cell of the direction ``v`` (light's frame, any length).

    What is no direction (not finite, or zero) lies nowhere: its position within the cell is NaN, and so are radiance,
    density and derivative. The arctangent would make an angle of it, and the integer of NaN no index.
    """
    rows = texture.height - 1
    size = wp.abs(v[0]) + wp.abs(v[1]) + wp.abs(v[2])
    somewhere = wp.where(size > 0.0, size <= LARGEST, False)
    d = where3(somewhere, v, wp.vec3(0.0, 1.0, 0.0))
    # Both angles by the arctangent of two: accurate everywhere, poles included, and independent of the vector's length.
    x = arctan2(d[0], -d[2]) * INV_TWO_PI * wp.float32(texture.width) - 0.5
    y = arctan2(wp.sqrt(d[0] * d[0] + d[2] * d[2]), d[1]) * INV_PI * wp.float32(rows)
    left = wp.floor(x)
    column = wp.int32(left)
    column = wp.where(column < 0, column + texture.width, column)
    row = wp.min(wp.int32(y), rows - 1)
    cell = cell_at(texture, row, column)
    cell.fx = wp.where(somewhere, x - left, wp.NAN)
    cell.fy = y - wp.float32(row)
    return cell


@wp.func
def corners_of(scene: Scene, texture: Texture, cell: Cell) -> CellCorners:
    n = texture.channels
    corners = CellCorners()
    corners.t00 = texel(scene, cell.i00, n)
    corners.t10 = texel(scene, cell.i10, n)
    corners.t01 = texel(scene, cell.i01, n)
    corners.t11 = texel(scene, cell.i11, n)
    return corners


@wp.func
def interpolate_cell(c: CellCorners, cell: Cell) -> wp.vec3:
    top = (1.0 - cell.fx) * c.t00 + cell.fx * c.t10
    bottom = (1.0 - cell.fx) * c.t01 + cell.fx * c.t11
    return (1.0 - cell.fy) * top + cell.fy * bottom


@wp.func
def brightness(t: wp.vec3) -> wp.float32:
    return wp.max(t[0] + t[1] + t[2], 0.0)


@wp.func
def corner_density(c: CellCorners) -> CellDensity:
    """Corner values of the density within a cell, their mean one."""
    b00 = brightness(c.t00)
    b10 = brightness(c.t10)
    b01 = brightness(c.t01)
    b11 = brightness(c.t11)
    density = CellDensity()
    mean = 0.25 * (b00 + b10 + b01 + b11)
    uniform = wp.where(mean > 0.0, UNIFORM_CELL, 1.0)
    factor = wp.where(mean > 0.0, (1.0 - UNIFORM_CELL) / mean, 0.0)
    density.b00 = uniform + factor * b00
    density.b10 = uniform + factor * b10
    density.b01 = uniform + factor * b01
    density.b11 = uniform + factor * b11
    return density


@wp.func
def cell_density(scene: Scene, texture: Texture, cell: Cell) -> CellDensity:
    """``corner_density`` of a cell."""
    return corner_density(corners_of(scene, texture, cell))


@wp.func
def density_at(b: CellDensity, s: wp.float32, t: wp.float32) -> wp.float32:
    return (1.0 - t) * ((1.0 - s) * b.b00 + s * b.b10) + t * ((1.0 - s) * b.b01 + s * b.b11)


@wp.func
def linear_offset(u: wp.float32, a: wp.float32, b: wp.float32) -> wp.float32:
    """Position in [0, 1) with density proportional to the line from a to b (both positive)."""
    # Roundings of the root and of u reach beyond 1, behind a pole.
    return wp.min(u * (a + b) / (a + wp.sqrt((1.0 - u) * a * a + u * b * b)), ONE_MINUS_EPSILON)


@wp.func
def half_sine(row: wp.int32, rows: wp.int32) -> wp.float32:
    """sin^2(theta / 2) where row ``row`` of texels lies; (1 - cos theta) / 2 without cancellation."""
    h = sin_quarter(wp.float32(row) / wp.float32(rows))
    return h * h


@wp.func
def cell_solid_angle(row: wp.int32, rows: wp.int32, columns: wp.int32) -> wp.float32:
    """Solid angle of a cell: delta phi (cos theta_0 - cos theta_1), as a product."""
    # Counted from the nearer pole, where the sine is small.
    nearer = wp.float32(2 * wp.min(row, rows - 1 - row) + 1)
    half = 1.0 / wp.float32(rows)
    return TWO_PI / wp.float32(columns) * 2.0 * sin_quarter(nearer * half) * sin_quarter(half)


@wp.func
def cell_height(cell: Cell, v: wp.vec3, rows: wp.int32) -> wp.float32:
    """Vertical position of the unit vector v within its cell, uniform in solid angle; counted from the nearer pole.

    In [0, 1] up to roundings, which do not matter to a density whose least value is a fortieth of its largest.
    """
    # sin^2(theta / 2) = sin^2(theta) / (2 (1 + cos theta)).
    q = 0.5 * (v[0] * v[0] + v[2] * v[2]) / (1.0 + wp.abs(v[1]))
    upper = 2 * cell.row < rows
    q = wp.where(wp.where(upper, v[1] < 0.0, v[1] > 0.0), 1.0 - q, q)
    low = half_sine(wp.where(upper, cell.row, rows - cell.row), rows)
    high = half_sine(wp.where(upper, cell.row + 1, rows - cell.row - 1), rows)
    return (q - low) / (high - low)


@wp.func
def narrowing(m: wp.mat33, grown: wp.float32) -> wp.float32:
    """Solid angle about a unit vector v over that about M v, |M v| = ``grown``: |M v|^3 / |det M|."""
    return grown * grown * grown / wp.abs(wp.determinant(m))


@wp.func
def cell_share(scene: Scene, row: wp.int32, column: wp.int32, columns: wp.int32) -> wp.float32:
    """Probability of a cell."""
    first = row * (columns + 1) + column
    share_of_row = load_float(scene.env_marginal, row + 1) - load_float(scene.env_marginal, row)
    return share_of_row * (load_float(scene.env_conditional, first + 1) - load_float(scene.env_conditional, first))


@wp.func
def row_buckets(scene: Scene, texture: Texture) -> wp.int32:
    """Buckets of the guide to rows, which starts behind their number (``kernels/distribution.py``)."""
    return wp.int32(load_float(scene.env_marginal, texture.height))


@wp.func
def column_buckets(scene: Scene, texture: Texture) -> wp.int32:
    """Buckets of each guide to the columns of a row."""
    return wp.int32(load_float(scene.env_conditional, (texture.height - 1) * (texture.width + 1)))


@wp.func
def column_guide(texture: Texture, buckets: wp.int32, row: wp.int32) -> wp.int32:
    """Where the guide of a row starts."""
    return (texture.height - 1) * (texture.width + 1) + 1 + row * (buckets + 1)


@wp.func
def stretch(u: wp.float32, low: wp.float32, high: wp.float32, jitter: wp.float32) -> wp.float32:
    """Position of u within [low, high), in [0, 1].

    In a narrow interval u has few bits left. ``jitter`` spreads it over its spacing, which makes the result uniform.
    """
    return (u - low + UNIT * jitter) / (high - low)
