"""A scene on a device: records for the kernels, and their update when values change."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_psdr import compiler
from warp_psdr.device import launch
from warp_psdr.invalid import Ledger
from warp_psdr.kernels import constants as c
from warp_psdr.kernels import structs
from warp_psdr.kernels.bsdf.dispatch import has_delta_lobes
from warp_psdr.kernels.invalid import COUNTER_SIZE
from warp_psdr.kernels.lanes.lanes import QUEUE_ROOM, ROOM
from warp_psdr.kernels.step import RAY_EPSILON
from warp_psdr.kernels.structs import Media, Medium
from warp_psdr.kernels.surface import update_triangles
from warp_psdr.scene.acceleration import Accelerator
from warp_psdr.scene.bindings import Bindings
from warp_psdr.scene.build import Builder
from warp_psdr.scene.derived_values import sum_of_normals
from warp_psdr.scene.distortion import require_clear
from warp_psdr.scene.edits import Edits, State, check_media, differing, has_results, write_parts
from warp_psdr.scene.kinds.kind import Geometry, geometry_of
from warp_psdr.scene.kinds.records import Followers, update_record
from warp_psdr.scene.layout import BRIGHTNESS, NORMALS, POSITIONS, SHAPE_POSE, Parameter, struct_array
from warp_psdr.scene.lights.selection import Lights
from warp_psdr.scene.lights.sunsky import follow_sky
from warp_psdr.scene.materials.baked import BakedMaterials
from warp_psdr.scene.materials.tables import follow
from warp_psdr.scene.media.super_grid import rebuild
from warp_psdr.scene.origin import COLLAPSING
from warp_psdr.scene.pages import flat_values
from warp_psdr.scene.poses import Poses
from warp_psdr.scene.shapes import interfaces
from warp_psdr.scene.shapes.instances import Instances
from warp_psdr.scene.shapes.shading import shades_flat
from warp_psdr.scene.shapes.steps import Boxes, Steps, find_steps, measure, second_width
from warp_psdr.scene.summary import summary, tables
from warp_psdr.scene.world import World
from warp_psdr.startup import device_named

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from warp_psdr.scene.description import SceneDescription

#: Shapes below this many ray epsilons are noted: silhouettes are off by 5 % at 35 of them, by 0.1 % at 350.
SPECK = 100.0
#: Shapes narrower than this many steps past edges are noted: derivatives lack 4 % at 0.15 of them, and all at 0.1.
HAIR = 0.2
#: rho over the radius of the smaller of two shapes (``kernels/interior/factors/contact.py``).
CONTACT_RATIO = 2.0e-2
#: Least radius and extent of a scene, in world units: one without triangles has neither, and both are divided by.
LEAST_LENGTH = 1.0e-30


class Scene:
    """A loaded scene.

    Attributes:
        description: The validated values it was built from.
        device: Warp device.
        values: Flat float32 array of every continuous value, as the kernels read it.
        origin: (3,) float64, world units: positions in ``values`` are relative to it (``warp_psdr.scene.origin``).
            Parameters are not.
        contact_ratio: Width of the strips on which the interior term is weighted where surfaces meet, over the smaller
            of their radii (``warp_psdr.topology.patches``, ``kernels/interior/factors/contact.py``). A narrower one has
            less bias and more noise, of its inverse square root.
        parameters: Named stretches of ``values``.
        vertices: (V,) vec3, the positions of all vertices: a view of ``values``.
        indices: Flat int32 vertex numbers, three a triangle, over all shapes.
    """

    def __init__(
        self,
        description: SceneDescription,
        device: str | wp.Device | None = None,
        ahead: Iterable[Callable[[Scene], None]] = (),
        rays: tuple[str | None, int | None] = (None, None),
    ):
        """Build the device records.

        Args:
            description: What the readers produced.
            device: Warp device, "cpu" or "cuda:0"; None: Warp's current one.
            ahead: called with this scene where its own kernels have to be compiled, to begin others beside them.
            rays: what traces its rays, and the width of vectors; None: what ``set_ray_backend`` and
                ``set_vector_width`` say.
        """
        self.device = device_named(device)
        self.description = description
        builder = Builder(description)
        self.builder = builder
        self.invalid = Ledger()
        #: Parameters that were assigned since the scene followed them.
        self.pending: set[str] = set()
        self.bindings = Bindings(self)
        self._unfinished: list[str] = []
        self._uncounted = wp.zeros(COUNTER_SIZE, dtype=wp.int64, device=self.device)
        self._unmeasured = wp.zeros(1, dtype=wp.float32, device=self.device)
        self._unmarked = wp.zeros(1, dtype=wp.int32, device=self.device)
        self.parameters: dict[str, Parameter] = builder.layout.parameters
        self.values = flat_values(builder.layout, self.device)
        self.origin = description.origin
        self._world = World(self.values, self.origin, self.parameters.values())
        self._left = False
        self.steps: Steps
        self.boxes: Boxes
        self.indices = wp.array(builder.indices.reshape(-1), dtype=wp.int32, device=self.device)
        self.face_count = len(builder.indices)
        self.vertex_count = builder.vertex_count
        vertices = Parameter("", builder.positions, (self.vertex_count,), wp.vec3, (-np.inf, np.inf))
        self.vertices = vertices.view(self.values)
        self._face_shape = wp.array(builder.face_shape, dtype=wp.int32, device=self.device)
        self._orientation = wp.array(
            np.array([s.orientation for s in builder.shapes] or [1.0], np.float32), dtype=wp.float32, device=self.device
        )
        self.instances = Instances(self)
        self.poses = Poses(self)
        records = max(self.face_count + len(builder.primitives), 1)
        self.triangles = wp.zeros(records, dtype=structs.Triangle, device=self.device)
        self._shapes = struct_array(structs.Shape, builder.shapes, self.device)
        self._bsdfs = struct_array(structs.Bsdf, builder.bsdfs, self.device)
        self._slots = wp.array(builder.slots if builder.slots.size else [-1], dtype=wp.int32, device=self.device)
        self._textures = struct_array(structs.Texture, builder.textures, self.device)
        self._media = Media()
        self._media.records = struct_array(Medium, builder.media, self.device)
        self._media.sides = wp.array(builder.sides or [(c.NO_INTERFACE,) * 2], dtype=wp.vec2i, device=self.device)
        self.accelerator = self._accelerator(self.indices, *rays, built=False)
        self._baked = BakedMaterials(builder, self.values, used=self.accelerator.backend == "wide")
        self._rows = wp.empty((ROOM + QUEUE_ROOM) * self.accelerator.width, dtype=wp.uint32, device=self.device)
        self._sight: Accelerator | None = None
        self._contact_ratio = CONTACT_RATIO
        self._shades_flat: bool | None = None
        for begin in ahead if compiler.begin([update_triangles], self.device) else ():
            begin(self)
        compiler.begin(self.accelerator.kernels(), self.device)
        self.poses.apply_all()
        self._followers = Followers(self)
        self._update_triangles(range(len(description.shapes)))
        self.accelerator.rebuild()
        self._shades_flat = None
        self._update_bounds()
        self._passed = interfaces.let_through(self)
        self._part_interfaces(None)
        self._world.show(self.parameters.values())
        self._note_specks()
        self.lights = Lights(builder, self.device)
        flat = self.values.numpy()
        self.lights.update_areas(self.lights.of_shapes(range(len(description.shapes))), self.points)
        self.lights.update_environment(flat)
        self.lights.update_selection(flat, self.radius)
        followed = {n: p for n, p in self.parameters.items() if has_results(p)}
        places = [(p.offset, p.offset + p.size) for p in followed.values()]
        self._edits = Edits({n: self.view(n) for n in followed}, None if self.origin.any() else self.values, places)

    @property
    def shades_flat(self) -> bool:
        """Whether interpolated normals are those of the triangles; see ``warp_psdr.scene.shapes.shading``."""
        if self._shades_flat is None:
            self._shades_flat = shades_flat(self)
        return self._shades_flat

    @property
    def contact_ratio(self) -> float:
        """Return the width of the strips at contacts."""
        return self._contact_ratio

    @contact_ratio.setter
    def contact_ratio(self, value: float) -> None:
        if not 0.0 <= value < np.inf:
            raise ValueError(f"contact_ratio: got {value!r}, expected a number that is not negative; 0: no strips")
        self._contact_ratio = float(value)

    __repr__, _repr_html_ = summary, tables

    def __reduce_ex__(self, _protocol: Any):
        """Return what a copy, or another process, makes the same scene of: its description and its values."""
        self.settle()
        state = State(self.values.numpy(), self.poses.state())
        return _loaded_again, (self.description, self.device.alias, self.contact_ratio, state, self._rays)

    @property
    def _rays(self) -> tuple[str, int | None]:
        """What traces the scene's rays, and the width of its vectors."""
        wide = self.accelerator.backend == "wide"
        return self.accelerator.backend, self.accelerator.width if wide else None

    def _accelerator(
        self, indices: wp.array, backend: str | None, width: int | None, *, built: bool = True
    ) -> Accelerator:
        return Accelerator(self.vertices, indices, self.device, backend, width=width, built=built)

    # -- views and constants ---------------------------------------------------------------------------------------

    def _vectors(self, values: np.ndarray | None) -> wp.array:
        """Return (N, 3) as an array of vec3; one zero in place of None, for Warp has no null array of structures."""
        return wp.array(np.zeros((1, 3)) if values is None else values, dtype=wp.vec3, device=self.device)

    @property
    def points(self) -> np.ndarray:
        """Positions of all vertices, (V, 3) float32, as the kernels read them; on the CPU a view."""
        return self.vertices.numpy()

    def view(self, name: str) -> wp.array:
        """Return the array of a parameter that users read and edit."""
        return self._world.view(self.parameters[name])

    def place(self, name: str, values: np.ndarray) -> bool:
        """Take new values of a parameter, world coordinates, float32 or float64; return whether they are other ones."""
        return self._world.place(self.parameters[name], values)

    @property
    def positions(self) -> int:
        """Flat offset of the vertex positions of all shapes."""
        return self.builder.positions

    def geometry(self, shape: int) -> Geometry:
        """Return the geometry of a shape without triangles, which is given by its number."""
        return geometry_of(self.description.shapes[shape])

    def camera(self, sensor: int | str) -> structs.Camera:
        """Return the camera record of a sensor, which is given by its number or its id.

        Raises:
            ValueError: There is no such sensor, or its distortion folds inside its film at the present values.
        """
        number = self.description.sensor_number(sensor)
        return require_clear(self.builder.cameras[number], self.values, self.description.sensors[number].path)

    @property
    def luminous(self) -> np.ndarray:
        """Mask of the triangles of area lights."""
        return np.array([s.emitter >= 0 for s in self.builder.shapes], bool)[self.builder.face_shape]

    def hide_lights(self) -> None:
        """Build what the camera's rays meet where area lights are hidden: their triangles become points."""
        if self._sight is None:
            shown = np.where(self.luminous[:, None], 0, self.builder.indices).astype(np.int32)
            indices = wp.array(shown.reshape(-1), dtype=wp.int32, device=self.device)
            self._sight = self._accelerator(indices, *self._rays)

    def data(self, *, compensated: bool = False) -> structs.Scene:
        """Return the kernel argument.

        Args:
            compensated: for paths from the camera, whose scattered rays find the environment too.

        Raises:
            ValueError: the last update failed, and the scene has not followed its parameters since.
        """
        if self._unfinished:
            raise ValueError(
                f"the scene could not follow {', '.join(map(repr, self._unfinished))}: the last params.update() raised "
                "an error; write valid values, then call it again"
            )
        follow(self.builder.tables, self.values)
        s = structs.Scene()
        s.accel = self.accelerator.data
        if self._sight is not None:
            s.sight = self._sight.data
        s.values = self.values
        s.positions = self.positions
        s.triangles = self.triangles
        s.shapes = self._shapes
        s.bsdfs = self._bsdfs
        s.slots = self._slots
        s.textures = self._textures
        s.baked = self._baked.current()
        s.emitters = self.lights.emitters
        s.emitter_cdf = self.lights.emitter_cdf
        s.face_cdf = self.lights.face_cdf
        s.media = self._media
        s.environment = self.builder.environment
        s.env_marginal, s.env_conditional = self.lights.cells(compensated)
        s.ray_epsilon = self.ray_epsilon
        s.least_step = self.steps.scene
        s.contact_ratio = self.contact_ratio
        s.radii = self._unmeasured  # the interior term asks for them
        s.requested_shapes = self._unmarked  # the interior term marks shapes
        s.invalid = self._uncounted  # for launches outside of ``invalid.counting``
        s.rows = self._rows
        return s

    # -- refreshing ------------------------------------------------------------------------------------------------

    def edited(self) -> list[str]:
        """Return the names of the parameters that were edited in place and have to be refreshed."""
        return self._edits.found()

    def settle(self, names: Iterable[str] = ()) -> None:
        """Follow all edits; ``names``: what was edited in place, else checksums tell."""
        self.bindings.follow()
        changed = self.pending.union(names or self.edited())
        self.refresh([name for name in self.parameters if name in changed])
        self.pending.clear()

    def refresh(self, names: list[str]) -> None:
        """Recompute what depends on the named parameters, and on those of a call before that failed.

        Poses, normals, triangle records, ray structure, environment map's cells, light selection. A pose moves the
        vertices and normals of its shape, but for what is named itself: that is kept, and moved by later poses.

        Raises:
            ValueError: vertices, or texels of a sky, are not finite, or vertices were edited under a singular pose.
        """
        follow(self.builder.tables, self.values)
        if not names and not self._unfinished:
            return
        self._unfinished = list(dict.fromkeys([*self._unfinished, *names]))
        self._follow(self._unfinished)
        self._unfinished = []

    def state(self) -> State:
        """Return a copy of all that edits change, for ``restore``."""
        return State(self.values.numpy().copy(), self.poses.state())

    def restore(self, state: State) -> None:
        """Go back to a state of this scene, to the bit; what was edited since and is not refreshed is lost."""
        held = self.values.numpy()
        changed = differing(self.parameters.values(), held, state.values)
        self.poses.restore(state.local)
        if changed:
            write_parts(self.values, held, state.values)
            self._followers.renew()
            self._world.show(changed)
            self._renew(changed)

    def _follow(self, names: list[str]) -> None:
        changed = [self.parameters[name] for name in names]
        for p in changed:
            self._world.take_over(p, self.radius)
        placed = {p.owner for p in changed if POSITIONS in p.uses and p.prototype < 0}
        shaded = {p.owner for p in changed if NORMALS in p.uses and p.prototype < 0}
        posed = {shape for p in changed if SHAPE_POSE in p.uses for shape in p.owners} - placed
        posed |= self.instances.follow(changed, posed)
        moved = posed | placed
        for shape in sorted(posed):
            self.poses.apply(shape, shape not in shaded)
        followed = [f"{self.description.shapes[i].path}.vertex_positions" for i in sorted(posed)]
        followed = [name for name in followed if name in self.parameters] + self.instances.followed(names)
        self._world.show(self.parameters[name] for name in followed)
        for shape in sorted(moved):
            description = self.description.shapes[shape]
            if description.normals_computed and shape not in shaded:
                self.normal_sums(shape, write=True)
        for shape in sorted(s for s in placed | shaded if s in self.poses):
            self.poses.take(shape)
        self._renew([*changed, *(self.parameters[name] for name in followed)])

    def _renew(self, changed: list[Parameter]) -> None:
        """Recompute what depends on values, but for other values."""
        if any(p.uses & {POSITIONS, NORMALS, SHAPE_POSE} for p in changed):
            self._shades_flat = None
        moved = {shape for p in changed if p.uses & {POSITIONS, SHAPE_POSE} for shape in p.owners}
        moved |= self._followers.move(changed)
        if moved:
            self._follow_vertices(moved)
            parted = self._part_interfaces(moved)
            moved |= parted
            positions = [p for p in self.parameters.values() if POSITIONS in p.uses and p.owner in parted]
            self._world.show(positions)
            changed = [*changed, *positions]
        sky = follow_sky(self, changed)
        values = self.values.numpy()
        check_media(changed, values)
        rebuild([*self.builder.media_followers, *self.builder.volume_poses], changed, self.values, values)
        self._followers.follow(changed)
        first, size = self.lights.environment_data()
        if sky or any(first <= p.offset < first + size for p in changed):
            self.lights.update_environment(values)
        areas = self.lights.of_shapes(sorted(moved))
        if areas or self.lights.metered(moved):
            self.lights.update_areas(areas, self.points)
        brighter = any(p.uses & BRIGHTNESS for p in changed)
        if brighter or areas or (moved and self.lights.depend_on_size()):
            self.lights.update_selection(values, self.radius)
        self._edits.follow(p.name for p in changed)

    def normal_sums(self, shape: int, *, write: bool) -> wp.array:
        """Return the unnormalised vertex normals of a shape; ``write``: update its normals from them."""
        s = self.builder.shapes[shape]
        faces = (self.indices, s.first_face, s.face_count, s.first_vertex, s.vertex_count)
        return sum_of_normals(self, self.positions, *faces, s.normal_offset + 3 * s.first_vertex if write else -1)

    def _follow_vertices(self, shapes: Iterable[int]) -> None:
        """Recompute records, ray structures and bounds of shapes whose vertices have moved."""
        self._update_triangles(sorted(shapes))
        self.accelerator.update()
        if self._sight is not None:
            self._sight.update()
        self._update_bounds()

    def _update_triangles(self, shapes: Iterable[int]) -> None:
        for shape in shapes:
            record = self.builder.shapes[shape]
            if self.description.shapes[shape].geometry is not None:
                update_record(self, shape)
                continue
            mesh = [self.values, self.positions, self.indices, self._face_shape, self._orientation, record.first_face]
            launch(update_triangles, dim=record.face_count, inputs=mesh, outputs=[self.triangles], device=self.device)

    def _part_interfaces(self, moved: set[int] | None) -> set[int]:
        """Move glass, and what is not there, off what it lies on, and return the shapes that were moved.

        ``moved``: shapes that have moved since the last call; None: the scene is new.
        """
        parted = interfaces.part(self, self._passed, moved) if self._passed else {}
        if parted:
            self._follow_vertices(parted)
        if moved is None:
            self.description.notes += interfaces.notes(self, parted)
        return set(parted)

    def _update_bounds(self) -> None:
        """Radius of the bounding sphere and length of the step off a surface."""
        points = self.points
        self.boxes = measure(points, [(s.first_vertex, s.vertex_count) for s in self.builder.shapes])
        low, high = np.zeros(3), np.zeros(3)
        if self.vertex_count:
            low, high = self.boxes.low.min(axis=0), self.boxes.high.max(axis=0)
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise ValueError(
                "vertex positions hold NaN or infinity after the last edit; restore finite values "
                "(an optimiser that got here took too long a step: lower its learning rate)"
            )
        self.radius = max(0.5 * float(np.linalg.norm(high - low)), LEAST_LENGTH)
        self._media.extent = 2.0 * self.radius if self.radius > LEAST_LENGTH else 1.0
        self.ray_epsilon = RAY_EPSILON * max(float(np.abs(low).max()), float(np.abs(high).max()), LEAST_LENGTH)
        if float(np.abs(low + high).max()) > 2.0 * COLLAPSING * self.radius and not self._left:
            self._left = True
            warnings.warn(
                f"the vertices have moved {0.5 * np.abs(low + high).max() / self.radius:.1g} times the scene's size "
                f"away from scene.origin, {self.origin.tolist()}, and float32 loses digits there; load the scene again",
                RuntimeWarning,
                stacklevel=4,
            )
        self._update_steps(points)

    def _update_steps(self, points: np.ndarray) -> None:
        first_face = [s.first_face for s in self.builder.shapes]
        self.steps = find_steps(points, self.builder.indices, first_face, self.boxes, self.ray_epsilon)
        steps = [float(step) for step in self.steps.shapes.astype(np.float32)]
        if steps != [s.edge_step for s in self.builder.shapes]:
            for record, step in zip(self.builder.shapes, steps, strict=True):
                record.edge_step = step
            self._shapes = struct_array(structs.Shape, self.builder.shapes, self.device)

    def _note_specks(self) -> None:
        """Tell of shapes that are small for the steps by which rays leave surfaces."""
        mirrors = has_delta_lobes(self.builder.models)
        for number, (shape, size) in enumerate(zip(self.description.shapes, self.boxes.size.tolist(), strict=True)):
            if self.steps.scene and size < SPECK * self.steps.behind[number]:
                self.description.notes.append(
                    f"'{shape.path}' is too small for what it touches, or for its place: rays pass its edges at "
                    f"{self.steps.behind[number] / size:.1g} of its size, and the derivatives of its silhouettes and "
                    "shadows are wrong by as much or more; cut what is vast into small triangles near it, or render it "
                    "in a scene without what is far away"
                )
            elif mirrors and self.steps.scene and size < SPECK * self.ray_epsilon:
                self.description.notes.append(
                    f"'{shape.path}' is small for its world, and one step serves all that is seen through mirrors and "
                    f"glass: boundary gradients pass its edges at {self.ray_epsilon / size:.1g} of its size there; "
                    "render it in a scene without what is far away or vast"
                )
            s = self.builder.shapes[number]
            width = second_width(self.points[s.first_vertex : s.first_vertex + s.vertex_count]) if size > 0.0 else 0.0
            if 0.0 < width < HAIR * (float(self.steps.shapes[number]) or self.ray_epsilon):
                self.description.notes.append(
                    f"'{shape.path}' is a hair, {width / size:.1g} times as wide as long, which is too narrow for its "
                    "scene: the derivatives of its silhouettes are incomplete; make it wider, or the scene smaller"
                )

    def derived_normals(self, names: list[str]) -> list[int]:
        """Shapes whose normals follow their positions and whose positions, or pose, are among the named parameters."""
        named = [self.parameters[name] for name in names]
        shapes = {p.owner for p in named if POSITIONS in p.uses and p.prototype < 0}
        shapes |= {
            s for p in named if SHAPE_POSE in p.uses for s in p.owners if self.description.shapes[s].prototype is None
        }
        return sorted(s for s in shapes if self.description.shapes[s].normals_computed)

    def has_use(self, names: list[str], *uses: str) -> bool:
        """Whether any of the named parameters has one of the uses."""
        return any(self.parameters[n].uses & set(uses) for n in names)


def _loaded_again(
    description: SceneDescription, device: str, contact_ratio: float, state: State, rays: tuple[str, int | None]
) -> Scene:
    """Return a scene with the values of another one, which may have lived in another process, with its bits."""
    scene = Scene(description, device, rays=rays)
    scene.contact_ratio = contact_ratio
    scene.restore(state)
    return scene
