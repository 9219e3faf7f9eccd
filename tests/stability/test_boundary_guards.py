"""Guards of the boundary term's estimators: what comes out without one is not finite, or belongs to another place."""

import math

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.boundary.scenes import ball
from tests.boundary.test_facets import gradient
from warp_psdr.estimate.boundary import terms
from warp_psdr.kernels.boundary.edge_sampling.edge_sampling import make_edge_sample
from warp_psdr.kernels.boundary.edge_sampling.edge_tree import EdgeTrees
from warp_psdr.kernels.boundary.guiding.light_square import make_light_square
from warp_psdr.kernels.boundary.guiding.stripe import stripe_at
from warp_psdr.kernels.boundary.guiding.techniques import make_techniques
from warp_psdr.kernels.boundary.local_form import Edges, edge_point, edge_step
from warp_psdr.kernels.boundary.path_space.intersection_curve import MAX_SHIFT, make_curve_segment
from warp_psdr.kernels.boundary.path_space.secondary import make_segment
from warp_psdr.kernels.boundary.shading_normals.indirect_terminator import make_jump
from warp_psdr.kernels.boundary.transport import Segment
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.structs import Scene
from warp_psdr.plan.motion import motion
from warp_psdr.plan.plan import decide
from warp_psdr.topology.edge_trees import edge_trees
from warp_psdr.topology.edges import curve_edges
from warp_psdr.topology.intersection_curves import scene_curves
from warp_psdr.topology.secondary_edges import secondary_edges

from .sweeps import box, room
from .test_crossing import camera, plates


def test_a_path_vertex_on_a_curve_is_near_it_and_has_a_density() -> None:
    """Plates that cross at an angle of 3e-3, and directions of all of the hemisphere's rim.

    Three ray epsilons above the other plate is a thousand of them off the curve, one in a hundred of the scene.
    """
    floor = {"type": "rectangle"}
    scene = psdr.load_dict({"type": "scene", "camera": camera(), "floor": floor} | plates(3e-3, 1.0, 1.5))
    config = psdr.plan(scene, integrator=psdr.PathIntegrator(max_depth=3)).config
    segment = make_curve_segment(config.rays, config.surfaces.primitives)
    edges = curve_edges(scene, scene_curves(scene))

    @wp.kernel(module="unique", enable_backward=False)
    def drawn(
        scene: Scene,
        edges: Edges,
        u4: wp.array(dtype=wp.vec4),
        scale_out: wp.array(dtype=wp.float32),
        steps_out: wp.array(dtype=wp.float32),
    ):
        i = wp.tid()
        point = edge_point(scene, edges, i, u4.shape[0], 0.5)
        s = segment(scene, edges, point, i % 2, u4[i])
        if s.valid == 1:
            scale_out[i] = s.scale
            steps_out[i] = wp.length(s.x - point.x) / edge_step(scene, edges, point.edge)

    rim = np.linspace(0.0, 0.99999994, 1 << 14, dtype=np.float32)
    ends = [np.stack([rim, np.full_like(rim, end)]) for end in (0.0, 0.99999994)]
    u = np.concatenate([*ends, *(end[::-1] for end in ends)], axis=1)
    u4 = np.concatenate([u, np.random.default_rng(1).random(u.shape, np.float32)]).T
    scale, steps = wp.zeros(len(u4), dtype=wp.float32), wp.zeros(len(u4), dtype=wp.float32)
    wp.launch(drawn, len(u4), [scene.data(), edges, wp.array(u4, dtype=wp.vec4)], [scale, steps])
    assert np.isfinite(scale.numpy()).all() and scale.numpy().any()
    assert 0.9 * MAX_SHIFT < steps.numpy().max() < 1.01 * MAX_SHIFT


