"""The words in which materials, lights, films, media, kinds of shapes and requests say what they need of a method.

Each method and each boundary term declares a set of the words that it knows. The plan compares the sets
(``warp_psdr/plan/needs.py``); ``psdr.coverage()`` prints what comes of it.
"""

from __future__ import annotations

from typing import NamedTuple


class Word(NamedTuple):
    """What has the word, and what to do where it is not known."""

    what: str
    instead: str


WORDS = {
    # Media
    "media": Word("participating media", "leave them out"),
    "moving_media": Word("what moves beside participating media", "leave the media out"),
    "density_grids": Word("what moves beside 'heterogeneous' media", "make them 'homogeneous'"),
    "microflakes": Word("'sggx', whose extinction varies with direction", "take another phase function"),
    "blended_grids": Word("a 'blendphase' whose weight is a grid", "give it one weight"),
    "emission": Word("media that emit light", "leave 'emission' out"),
    # Shapes
    "material_points": Word("exact shapes", "leave out 'exact', which makes triangles"),
    "slides": Word("grids, networks and curves, whose points slide along rays", "make meshes of them"),
    "moving_slides": Word("points that slide along rays while something moves", "make meshes of the shapes"),
    "shining": Word("exact shapes that shine", "give the light triangles"),
    "vertex_normals": Word("interpolated normals", "give face_normals"),
    "solids_in_media": Word("participating media beside shapes without triangles", "make meshes of them"),
    # Materials
    "mirrors": Word("smooth mirrors and glass", "make them rough"),
    "moving_mirrors": Word("moving vertices behind smooth mirrors or glass", "make these rough"),
    "moving_vertices": Word(
        "what moves vertices of its paths: shapes, cameras, and what turns rays",
        "use interior.LightTracing() with boundary=None",
    ),
    "rough_glass": Word("a smooth lobe behind a surface", "use a 'dielectric'"),
    "null": Word("masks, thin glass and 'null', which rays pass", "use meshes with holes"),
    "turned_normals": Word("normal and bump maps", "leave them out"),
    "mirror": Word("the material of a smooth mirror", "make it rough"),
    "glass": Word("the material of smooth glass", "make it a 'conductor', or rough"),
    "mixed": Word("a material that is a mirror or glass and more", "make it a 'conductor', or rough"),
    "steps": Word("textures with steps", "take bilinear bitmaps"),
    # Lights
    "point_lights": Word("lights without an area, whose shadows are hard", "take an area light"),
    "far_lights": Word("light that comes from infinity", "use an 'area' or a 'point' light"),
    "hide_emitters": Word("hide_emitters", "leave it out"),
    "hidden_lights": Word("area lights that hide_emitters hides", "show the lights"),
    # Sensors and films
    "thinlens": Word("a 'thinlens' camera", "take a 'perspective' one"),
    "distortion": Word("a camera with 'distortion'", "undistort the photograph and leave 'distortion' out"),
    "orthographic": Word("an 'orthographic' camera", "take a 'perspective' one"),
    "radiancemeter": Word("the one ray of a 'radiancemeter'", "use a narrow camera"),
    "irradiancemeter": Word("an 'irradiancemeter'", "watch with a camera instead"),
    "transient": Word("the time bins of a 'transient_hdr_film'", "use an 'hdrfilm'"),
    # Estimators
    "guided_bins": Word("guiding before a 'transient_hdr_film'", "leave out guiding"),
    "guided_by_photons": Word(
        "guiding.Grid() in media, whose photons and importons stay on surfaces",
        "use guiding.KdTree() or guiding.Octree()",
    ),
    "material_first": Word("first vertices that stay on surfaces", "use interior.Replay()"),
}


def words(*names: str) -> frozenset[str]:
    """Return a set of words.

    Raises:
        KeyError: one of them is not in the list.
    """
    for name in names:
        WORDS[name]
    return frozenset(names)


#: What paths from the camera meet without knowing it.
COMMON = words(
    "moving_vertices",
    *("vertex_normals", "mirrors", "rough_glass", "null", "turned_normals", "steps"),
    *("point_lights", "far_lights", "hide_emitters", "hidden_lights", "shining"),
    *("thinlens", "distortion", "orthographic", "radiancemeter", "irradiancemeter"),
)
#: What vertices in a medium need.
MEDIA = words("media", "moving_media", "density_grids", "microflakes", "blended_grids", "emission")
#: Shapes without triangles.
SOLIDS = words("material_points", "slides", "moving_slides")
#: Word -> words that do not go with it, whatever the method.
NEVER = {
    "transient": words("media", "far_lights", "rough_glass"),
}
#: Word -> words beside which nothing that moves is followed, whatever the method.
APART = {
    "media": words("radiancemeter", "irradiancemeter", "hidden_lights", "slides"),
    "rough_glass": words("transient", "material_points", "slides"),
    "transient": words("mirrors", "material_points", "slides"),
    "radiancemeter": words("vertex_normals"),
}
