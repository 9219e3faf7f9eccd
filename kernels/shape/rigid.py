"""Poses and vertices of a simulator's bodies and particles; differentiable, for they are recorded on a user's tape."""

import warp as wp


@wp.kernel
def poses_of_bodies(
    # In:
    transforms: wp.array(dtype=wp.transform),
    bodies: wp.array(dtype=wp.int32),
    local: wp.array(dtype=wp.mat44),
    # Out:
    poses: wp.array3d(dtype=wp.float32),
):
    """Pose of a shape: that of its body, whose number is ``bodies[i]``, times ``local[i]``; -1: the world."""
    i = wp.tid()
    at = wp.transform_identity()
    if bodies[i] >= 0:
        at = transforms[bodies[i]]
    pose = wp.transform_to_matrix(at) @ local[i]
    for row in range(4):
        for column in range(4):
            poses[i, row, column] = pose[row, column]


@wp.kernel
def gather_points(
    # In:
    points: wp.array(dtype=wp.vec3),
    numbers: wp.array(dtype=wp.int32),
    offsets: wp.array(dtype=wp.vec3),
    # Out:
    gathered: wp.array(dtype=wp.vec3),
):
    """Some of the points, by their numbers, plus an offset each."""
    i = wp.tid()
    gathered[i] = points[numbers[i]] + offsets[i]