def test_lights_that_an_edge_is_not_aimed_at_have_no_coordinates() -> None:
    """Other shapes, lights seen from behind, and those that nothing beside the edge hides."""
    scene = psdr.load_dict(room())
    _aim, coordinates = make_light_square(psdr.plan(scene, integrator=psdr.PathIntegrator(max_depth=3)).config.lights)
    edges = secondary_edges(scene, {1})

    @wp.kernel(module="unique", enable_backward=False)
    def asked(
        scene: Scene, edges: Edges, point_out: wp.array2d(dtype=wp.float64), share_out: wp.array2d(dtype=wp.float32)
    ):
        i, k = wp.tid()
        point = edge_point(scene, edges, i, point_out.shape[0], 0.5)
        face = scene.emitters[0].first_face
        w = scene.triangles[face].normal
        if k == 0:
            point_out[i, k] = coordinates(scene, edges, point, face, 0.3, 0.3, -w)[0]
        elif k == 1:
            point_out[i, k] = coordinates(scene, edges, point, face, 0.3, 0.3, w)[0]
        else:
            point_out[i, k] = coordinates(scene, edges, point, 0, 0.3, 0.3, -scene.triangles[0].normal)[0]
        share_out[i, k] = stripe_at(scene, edges, point, face).share

    found = wp.zeros((256, 3), dtype=wp.float64), wp.zeros((256, 3), dtype=wp.float32)
    wp.launch(asked, (256, 3), [scene.data(), edges], list(found))
    (front, back, other), share = found[0].numpy().T, found[1].numpy()[:, 0]
    assert 0.5 < (share > 0.0).mean() < 0.99
    np.testing.assert_array_equal(front >= 0.0, share > 0.0)
    assert (back < 0.0).all() and (other < 0.0).all()


def test_the_last_coordinates_are_a_direction_of_a_map() -> None:
    """They are of double precision, and the largest of them no float32 below one; beside the pole cells are narrow."""
    sky = np.full((2048, 4, 3), 100.0, np.float32)
    sky[-1] = 0.0
    plate, light = {"type": "rectangle"}, {"type": "envmap", "bitmap": sky}
    scene = psdr.load_dict({"type": "scene", "camera": camera(), "plate": plate, "light": light})
    aim, _coordinates = make_light_square(psdr.plan(scene, integrator=psdr.PathIntegrator(max_depth=2)).config.lights)
    edges = secondary_edges(scene, {0})

    @wp.kernel(module="unique", enable_backward=False)
    def aimed(scene: Scene, edges: Edges, u: wp.array(dtype=wp.float64), w_out: wp.array2d(dtype=wp.vec3)):
        i, k = wp.tid()
        point = edge_point(scene, edges, 0, 1, 0.5)
        w_out[i, k] = aim(scene, edges, point, u[i], u[k]).w

    u = np.concatenate([1.0 - 10.0 ** np.linspace(-16.0, -6.0, 64), np.linspace(0.0, 1.0, 64)])
    w = wp.zeros((len(u), len(u)), dtype=wp.vec3)
    wp.launch(aimed, w.shape, [scene.data(), edges, wp.array(u)], [w])
    np.testing.assert_allclose(np.linalg.norm(w.numpy(), axis=2), 1.0, atol=1e-6)


# --- creases of small angles, which one path for both faces estimates ---

RIDGE, LIFT = "ridge.vertex_positions", np.tile([0.0, 0.0, 1.0], 6)


def crease(slant: float, half: float = 0.6, eye: float = -3.0, near: float = 0.01, **more) -> float:
    """Return by how much images change as a ridge rises; all of it shines back, and one face is seen at an angle."""
    y, z = [0, 0, 1, 1, -1, -1], [0, 0, 0.1, 0.1, -slant, -slant]
    vertices = np.stack([np.tile([-half, half], 3), y, z], axis=1)
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 5, 1], [4, 1, 0]])
    view = psdr.Transform.look_at((0.0, eye, 0.0), (0.0, 0.0, 0.0), (0, 0, 1))
    scene = psdr.load_dict(
        {
            "type": "scene",
            "camera": camera(to_world=view, near_clip=near),
            "ridge": {"type": "mesh", "vertices": vertices, "faces": faces, "face_normals": True},
            "light": {"type": "point", "position": [0.0, 0.5, 1.2]},
        }
        | more
    )
    plan = decide(scene, psdr.traverse(scene), integrator=psdr.PathIntegrator(max_depth=2), names=[RIDGE])
    request = terms.Request(scene, plan, motion(scene, [RIDGE]), "reverse", 0, 64, 0)
    (term,) = terms.launches(terms.named("flat_creases"), request)
    return float(gradient(request, RIDGE, term) @ LIFT)


