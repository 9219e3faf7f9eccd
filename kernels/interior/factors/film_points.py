"""The image of a material point on the film: its motion under the pixel filter, and the change of its area [ZYZ21].

A first vertex that stays on its surface, or a direction of the sky that stays in the world, has an image u that moves
with the camera and the surface. One local function of all that the image depends on gives both derivatives.

Derivation: ``docs/theory/interior.md#mirrored-film-points``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor, differentiable
from warp_psdr.kernels.sensor.camera import half_width, load_mat44
from warp_psdr.kernels.sink import make_sink
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import point_on
from warp_psdr.kernels.vertex import PathVertex

#: Film points that are mirrored images of each other.
MIRRORED = 4


@wp.struct
class FilmAdjoint:
    """Adjoints of a material point and of its triangle's cross product, by its image. ``dot``: what sinks returned."""

    x: wp.vec3
    c: wp.vec3
    dot: wp.float32


@differentiable
@wp.func
def film_form(
    x: wp.vec3, cross: wp.vec3, m: wp.mat44, fov: wp.float32, cx: wp.float32, cy: wp.float32,
    width: wp.float32, height: wp.float32, n: wp.vec2, h: wp.float32,
) -> wp.float32:  # fmt: skip
    """Local factor of a material point's image: n . u(x), u in pixels, plus h times ln(du / dA) of the film's area."""
    block = wp.mat33(m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2], m[2, 0], m[2, 1], m[2, 2])
    r = x - wp.vec3(m[0, 3], m[1, 3], m[2, 3])
    p = wp.inverse(block) * r
    k = half_width(fov)
    u = 0.5 * width * (1.0 - p[0] / (p[2] * k)) - width * cx
    v = 0.5 * height * (1.0 - p[1] * width / (p[2] * k * height)) - height * cy
    area = wp.log(wp.abs(wp.dot(cross, r))) - wp.log(wp.abs(wp.determinant(block)))
    return n[0] * u + n[1] * v + h * (area - 3.0 * wp.log(p[2]) - 2.0 * wp.log(k))


@functools.cache
def make_film_sink(role: str, camera_moves: bool):
    """Return ``accumulate_film(scene, target, camera, first, n, h) -> FilmAdjoint``, ``n`` and ``h`` of ``film_form``.

    It scatters the camera's adjoint and hands on those of the first vertex; of a ray that left the scene the direction
    rests in the world, and the camera's place does not matter.
    """
    sink = make_sink(role)

    @wp.func
    def accumulate_film(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        camera: Camera,
        first: PathVertex,
        n: wp.vec2,
        h: wp.float32,
    ) -> FilmAdjoint:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        r = FilmAdjoint()
        m = load_mat44(scene.values, camera.to_world)
        columns = wp.int32(4)
        x = first.d
        cross = first.d
        if first.face >= 0:
            tri = scene.triangles[first.face]
            x = point_on(tri, first.u, first.v)
            cross = wp.cross(tri.p1 - tri.p0, tri.p2 - tri.p0)
        else:
            columns = wp.int32(3)
            m[0, 3] = 0.0
            m[1, 3] = 0.0
            m[2, 3] = 0.0
        g_x, g_c, g_m, g_fov, g_cx, g_cy, _w, _h, _n, _f = wp.grad(film_form)(
            x,
            cross,
            m,
            scene.values[camera.x_fov],
            scene.values[camera.principal],
            scene.values[camera.principal + 1],
            wp.float32(camera.width),
            wp.float32(camera.height),
            n,
            h,
        )
        if first.face >= 0:
            r.x = g_x
            r.c = g_c
        if wp.static(camera_moves):
            r.dot += sink(target, camera.x_fov, g_fov)
            r.dot += sink(target, camera.principal, g_cx)
            r.dot += sink(target, camera.principal + 1, g_cy)
            for row in range(3):
                for column in range(columns):
                    r.dot += sink(target, camera.to_world + 4 * row + column, g_m[row, column])
        return r

    return accumulate_film
