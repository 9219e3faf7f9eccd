"""Image environment in latitude-longitude form, with Mitsuba 3's conventions.

In the light's own frame a direction has the azimuth phi = atan2(x, -z) and the angle theta from +y. Column i of W lies
at phi = 2 pi (i + 1/2) / W, and columns wrap around. Row j of H lies at theta = pi j / (H - 1), so the first and the
last row are the poles. The radiance is ``scale`` times the bilinear interpolation of the texels. Directions are drawn
from the (H - 1) x W *cells* between texel centres. A cell has a constant share (`build_env_distribution`); within it
the density follows the bilinear brightness of the current texels. It is nowhere zero, for a black texel may have a
derivative.
"""

import functools

import warp as wp

from warp_psdr.kernels.angles import arctan2, circle
from warp_psdr.kernels.constants import FAR, INV_PI, INV_TWO_PI
from warp_psdr.kernels.distribution import LEVELS, find_guided
from warp_psdr.kernels.emitter.constant import EnvironmentFunctions
from warp_psdr.kernels.emitter.env_cells import (
    cell_at,
    cell_height,
    cell_share,
    cell_solid_angle,
    column_buckets,
    column_guide,
    corner_density,
    corners_of,
    density_at,
    half_sine,
    interpolate_cell,
    linear_offset,
    load_matrix,
    locate,
    narrowing,
    row_buckets,
    stretch,
)
from warp_psdr.kernels.reading import load_float, texture_record
from warp_psdr.kernels.rng import pcg4d, unit_float
from warp_psdr.kernels.sink import make_sink, make_sink_texel
from warp_psdr.kernels.structs import Emitter, LightAdjoint, LightSample, Scene, Texture
from warp_psdr.kernels.texture.texture import bilinear_dot

#: sin^2 of the angle to a pole below which the azimuth has no derivative (it changes by half a turn within 1e-6 rad).
POLE = 1.0e-12


@wp.func
def draw_in_cell(
    scene: Scene, e: Emitter, texture: Texture, row: wp.int32, column: wp.int32, u: wp.vec2
) -> LightSample:
    """Return the direction that ``u`` means within the cell that it has chosen."""
    result = LightSample()
    result.face = -1
    result.distance = FAR
    rows = texture.height - 1
    columns = texture.width
    first = row * (columns + 1)
    bits = wp.float32(LEVELS) * u
    jitter = pcg4d(wp.uint32(bits[0]), wp.uint32(bits[1]), wp.uint32(row), wp.uint32(column))
    u_x = stretch(
        u[0],
        load_float(scene.env_conditional, first + column),
        load_float(scene.env_conditional, first + column + 1),
        unit_float(jitter.x),
    )
    u_y = stretch(
        u[1], load_float(scene.env_marginal, row), load_float(scene.env_marginal, row + 1), unit_float(jitter.y)
    )

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
    result.radiance = load_float(scene.values, e.scale) * interpolate_cell(corners, cell)
    density = cell_share(scene, row, column, columns) * density_at(b, s, t)
    result.pdf = density / cell_solid_angle(row, rows, columns) * narrowing(m, grown)
    return result


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
        texture = texture_record(scene, e.texture)
        v = wp.inverse(load_matrix(scene.values, e.to_world)) * direction
        cell = locate(texture, v)
        return load_float(scene.values, e.scale) * interpolate_cell(corners_of(scene, texture, cell), cell)

    @wp.func
    def eval_pdf(scene: Scene, e: Emitter, direction: wp.vec3) -> tuple[wp.vec3, wp.float32]:
        texture = texture_record(scene, e.texture)
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
        found = load_float(scene.values, e.scale) * interpolate_cell(corners, cell)
        density *= share / cell_solid_angle(cell.row, rows, texture.width)
        return found, density * narrowing(m, 1.0 / shrunk)

    @wp.func
    def pdf(scene: Scene, e: Emitter, direction: wp.vec3) -> wp.float32:
        _radiance, density = eval_pdf(scene, e, direction)
        return density

    @wp.func
    def sample(scene: Scene, e: Emitter, x: wp.vec3, u: wp.vec2) -> LightSample:
        texture = texture_record(scene, e.texture)
        row = find_guided(scene.env_marginal, 0, texture.height + 1, row_buckets(scene, texture), u[1])
        buckets = column_buckets(scene, texture)
        guide = column_guide(texture, buckets, row)
        column = find_guided(scene.env_conditional, row * (texture.width + 1), guide, buckets, u[0])
        return draw_in_cell(scene, e, texture, row, column, u)

    if role is None:
        return EnvironmentFunctions(sample, radiance, pdf, eval_pdf, None)

    @wp.func
    def eval_vjp(
        scene: Scene, target: wp.array(dtype=wp.float32), e: Emitter, direction: wp.vec3, w: wp.vec3
    ) -> LightAdjoint:
        result = LightAdjoint()
        texture = texture_record(scene, e.texture)
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