@pytest.mark.slow
def test_creases_beside_a_face_seen_nearly_edge_on() -> None:
    """At 4.8e-5 radians: rays beside the crease must start in front of the face, farther away than usual."""
    assert abs(crease(4.8e-5, 0.1) / crease(1e-3, 0.1) - 1.0) < 0.05


@pytest.mark.slow
def test_creases_close_to_the_camera() -> None:
    """What is behind the camera, nearer than rays otherwise start, is not met."""
    wall = {
        "type": "rectangle",
        "to_world": psdr.Transform.translate([0, -0.0155, 0]) @ psdr.Transform.rotate([1, 0, 0], 90),
    }
    close = {"slant": 0.02, "eye": -0.015, "near": 1e-3}
    assert crease(**close, wall=wall) == crease(**close) != 0.0


@pytest.mark.slow
def test_creases_behind_what_is_nearly_there() -> None:
    """A plate that covers the ridge nearer than rays towards the camera start has its image, and the ridge none."""
    plate = {
        "type": "rectangle",
        "to_world": psdr.Transform.translate([0, -1e-4, 0]) @ psdr.Transform.rotate([1, 0, 0], 90),
    }
    assert crease(0.2, plate=plate) == 0.0 != crease(0.2)


# --- terminators of interpolated normals ---


def terminator(shape: dict, parameter: str, seed: int = 0, kinds=("terminator",), **more) -> tuple[np.ndarray, int]:
    """Return the gradient of the term of the terminators, or others, and how many of its samples were not finite."""
    view = camera(to_world=psdr.Transform.look_at((0.3, -3.0, 2.0), (0.0, 0.0, 0.0), (0, 0, 1)))
    scene = psdr.load_dict({"type": "scene", "camera": view, "shape": shape, "sky": {"type": "constant"}} | more)
    plan = decide(scene, psdr.traverse(scene), integrator=psdr.PathIntegrator(max_depth=2), names=[parameter])
    request = terms.Request(scene, plan, motion(scene, [parameter]), "reverse", 0, 64, seed)
    found = [gradient(request, parameter, t) for kind in kinds for t in terms.launches(terms.named(kind), request)]
    assert len(found) == len(kinds)
    return np.sum(found, axis=0), psdr.invalid_samples(scene)["terminator"]


@pytest.mark.slow
def test_terminators_of_fine_meshes_count_once() -> None:
    """Of a ball of 81,920 triangles rays past the silhouette pass some of them, too: those are no curves of their own.

    Where rays past the curve go nearer or farther than past the silhouette, the sum misses some, or has them twice.
    """
    found = []
    below = psdr.Transform.translate([0.0, 0.0, -1.2]) @ psdr.Transform.scale(3.0)
    floor = {"type": "rectangle", "to_world": below}
    kinds = ("primary", "terminator")
    for subdivisions in (5, 6):
        shape = ball((0.0, 0.0, 0.0), 1.0, {"type": "diffuse"}, subdivisions=subdivisions, smooth=True)
        outwards = np.asarray(shape["vertices"], np.float64).reshape(-1)
        name = "shape.vertex_positions"
        found.append(np.mean([terminator(shape, name, k, kinds, floor=floor)[0] @ outwards for k in range(16)]))
    assert abs(found[1] / found[0] - 1.0) < 0.05


