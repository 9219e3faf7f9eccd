"""The vertex at which a path branches, chosen while the path is drawn.

Derivation: ``docs/theory/interior.md#branches``.
"""

import warp as wp

from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.interaction import Interactions, leave_frame
from warp_psdr.kernels.invalid import count_invalid, finite
from warp_psdr.kernels.rng import Sampler, hashed, unit_float
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import PathState, path_from

#: Tells the random numbers of branches from those of the path that they leave.
SALT = wp.constant(wp.uint32(0x6A09E667))
#: Slots of the branches' sampler; from 3 on they belong to the paths that go on. Those that choose among vertices are
#: far behind.
DIRECTION_SLOT, LIGHT_SLOT, CHOICE_SLOT, VERTEX_SLOT = 0, 1, 2, 1 << 24
#: Russian roulette does not end a path where it branches.
NO_ROULETTE = 1 << 30


@wp.struct
class BranchPoint:
    """The vertex of a path that was chosen."""

    face: wp.int32  # -1: there is none
    u: wp.float32
    v: wp.float32
    state: PathState  # before it
    weight: wp.float32  # inverse of the probability of the choice


def make_branch_point(walk_step: wp.Function, branches_on: wp.Function) -> wp.Function:
    """Return ``branch_point(scene, sampler, branch, start, delta, max_depth, rr_depth) -> BranchPoint``.

    ``walk_step`` is a path's step that looks for no light, ``branches_on(scene, shape) -> bool`` whether a path may
    branch there. ``branch`` are the random numbers of the choice, ``delta`` the adjoint of the sample.
    """

    @wp.func
    def branch_point(
        scene: Scene,
        sampler: Sampler,
        branch: Sampler,
        start: PathState,
        delta: wp.vec3,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> BranchPoint:
        """Draw a path, and choose one of its vertices by weighted reservoir sampling."""
        always = scene.requested_shapes[scene.requested_shapes.shape[0] - 1]
        state = start
        chosen = BranchPoint()
        chosen.face = -1
        total = wp.float32(0.0)
        weight_of_chosen = wp.float32(1.0)
        while state.alive == 1 and (max_depth < 0 or state.depth + 1 < max_depth):
            before = state
            vertex, state = walk_step(scene, sampler, state, max_depth, rr_depth)
            if not finite(vertex.direct):
                count_invalid(scene, sampler)
            if vertex.face >= 0:
                shape = scene.triangles[vertex.face].shape
                if always + scene.requested_shapes[shape] > 0 and branches_on(scene, shape):
                    weight = wp.dot(wp.abs(delta), wp.abs(before.throughput))
                    total += weight
                    if unit_float(hashed(branch, VERTEX_SLOT + before.depth).x) * total < weight:
                        weight_of_chosen = weight
                        chosen.face = vertex.face
                        chosen.u = vertex.u
                        chosen.v = vertex.v
                        chosen.state = before
        chosen.weight = total / weight_of_chosen
        return chosen

    return branch_point


def make_onward_radiance(interaction: Interactions, path_radiance: wp.Function) -> wp.Function:
    """Return ``onward_radiance(scene, branch, at, point, wo, pdf, max_depth, rr_depth) -> vec3``.

    What a path of the image finds from the chosen vertex in the local direction ``wo``, of which the image's sampler
    has the density ``pdf``.
    """
    record = interaction.record
    offset = interaction.offset

    @wp.func
    def onward_radiance(
        scene: Scene,
        branch: Sampler,
        at: record,
        point: BranchPoint,
        wo: wp.vec3,
        pdf: wp.float32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> wp.vec3:
        d = leave_frame(at.frame, wo)
        state = path_from(offset(at, d), d, FAR, point.state.depth + 1)
        state.pdf = pdf
        state.eta = point.state.eta
        state.left_face = point.face + 1
        return path_radiance(scene, branch, state, max_depth, rr_depth)

    return onward_radiance
