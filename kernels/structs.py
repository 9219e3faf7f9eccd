"""Device-side records of a scene. Everything continuous lives in one flat float32 array, ``Scene.values``.

A record never holds a parameter, only the *flat offset* where its values start. Gradients and tangents are arrays of
the same layout, so that a partial derivative with respect to ``values[i]`` is scattered to ``grad[i]`` (reverse mode)
or multiplied with ``tangent[i]`` (forward mode) by the same code (``kernels/sink.py``).
"""

import warp as wp

from warp_psdr.kernels.bvh.wide import Accel


@wp.struct
class Triangle:
    """One triangle, precomputed from the vertices at every update (64 bytes)."""

    p0: wp.vec3  # corners, world space
    p1: wp.vec3
    p2: wp.vec3
    normal: wp.vec3  # unit geometric normal, turned by ``flip_normals``; 0 for a degenerate triangle
    i0: wp.int32  # global vertex indices
    i1: wp.int32
    i2: wp.int32
    shape: wp.int32


@wp.struct
class Shape:
    """What the triangles of one shape share. Offsets are biased so that they take *global* vertex indices."""

    bsdf: wp.int32
    emitter: wp.int32  # -1: no area light
    smooth: wp.int32  # 1: interpolated vertex normals, 0: face normals
    orientation: wp.float32  # +1, or -1 for ``flip_normals``
    normal_offset: wp.int32  # normal of vertex i: values[normal_offset + 3 i ...]
    uv_offset: wp.int32  # texture coordinates of vertex i: values[uv_offset + 2 i ...]
    has_uv: wp.int32  # 0: the barycentrics (u, v) serve as texture coordinates
    first_face: wp.int32
    face_count: wp.int32
    first_vertex: wp.int32
    vertex_count: wp.int32
    edge_step: wp.float32  # at its edges where scales are mixed, world units; see ``step.py``


@wp.struct
class Texture:
    """A texture's layout; its values start at ``offset`` with ``channels`` (1 or 3) floats a texel, vertex or face.

    Bitmaps are stored row-major, first row at v = 0 (Mitsuba's convention). Vertex and face attributes are
    biased: they take global vertex and face indices. A checkerboard holds no values but the numbers of two textures.
    """

    kind: wp.int32
    offset: wp.int32
    channels: wp.int32
    width: wp.int32
    height: wp.int32
    filter: wp.int32
    wrap: wp.int32
    to_uv: wp.int32  # flat offset of the 3x3 row-major texture-coordinate transform (bitmaps, checkerboards)
    first: wp.int32  # checkerboard: texture of the field at the origin
    second: wp.int32  # checkerboard: texture of the fields beside it


@wp.struct
class Bsdf:
    """A scattering model and where the numbers of its textures start."""

    model: wp.int32  # place in ``SurfaceConfig.bsdfs``
    two_sided: wp.int32  # 1: both sides scatter; the back side uses the record ``back``
    back: wp.int32
    slots: wp.int32  # first index in ``Scene.slots``
    varied: wp.int32  # 1: some of its textures are not constant
    lobes: wp.int32  # bit k: the model has the lobe LOBE_* = k; LOBE_BEHIND: a smooth one behind its surface


@wp.struct
class Emitter:
    """A light source. ``texture`` holds radiance, intensity or irradiance."""

    kind: wp.int32
    texture: wp.int32
    shape: wp.int32  # light of a shape: its number
    first_face: wp.int32  # the same: its triangles, and where their cumulative areas start in Scene.face_cdf
    face_count: wp.int32
    cdf_offset: wp.int32
    to_world: wp.int32  # flat offset of a 4x4 row-major matrix (all but point) or of a position (point)
    scale: wp.int32  # flat offset (envmap, projector)
    cutoff: wp.int32  # flat offset of [cutoff_angle, beam_width], degrees (spot), or of x_fov, degrees (projector)
    projected: wp.int32  # texture that colours the cone (textured spot)
    probability: wp.float32  # discrete selection probability


@wp.struct
class Camera:
    """A camera. The film covers ``crop_*`` of a ``width`` x ``height`` image; pixel (0, 0) is top left."""

    kind: wp.int32
    to_world: wp.int32  # flat offset, 4x4 row-major, camera looks along +z with +y up, x to the left
    x_fov: wp.int32  # flat offset, degrees, horizontal field of view of the full film (not orthographic)
    principal: wp.int32  # flat offset of (principal_point_offset_x, _y), relative to the film size (not orthographic)
    distortion: wp.int32  # flat offset of the numbers of ``sensor/distortion.py`` (with distortion)
    aperture_radius: wp.int32  # flat offset, world units (thin lens)
    focus_distance: wp.int32  # flat offset, world units along the viewing axis (thin lens)
    width: wp.int32
    height: wp.int32
    crop_x: wp.int32
    crop_y: wp.int32
    crop_width: wp.int32
    crop_height: wp.int32
    near: wp.float32
    far: wp.float32
    filter: wp.int32
    filter_radius: wp.float32  # pixels
    filter_stddev: wp.float32  # pixels (gaussian)
    first_face: wp.int32  # irradiance meter: the triangles of its shape, and where their cumulative areas start
    face_count: wp.int32
    cdf_offset: wp.int32
    sample_border: wp.int32  # 1: pixels see what lies beyond the crop window; 0: filters end at its border
    medium: wp.int32  # that its rays start in, or NO_MEDIUM