@pytest.mark.slow
def test_where_normals_cancel_is_no_terminator() -> None:
    """Along a line of the triangle its interpolated normal is 0, and so is its product with the line of sight."""
    n = np.array([0.0, 0.6, 0.8])
    shape = {"type": "mesh", "vertices": [[-1, -1, 0], [1, -1, 0], [0, 1, 0]], "faces": [[0, 1, 2]]}
    found, dropped = terminator(shape | {"normals": np.array([n, n, -n])}, "shape.vertex_positions")
    assert dropped == 0 and np.isfinite(found).all()


# --- two surfaces that continue each other ---


@pytest.mark.slow
def test_a_border_between_plates_in_one_plane_moves_with_both() -> None:
    """Their normals are the same but for roundings, by whose difference the border's velocity must not be split."""
    tilt, at = 0.3, 0.2
    plates = {}
    for name, x, shine in (("a", (-3.0, -1.0, at), 1.0), ("b", (at, 1.1, 3.1), 5.0)):
        corners = np.array([[u, v, 3.0 + tilt * u] for u in x for v in (-3.0, 3.0)])
        faces = np.array([[0, 1, 3], [0, 3, 2], [2, 3, 5], [2, 5, 4]])
        plates[name] = {
            "type": "mesh", "vertices": corners, "faces": faces, "face_normals": True,
            "bsdf": {"type": "diffuse", "reflectance": 0.0}, "emitter": {"type": "area", "radiance": shine},
        }  # fmt: skip
    scene = psdr.load_dict({"type": "scene", "camera": camera()} | plates)
    params = psdr.traverse(scene)
    tangents = {f"{name}.vertex_positions": np.tile(np.float32([1.0, 0.0, tilt]), (6, 1)) for name in plates}
    found = psdr.render_forward(scene, params, tangents, integrator=psdr.PathIntegrator(max_depth=1), spp=256).numpy()
    z = 3.0 + tilt * at
    speed = (1.0 / z - tilt * at / z**2) / math.tan(math.radians(20.0))
    assert abs(float(found.mean(dtype=np.float64)) / (0.5 * speed * (1.0 - 5.0)) - 1.0) < 1e-3


def sunk():
    """Return a room whose box reaches into floor and wall less deep than rays start off edges; it ends at x = 0.7."""
    wall = [[-2.0, 0.5998, 0.0], [2.0, 0.5998, 0.0], [2.0, 0.5998, 2.0], [-2.0, 0.5998, 2.0]]
    description = room(extra={"wall": {"type": "mesh", "vertices": wall, "faces": [[0, 1, 2], [0, 2, 3]]}})
    vertices, faces = box((0.2, 0.1, 0.4998), 0.5, 0.0)
    return psdr.load_dict(description | {"box": description["box"] | {"vertices": vertices, "faces": faces}})


def test_where_a_box_sinks_into_the_floor_segments_end_at_its_edge() -> None:
    """Rays towards the floor start in front of the edge, where a sunk edge is below it: tau is 1 there, not more."""
    scene = sunk()
    config = psdr.plan(scene, integrator=psdr.PathIntegrator(max_depth=3)).config
    segment, place = make_segment(config), make_techniques(config.lights, False)[2]

    @wp.kernel(module="unique", enable_backward=False)
    def drawn(
        scene: Scene,
        edges: Edges,
        moving: wp.array(dtype=wp.int32),
        u: wp.array(dtype=wp.vec3d),
        tau_out: wp.array(dtype=wp.float32),
    ):
        i = wp.tid()
        aim = place(scene, edges, u[i], 1)
        s = segment(scene, edges, moving, aim.point, aim.direction, False)
        if s.valid == 1:
            tau_out[i] = s.tau

    u = np.random.default_rng(1).random((1 << 16, 3))
    moving = wp.array([0, 1, 0, 0], dtype=wp.int32)
    tau = wp.zeros(len(u), dtype=wp.float32)
    wp.launch(drawn, len(u), [scene.data(), secondary_edges(scene, {1}), moving, wp.array(u, dtype=wp.vec3d)], [tau])
    assert tau.numpy().min() >= 0.0 and tau.numpy().max() == 1.0


