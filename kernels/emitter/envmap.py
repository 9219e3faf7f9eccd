"""Image environment in latitude-longitude form, Mitsuba 3's conventions.

In the light's own frame a direction has the azimuth phi = atan2(x, -z) and the angle theta from +y. Column i of W lies
at phi = 2 pi (i + 1/2) / W, and columns wrap around; row j of H lies at theta = pi j / (H - 1), so that the first and
the last row are the poles. The radiance is ``scale`` times the bilinear interpolation of the texels.

Directions are drawn from the *cells* between texel centres, of which there are H - 1 rows of W. A cell has a constant
share (`build_env_distribution`); within it the density follows the bilinear brightness of the current texels. It is
nowhere zero, for a black texel may have a derivative.
"""

import functools

import warp as wp

from warp_psdr.kernels.angles import arctan2, circle, sin_quarter
from warp_psdr.kernels.constants import FAR, INV_PI, INV_TWO_PI, ONE_MINUS_EPSILON, TWO_PI
from warp_psdr.kernels.distribution import LEVELS, find_interval
from warp_psdr.kernels.emitter.constant import EnvironmentFunctions
from warp_psdr.kernels.invalid import finite, vanishes
from warp_psdr.kernels.rng import UNIT, pcg4d, unit_float
from warp_psdr.kernels.sink import make_sink, make_sink_texel
from warp_psdr.kernels.structs import Emitter, LightAdjoint, LightSample, Scene, Texture
from warp_psdr.kernels.texture.texture import bilinear_dot, texel

#: Share of the samples within a cell that is uniform: bounds the variance of a black texel's derivative.
UNIFORM_CELL = 0.1
#: sin^2 of the angle to a pole below which the azimuth has no derivative (it changes by half a turn within 1e-6 rad).
POLE = 1.0e-12


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
        values[offset],
        values[offset + 1],
        values[offset + 2],
        values[offset + 4],
        values[offset + 5],
        values[offset + 6],
        values[offset + 8],
        values[offset + 9],
        values[offset + 10],
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
    somewhere = finite(v) and not vanishes(v)
    d = wp.where(somewhere, v, wp.vec3(0.0, 1.0, 0.0))
    # Both angles by the arctangent of two: accurate everywhere, poles included, and independent of the vector's length.
    x = arctan2(d[0], -d[2]) * INV_TWO_PI * wp.float32(texture.width) - 0.5
    y = arctan2(wp.sqrt(d[0] * d[0] + d[2] * d[2]), d[1]) * INV_PI * wp.float32(rows)
    left = wp.floor(x)
    column = wp.int32(left)
    if column < 0:
        column += texture.width
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
    t = wp.float32(0.0)
    if 2 * cell.row < rows:
        q = wp.where(v[1] < 0.0, 1.0 - q, q)
        low = half_sine(cell.row, rows)
        t = (q - low) / (half_sine(cell.row + 1, rows) - low)
    else:
        q = wp.where(v[1] > 0.0, 1.0 - q, q)
        low = half_sine(rows - cell.row, rows)
        t = (q - low) / (half_sine(rows - cell.row - 1, rows) - low)
    return t


@wp.func
def narrowing(m: wp.mat33, grown: wp.float32) -> wp.float32:
    """Solid angle about a unit vector v over that about M v, |M v| = ``grown``: |M v|^3 / |det M|."""
    return grown * grown * grown / wp.abs(wp.determinant(m))


@wp.func
def cell_share(scene: Scene, row: wp.int32, column: wp.int32, columns: wp.int32) -> wp.float32:
    """Probability of a cell."""
    first = row * (columns + 1) + column
    return (scene.env_marginal[row + 1] - scene.env_marginal[row]) * (
        scene.env_conditional[first + 1] - scene.env_conditional[first]
    )


@wp.func
def stretch(u: wp.float32, low: wp.float32, high: wp.float32, jitter: wp.float32) -> wp.float32:
    """Position of u within [low, high), in [0, 1].

    In a narrow interval u has few bits left. ``jitter`` spreads it over its spacing, which makes the result uniform.
    """
    return (u - low + UNIT * jitter) / (high - low)


