"""The oracle: ``wp.Tape`` differentiates an unrolled path. Slow, depth at most DEPTH, diffuse surfaces, area lights.

A recorder runs the path loop of the renderer and writes down every decision: faces, barycentrics, light points, pdfs.
``contribution`` then recomputes each path from those decisions in plain Warp, in material form (survey eq. 10):
vertices ride on their triangles, every connection carries G J / (G J)_det, the first vertex is where a fixed camera ray
meets its attached triangle. It shares no derivative, and no factor, with the renderer.
"""

import numpy as np
import warp as wp

from warp_psdr.kernels.path import make_camera_start, make_path_step
from warp_psdr.kernels.rng import Sampler
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathVertex

DEPTH = 3
#: wp.Tape differentiates static loops that Warp unrolls, and nothing else; DEPTH is far below its limit of 16.
assert DEPTH <= 16


def record_paths(config, scene, camera, seed, spp, max_depth, rr_depth):
    """Return the vertices, (pixels, spp, DEPTH) of a NumPy structured array, of all paths of a gradient pass."""
    path_step = make_path_step(config, True)
    start = make_camera_start(config)

    @wp.kernel(module="unique", enable_backward=False)
    def recorder(
        scene: Scene,
        camera: Camera,
        samples: wp.int32,
        seed: wp.uint32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
        out: wp.array3d(dtype=PathVertex),
    ):
        pixel = wp.tid()
        for i in range(samples):
            sampler = Sampler()
            sampler.pixel = wp.uint32(pixel)
            sampler.index = wp.uint32(i)
            sampler.seed = seed
            px = pixel % camera.crop_width
            state, _film = start(scene, camera, px, pixel // camera.crop_width, sampler)
            n = wp.int32(0)
            while state.alive == 1 and n < wp.static(DEPTH):
                vertex, state = path_step(scene, sampler, state, max_depth, rr_depth)
                out[pixel, i, n] = vertex
                n += 1

    pixels = camera.crop_width * camera.crop_height
    empty = np.zeros((pixels, spp, DEPTH), dtype=PathVertex.numpy_dtype())
    empty["face"], empty["light"] = -1, -1
    out = wp.array(empty, dtype=PathVertex, device="cpu")
    wp.launch(
        recorder, dim=pixels, inputs=[scene.data(), camera, spp, seed, max_depth, rr_depth], outputs=[out], device="cpu"
    )
    return out.numpy()


@wp.func
def point_on(positions: wp.array(dtype=wp.vec3), faces: wp.array2d(dtype=wp.int32), f: wp.int32, b: wp.vec2) -> wp.vec3:
    p0 = positions[faces[f, 0]]
    p1 = positions[faces[f, 1]]
    p2 = positions[faces[f, 2]]
    return (1.0 - b[0] - b[1]) * p0 + b[0] * p1 + b[1] * p2


@wp.func
def doubled_normal(positions: wp.array(dtype=wp.vec3), faces: wp.array2d(dtype=wp.int32), f: wp.int32) -> wp.vec3:
    p0 = positions[faces[f, 0]]
    return wp.cross(positions[faces[f, 1]] - p0, positions[faces[f, 2]] - p0)


@wp.func
def transfer(x: wp.vec3, n: wp.vec3, y: wp.vec3, c: wp.vec3) -> wp.float32:
    """Cosine at x times the geometric factor and area element (doubled) at y."""
    r = y - x
    squared = wp.dot(r, r)
    length = wp.sqrt(squared)
    return wp.dot(n, r) / length * (-wp.dot(c, r)) / (squared * length)


@wp.kernel(module="unique")
def contribution(
    # In: attached values.
    positions: wp.array(dtype=wp.vec3),
    albedo: wp.array(dtype=wp.vec3),
    radiance: wp.array(dtype=wp.vec3),
    # In: the same positions, detached, and what was decided.
    fixed: wp.array(dtype=wp.vec3),
    faces: wp.array2d(dtype=wp.int32),
    face_shape: wp.array(dtype=wp.int32),
    origin: wp.vec3,
    direction: wp.array(dtype=wp.vec3),
    face: wp.array2d(dtype=wp.int32),
    bary: wp.array2d(dtype=wp.vec2),
    emission_weight: wp.array2d(dtype=wp.float32),
    next_weight: wp.array2d(dtype=wp.float32),
    light_face: wp.array2d(dtype=wp.int32),
    light_bary: wp.array2d(dtype=wp.vec2),
    light_weight: wp.array2d(dtype=wp.float32),
    adjoint: wp.array(dtype=wp.vec3),
    # Out:
    loss: wp.array(dtype=wp.float32),
):
    path = wp.tid()
    # The first vertex: a fixed ray meets the attached plane.
    f0 = face[path, 0]
    c = doubled_normal(positions, faces, f0)
    corner = positions[faces[f0, 0]]
    x = origin + (wp.dot(corner - origin, c) / wp.dot(direction[path], c)) * direction[path]
    throughput = wp.vec3(1.0, 1.0, 1.0)
    total = wp.vec3(0.0, 0.0, 0.0)
    for n in range(wp.static(DEPTH)):
        f = face[path, n]
        shape = face_shape[f]
        c_f = doubled_normal(positions, faces, f)
        normal = c_f / wp.length(c_f)
        x_fixed = point_on(fixed, faces, f, bary[path, n])
        c_fixed = doubled_normal(fixed, faces, f)
        normal_fixed = c_fixed / wp.length(c_fixed)
        total = total + emission_weight[path, n] * wp.cw_mul(throughput, radiance[shape])
        # Next-event estimation, divided by the detached measure: weight * f L cos' ratio.
        g = light_face[path, n]
        y = point_on(positions, faces, g, light_bary[path, n])
        y_fixed = point_on(fixed, faces, g, light_bary[path, n])
        moved = transfer(x, normal, y, doubled_normal(positions, faces, g))
        unmoved = transfer(x_fixed, normal_fixed, y_fixed, doubled_normal(fixed, faces, g))
        found = light_weight[path, n] * moved / unmoved * wp.cw_mul(albedo[shape], radiance[face_shape[g]])
        total = total + wp.cw_mul(throughput, found)
        # Scattering to the next vertex.
        if wp.static(n + 1 < DEPTH):
            h = face[path, n + 1]
            z = point_on(positions, faces, h, bary[path, n + 1])
            z_fixed = point_on(fixed, faces, h, bary[path, n + 1])
            moved_z = transfer(x, normal, z, doubled_normal(positions, faces, h))
            unmoved_z = transfer(x_fixed, normal_fixed, z_fixed, doubled_normal(fixed, faces, h))
            throughput = next_weight[path, n] * moved_z / unmoved_z * wp.cw_mul(throughput, albedo[shape])
            x = z
    wp.atomic_add(loss, 0, wp.dot(adjoint[path], total))


def gradients(scene, vertices, camera_position, albedo, radiance, adjoint):
    """Return (d loss / d positions, d loss / d albedo of each shape, d loss / d radiance, loss).

    Args:
        scene: the loaded scene.
        vertices: of ``record_paths``, flattened to (paths, DEPTH).
        camera_position: (3,).
        albedo: (shapes, 3).
        radiance: (shapes, 3), zero where nothing shines.
        adjoint: (paths, 3), weight of each path.
    """
    positions = scene.positions_numpy
    faces = scene.faces_numpy
    normals = np.cross(*(positions[faces[:, k]] - positions[faces[:, 0]] for k in (1, 2)))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    face = vertices["face"].copy()
    bary = np.stack([vertices["u"], vertices["v"]], axis=-1)
    hit = face >= 0
    front = np.einsum("pnk,pnk->pn", normals[face], vertices["d"]) < 0.0
    emission = np.where(hit & front, vertices["e_weight"], 0.0)
    # Where there is no light point or no next vertex, a point of another shape with weight 0 keeps all numbers finite.
    for n in range(1, DEPTH):
        missing = face[:, n] < 0
        face[missing, n] = (face[missing, n - 1] + len(faces) // 2) % len(faces)
        bary[missing, n] = 1.0 / 3.0
    lit = vertices["light"] >= 0
    light_face = np.where(lit, vertices["light_face"], (face + len(faces) // 2) % len(faces))
    light_bary = np.stack([vertices["light_u"], vertices["light_v"]], axis=-1)
    light_bary[~lit] = 1.0 / 3.0
    cosine = np.einsum("pnk,pnk->pn", normals[face], vertices["light_wi"])
    light_weight = np.where(lit, vertices["light_weight"] * cosine / np.pi, 0.0)
    going = (vertices["lobe"] > 0) & np.roll(hit, -1, axis=1)
    cosine = np.einsum("pnk,pnk->pn", normals[face], vertices["wo"])
    next_weight = np.where(going, vertices["inv_pdf"] * cosine / np.pi, 0.0)
    assert (face >= 0).all() and (light_face >= 0).all()

    def fixed(a, dtype):
        return wp.array(np.ascontiguousarray(a), dtype=dtype, device="cpu")

    attached = [wp.array(a, dtype=wp.vec3, device="cpu", requires_grad=True) for a in (positions, albedo, radiance)]
    loss = wp.zeros(1, dtype=wp.float32, device="cpu", requires_grad=True)
    tape = wp.Tape()
    with tape:
        wp.launch(
            contribution,
            dim=len(face),
            inputs=[
                *attached,
                fixed(positions, wp.vec3),
                fixed(faces, wp.int32),
                fixed(scene.face_shape_numpy, wp.int32),
                wp.vec3(*camera_position),
                fixed(vertices["d"][:, 0], wp.vec3),
                fixed(face, wp.int32),
                fixed(bary, wp.vec2),
                fixed(emission, wp.float32),
                fixed(next_weight, wp.float32),
                fixed(light_face, wp.int32),
                fixed(light_bary, wp.vec2),
                fixed(light_weight, wp.float32),
                fixed(adjoint, wp.vec3),
            ],
            outputs=[loss],
            device="cpu",
        )
    tape.backward(loss)
    return *(a.grad.numpy() for a in attached), float(loss.numpy()[0])