@pytest.mark.slow
def test_points_close_to_an_edge_see_it_from_where_they_are() -> None:
    """As near as rays start off edges, which else started behind the point; of an edge in a wall tau is 1."""
    scene = sunk()
    config = psdr.plan(scene, integrator=psdr.PathIntegrator(max_depth=3)).config
    edge_sample = make_edge_sample(config, False, 16)
    edges = secondary_edges(scene, {1})

    @wp.kernel(module="unique", enable_backward=False)
    def drawn(
        scene: Scene,
        edges: Edges,
        trees: EdgeTrees,
        off: wp.array(dtype=wp.float32),
        tau_out: wp.array(dtype=wp.float32),
        ahead_out: wp.array(dtype=wp.float32),
    ):
        i = wp.tid()
        v = (3.5998 - 0.5 * off[i]) / 6.0
        u = (3.7 + off[i]) / 6.0 - v
        tri = scene.triangles[0]
        x = (1.0 - u - v) * tri.p0 + u * tri.p1 + v * tri.p2
        ahead_out[i] = 1.0
        d = wp.normalize(wp.vec3(-1.0, 0.2, -1.0))
        s = edge_sample(scene, edges, trees, 0, u, v, d, sampler_at(i, 0, wp.uint32(1)), False).segment
        if s.valid == 1:
            tau_out[i] = s.tau
            ahead_out[i] = wp.dot(s.source - x, s.w) / s.t1

    off = np.float32(10.0 ** np.random.default_rng(1).uniform(-5.0, -1.0, 1 << 14))
    tau, ahead = (wp.zeros(len(off), dtype=wp.float32) for _ in range(2))
    wp.launch(drawn, len(off), [scene.data(), edges, edge_trees(scene, edges), wp.array(off)], [tau, ahead])
    assert tau.numpy().min() >= 0.0 and tau.numpy().max() == 1.0
    assert ahead.numpy().min() > 0.0


def test_the_jump_of_a_bent_surface_is_seen_from_in_front_of_what_is_close_to_it() -> None:
    """Half as far away as a plate, which shines on its other side: rays from behind that saw the plate twice."""
    n, out = np.array([0.0, 0.2, 0.98]) / np.hypot(0.2, 0.98), np.array([0.0, -0.98, 0.2]) / np.hypot(0.2, 0.98)
    across = np.array([1.0, 0.0, 0.0])
    up = np.cross(out, across)
    corners = 3e-4 * out + 1e-4 * np.array([a * across + b * up for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    bent = {"type": "mesh", "vertices": [[-1, -1, 0], [1, -1, 0], [0, 2, 0]], "faces": [[0, 1, 2]]}
    plate = {"type": "mesh", "vertices": corners, "faces": [[0, 1, 2], [0, 2, 3]], "face_normals": True}
    shape = {"indirect_terminator": bent | {"normals": np.tile(n, (3, 1))}, "sky": {"type": "constant"}}
    shape["plate"] = plate | {"emitter": {"type": "area", "radiance": 100.0}}
    scene = psdr.load_dict({"type": "scene", "camera": camera()} | shape)
    jump = make_jump(psdr.plan(scene, integrator=psdr.PathIntegrator(max_depth=4)).config)

    @wp.kernel(module="unique", enable_backward=False)
    def seen(scene: Scene, n: wp.vec3, out: wp.vec3, radiance_out: wp.array(dtype=wp.vec3)):
        s = Segment()
        s.t1 = 3.0e-4
        s.w = -out
        s.boundary_normal = (-1.0 / s.t1) * n
        radiance_out[wp.tid()] = jump(scene, sampler_at(wp.tid(), 0, wp.uint32(1)), s, 1, 4, 100).total

    found = wp.zeros(256, dtype=wp.vec3)
    wp.launch(seen, 256, [scene.data(), wp.vec3(n), wp.vec3(out)], [found])
    assert 0.1 < found.numpy().mean() < 1.0