@functools.cache
def make_envmap(role: str | None, wanted: tuple[str, ...]) -> EnvironmentFunctions:
    """Return the functions of the environment map (see `EnvironmentFunctions`).

    Sampled directions are fixed in world space: neither texels nor pose move them. ``to_world`` is any matrix with an
    inverse; its translation has no effect.

    Args:
        role: "reverse", "forward", or None for a light that is not differentiated.
        wanted: "radiance" scatters to texels and scale, "pose" to the matrix.
    """
    sink = make_sink(role) if role else None
    sink_texel = make_sink_texel(role) if role else None

    @wp.func
    def radiance(scene: Scene, e: Emitter, direction: wp.vec3) -> wp.vec3:
        texture = scene.textures[e.texture]
        v = wp.inverse(load_matrix(scene.values, e.to_world)) * direction
        cell = locate(texture, v)
        return scene.values[e.scale] * interpolate_cell(corners_of(scene, texture, cell), cell)

    @wp.func
    def eval_pdf(scene: Scene, e: Emitter, direction: wp.vec3) -> tuple[wp.vec3, wp.float32]:
        texture = scene.textures[e.texture]
        rows = texture.height - 1
        m = load_matrix(scene.values, e.to_world)
        v = wp.inverse(m) * direction
        shrunk = wp.length(v)
        v = v / shrunk
        cell = locate(texture, v)
        corners = corners_of(scene, texture, cell)
        t = cell_height(cell, v, rows)
        density = density_at(corner_density(corners), cell.fx, t)
        share = cell_share(scene, cell.row, cell.column, texture.width)
        found = scene.values[e.scale] * interpolate_cell(corners, cell)
        density *= share / cell_solid_angle(cell.row, rows, texture.width)
        return found, density * narrowing(m, 1.0 / shrunk)

    @wp.func
    def pdf(scene: Scene, e: Emitter, direction: wp.vec3) -> wp.float32:
        _radiance, density = eval_pdf(scene, e, direction)
        return density

    @wp.func
    def sample(scene: Scene, e: Emitter, x: wp.vec3, u: wp.vec2) -> LightSample:
        result = LightSample()
        result.face = -1
        result.distance = FAR
        texture = scene.textures[e.texture]
        rows = texture.height - 1
        columns = texture.width
        row = find_interval(scene.env_marginal, 0, rows, u[1])
        first = row * (columns + 1)
        column = find_interval(scene.env_conditional, first, columns, u[0])
        bits = wp.float32(LEVELS) * u
        jitter = pcg4d(wp.uint32(bits[0]), wp.uint32(bits[1]), wp.uint32(row), wp.uint32(column))
        u_x = stretch(
            u[0], scene.env_conditional[first + column], scene.env_conditional[first + column + 1], unit_float(jitter.x)
        )
        u_y = stretch(u[1], scene.env_marginal[row], scene.env_marginal[row + 1], unit_float(jitter.y))

        # Within the cell: first the vertical position, from the means of the two rows, then the horizontal one.
        cell = cell_at(texture, row, column)
        corners = corners_of(scene, texture, cell)
        b = corner_density(corners)
        t = linear_offset(u_y, b.b00 + b.b10, b.b01 + b.b11)
        s = linear_offset(u_x, (1.0 - t) * b.b00 + t * b.b01, (1.0 - t) * b.b10 + t * b.b11)
        upper = 2 * row < rows
        q0 = half_sine(wp.where(upper, row, rows - row), rows)
        q1 = half_sine(wp.where(upper, row + 1, rows - row - 1), rows)
        q = (1.0 - t) * q0 + t * q1
        azimuth = circle((wp.float32(column) + 0.5 + s) / wp.float32(columns))
        root = wp.sqrt(q)
        other = wp.sqrt(1.0 - q)
        sin_theta = 2.0 * root * other
        cos_theta = wp.where(upper, 1.0 - 2.0 * q, 2.0 * q - 1.0)
        v = wp.vec3(sin_theta * azimuth[1], cos_theta, -sin_theta * azimuth[0])
        # Texels are interpolated in theta, counted from the nearer pole; root = sin(theta / 2).
        y = 2.0 * INV_PI * wp.float32(rows) * arctan2(root, other)
        cell.fx = s
        cell.fy = wp.clamp(wp.where(upper, y - wp.float32(row), wp.float32(rows - row) - y), 0.0, 1.0)

        # Not ``wp.normalize``, which makes zero of NaN: a direction that no surface scatters to.
        m = load_matrix(scene.values, e.to_world)
        wi = m * v
        grown = wp.length(wi)
        result.wi = wi / grown
        result.radiance = scene.values[e.scale] * interpolate_cell(corners, cell)
        density = cell_share(scene, row, column, columns) * density_at(b, s, t)
        result.pdf = density / cell_solid_angle(row, rows, columns) * narrowing(m, grown)
        return result

    if role is None:
        return EnvironmentFunctions(sample, radiance, pdf, eval_pdf, None)

    @wp.func
    def eval_vjp(
        scene: Scene, target: wp.array(dtype=wp.float32), e: Emitter, direction: wp.vec3, w: wp.vec3
    ) -> LightAdjoint:
        result = LightAdjoint()
        texture = scene.textures[e.texture]
        n = texture.channels
        to_local = wp.inverse(load_matrix(scene.values, e.to_world))
        v = to_local * direction
        cell = locate(texture, v)
        corners = corners_of(scene, texture, cell)
        scaled = scene.values[e.scale] * w
        w00, w10, w01, w11, d_fx, d_fy, _w = wp.grad(bilinear_dot)(
            corners.t00,
            corners.t10,
            corners.t01,
            corners.t11,
            cell.fx,
            cell.fy,
            scaled,
        )
        # Adjoint of the angles, then of v: phi = atan2(x, -z), theta = atan2(r, y), r^2 = x^2 + z^2.
        d_phi = d_fx * wp.float32(texture.width) * INV_TWO_PI
        d_theta = d_fy * wp.float32(texture.height - 1) * INV_PI
        r2 = v[0] * v[0] + v[2] * v[2]
        length2 = r2 + v[1] * v[1]
        d_v = wp.vec3(0.0, 0.0, 0.0)
        if r2 > POLE * length2:
            r = wp.sqrt(r2)
            d_r = d_theta * v[1] / (length2 * r)
            d_v = wp.vec3(d_r * v[0] - d_phi * v[2] / r2, -d_theta * r / length2, d_r * v[2] + d_phi * v[0] / r2)
        # v = M^-1 d: dv = M^-1 (dd - dM v).
        d_direction = wp.transpose(to_local) * d_v
        result.x = d_direction
        if wp.static("radiance" in wanted):
            result.dot += sink(target, e.scale, wp.dot(w, interpolate_cell(corners, cell)))
            result.dot += sink_texel(target, cell.i00, n, w00) + sink_texel(target, cell.i10, n, w10)
            result.dot += sink_texel(target, cell.i01, n, w01) + sink_texel(target, cell.i11, n, w11)
        if wp.static("pose" in wanted):
            for i in range(wp.static(3)):
                for j in range(wp.static(3)):
                    result.dot += sink(target, e.to_world + 4 * i + j, -d_direction[i] * v[j])
        return result

    return EnvironmentFunctions(sample, radiance, pdf, eval_pdf, eval_vjp)
