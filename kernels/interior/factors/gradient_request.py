"""The record of the derivatives that a kernel computes."""

from dataclasses import dataclass


@dataclass(frozen=True)
class GradientRequest:
    """Which derivatives are compiled; everything else costs nothing."""

    #: Textures of material values, one answer for each of ``SurfaceConfig.material``.
    material: tuple[bool, ...] = ()
    #: Texture-coordinate transforms of bitmaps in material slots and of area lights.
    to_uv: bool = False
    #: Vertex positions, vertex normals or their sources.
    shapes: bool = False
    texcoords: bool = False
    #: Radiance textures of area lights.
    radiance: bool = False
    #: What of the other lights: "radiance", "pose".
    lights: tuple[str, ...] = ()
    camera: bool = False
    #: What of media (``medium/coefficients.py``).
    media: tuple[str, ...] = ()
    #: A delta lobe's direction depends on a requested material value (index of refraction).
    bends: bool = False
    #: What turns normals of glossy surfaces is left to antithetic pairs (``antithetic.py``).
    paired: bool = False

    @property
    def geometry(self) -> bool:
        """Whether path vertices move at all."""
        return self.shapes or self.texcoords or self.camera or self.bends