@wp.struct
class Medium:
    """A homogeneous medium."""

    sigma_t: wp.int32  # flat offset of the extinction coefficient, per unit length, before ``scale``
    sigma_t_channels: wp.int32  # 1 or 3
    albedo: wp.int32  # flat offset of the single-scattering albedo
    albedo_channels: wp.int32
    scale: wp.int32  # flat offset of what multiplies sigma_t
    emission: wp.int32  # flat offset of the radiance emitted per unit length, -1: none
    emission_channels: wp.int32
    phase: wp.int32  # PHASE_*
    g: wp.int32  # hg: flat offset of the mean cosine


@wp.struct
class Media:
    """All media of a scene."""

    records: wp.array(dtype=Medium)
    #: Of each shape: the number of the medium outside and of that inside, or NO_MEDIUM; NO_INTERFACE: it changes none.
    sides: wp.array(dtype=wp.vec2i)
    extent: wp.float32  # diameter of the scene, or 1: length scale of flights that nothing ends


@wp.struct
class Scene:
    """The whole scene, one kernel argument."""

    accel: Accel
    sight: Accel  # what the camera sees where lights are hidden
    values: wp.array(dtype=wp.float32)
    positions: wp.int32  # flat offset of the vertex positions: vertex i at positions + 3 i
    triangles: wp.array(dtype=Triangle)
    shapes: wp.array(dtype=Shape)
    bsdfs: wp.array(dtype=Bsdf)
    slots: wp.array(dtype=wp.int32)  # texture numbers of material values, see ``bsdf/record.py``
    textures: wp.array(dtype=Texture)
    #: Of each of ``bsdfs``, for paths side by side: model, slots, and the values that textures hold which are constant,
    #: as in ``Interaction``; see ``warp_psdr/scene/materials/baked.py``.
    baked: wp.array(dtype=wp.uint32)
    emitters: wp.array(dtype=Emitter)
    emitter_cdf: wp.array(dtype=wp.float32)  # cumulative selection probabilities, length n + 1, from 0 to 1
    face_cdf: wp.array(dtype=wp.float32)  # cumulative, normalised triangle areas of each area light, n + 1 a light
    media: Media
    environment: wp.int32  # index of the constant or envmap emitter, -1: none
    env_marginal: wp.array(dtype=wp.float32)  # cumulative over rows of cells, h + 1
    env_conditional: wp.array(dtype=wp.float32)  # cumulative over the cells of each row, h x (w + 1), flattened
    ray_epsilon: wp.float32  # distance by which a ray's origin is moved off its surface, world units
    least_step: wp.float32  # the least at edges, see ``step.py``; 0: ``ray_epsilon`` serves all surfaces and edges
    contact_ratio: wp.float32  # width of strips at contacts over the radius, ``interior/factors/contact.py``
    radii: wp.array(
        dtype=wp.float32
    )  # of the triangles' patches, ``warp_psdr.topology.patches``; not empty: a 0 if nothing moves
    #: 1: what is differentiated belongs to this shape; the last one: to something else too (``interior/replay.py``).
    requested_shapes: wp.array(dtype=wp.int32)
    invalid: wp.array(dtype=wp.int64)  # counter of this launch and lane, see ``invalid.py``
    rows: wp.array(dtype=wp.uint32)  # room of this launch and lane for paths side by side, see ``lanes.py``


@wp.struct
class BsdfSample:
    """A sampled direction. Local frame: z is the shading normal, wi towards the previous vertex, wo the new one."""

    wo: wp.vec3
    value: wp.vec3  # smooth lobe: cosine-weighted f_s; delta lobe: the attached reflectance or transmittance
    pdf: wp.float32  # smooth lobe: solid angle; delta lobe: the discrete probability; 0: no sample
    eta: wp.float32  # relative index of refraction along the new direction (1 unless transmitted)
    lobe: wp.int32


@wp.struct
class Scattered:
    """Direction and weight of a delta lobe, both differentiable."""

    wo: wp.vec3
    value: wp.vec3


@wp.struct
class LightSample:
    """A direction towards a light source, seen from a reference point."""

    wi: wp.vec3  # unit, from the reference point to the light
    distance: wp.float32
    radiance: wp.vec3  # radiance; for point, spot and directional lights the irradiance on a facing surface
    pdf: wp.float32  # solid angle, without the selection probability; 1 for point, spot and directional lights
    delta: wp.int32  # 1: cannot be hit by a ray
    face: wp.int32  # area light: triangle and barycentrics, else -1
    u: wp.float32
    v: wp.float32
    target: wp.vec3  # area light: where shadow rays end, a little in front of the point
    probability: wp.float32  # selection probability


@wp.struct
class LightAdjoint:
    """Adjoint of a light's direction and radiance with respect to the reference point, and the forward-mode sum."""

    x: wp.vec3
    dot: wp.float32
