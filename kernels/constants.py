"""Named constants of the device code. Each carries its unit and one line of reason."""

import math

PI = math.pi
INV_PI = 1.0 / math.pi
TWO_PI = 2.0 * math.pi
FOUR_PI = 4.0 * math.pi
INV_TWO_PI = 0.5 / math.pi
INV_FOUR_PI = 0.25 / math.pi

#: Largest float32 below one: keeps a random number inside [0, 1).
ONE_MINUS_EPSILON = 0.99999994
#: Distance that stands for infinity (scene units); small enough that its square stays a finite float32.
FAR = 1.0e18

# Texture kinds (``Texture.kind``).
TEXTURE_CONSTANT = 0
TEXTURE_BITMAP = 1
TEXTURE_VERTEX = 2
TEXTURE_FACE = 3
TEXTURE_CHECKERBOARD = 4
TEXTURE_GRID = 5  # of voxels, which media and textures read
TEXTURE_SCALED = 6  # another one times a number
#: Textures that read texture coordinates.
READ_TEXCOORDS = frozenset({TEXTURE_BITMAP, TEXTURE_CHECKERBOARD})

# Bitmap filters and wrap modes (``Texture.filter``, ``Texture.wrap``).
FILTER_BILINEAR = 0
FILTER_NEAREST = 1
WRAP_REPEAT = 0
WRAP_MIRROR = 1
WRAP_CLAMP = 2

# Light sources (``Emitter.kind``).
EMITTER_AREA = 0
EMITTER_CONSTANT = 1
EMITTER_ENVMAP = 2
EMITTER_POINT = 3
EMITTER_SPOT = 4
EMITTER_DIRECTIONAL = 5
EMITTER_TEXTURED_SPOT = 6
EMITTER_PROJECTOR = 7
EMITTER_DIRECTIONAL_AREA = 8
#: Lights with a cone.
SPOTS = frozenset({EMITTER_SPOT, EMITTER_TEXTURED_SPOT})
#: Lights that only a direction of their own reaches.
DELTA_LIGHTS = frozenset({EMITTER_POINT, *SPOTS, EMITTER_PROJECTOR, EMITTER_DIRECTIONAL, EMITTER_DIRECTIONAL_AREA})

# Lobes of a scattering event (``BsdfSample.lobe``).
LOBE_NONE = 0
LOBE_SMOOTH = 1
LOBE_DELTA_REFLECTION = 2
LOBE_DELTA_TRANSMISSION = 3
#: Light passes as if there were no surface, with a weight.
LOBE_NULL = 4
#: In ``Bsdf.lobes`` alone: a smooth lobe lies behind the surface.
LOBE_BEHIND = 5

# Phase functions (``Medium.phase``).
PHASE_ISOTROPIC = 0
PHASE_HG = 1
PHASE_RAYLEIGH = 2
PHASE_TABLE = 3
PHASE_BLEND = 4
PHASE_SGGX = 5
PHASE_BLEND_GRID = 6  # a blend whose weight is a grid
PHASE_SGGX_GRID = 7  # microflakes whose S is a grid
#: Numbers that stand for no medium, and on both sides of a shape for one that bounds none.
NO_MEDIUM = -1
NO_INTERFACE = -2

#: Stands among the kinds of a scene, of which no shape has it, where vertices flow along continuous normals.
NORMAL_FLOW = 64

# Cameras (``Camera.kind``).
CAMERA_PERSPECTIVE = 0
CAMERA_ORTHOGRAPHIC = 1
CAMERA_THINLENS = 2
CAMERA_RADIANCEMETER = 3
CAMERA_IRRADIANCEMETER = 4
CAMERA_BATCH = 5  # no camera, but the film of several
CAMERA_PERSPECTIVE_OPENCV = 6  # these four: with distortion, see ``sensor/distortion.py``
CAMERA_THINLENS_OPENCV = 7
CAMERA_PERSPECTIVE_FISHEYE = 8
CAMERA_THINLENS_FISHEYE = 9
#: Cameras whose rays start on a disk.
THIN_LENSES = frozenset({CAMERA_THINLENS, CAMERA_THINLENS_OPENCV, CAMERA_THINLENS_FISHEYE})
FISHEYES = frozenset({CAMERA_PERSPECTIVE_FISHEYE, CAMERA_THINLENS_FISHEYE})
DISTORTED_CAMERAS = frozenset({CAMERA_PERSPECTIVE_OPENCV, CAMERA_THINLENS_OPENCV}) | FISHEYES
#: Sensors whose rays are parallel to the third column of their pose.
PARALLEL_CAMERAS = frozenset({CAMERA_ORTHOGRAPHIC, CAMERA_RADIANCEMETER})
#: Sensors of one pixel, to which no point of a scene can be connected.
METERS = frozenset({CAMERA_RADIANCEMETER, CAMERA_IRRADIANCEMETER})

# Reconstruction filters (``Camera.filter``).
RFILTER_BOX = 0
RFILTER_TENT = 1
RFILTER_GAUSSIAN = 2
