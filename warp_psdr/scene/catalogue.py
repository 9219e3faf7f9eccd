"""All plugins of Mitsuba 3 by kind, unsupported ones included, so that messages can say what a name stands for."""

from __future__ import annotations

#: Names that Mitsuba 3 has, and older versions had, by the XML tag that introduces them.
MITSUBA: dict[str, tuple[str, ...]] = {
    "shape": (
        *("bsplinecurve", "ellipsoids", "ellipsoidsmesh", "heightfield", "instance", "linearcurve", "merge"),
        *("sdfgrid", "serialized", "shapegroup", "hair"),
    ),
    "bsdf": (
        *("bumpmap", "circular", "hair", "measured", "measured_polarized", "normalmap"),
        *("plastic", "polarizer", "pplastic", "principled", "principledthin", "retarder", "roughdielectric"),
        *("roughplastic", "coating", "roughcoating", "difftrans", "phong", "ward", "mixturebsdf"),
        *("roughdiffuse", "opacity"),
    ),
    "texture": ("checkerboard", "volume", "gridtexture", "scale", "vertexcolors", "curvature", "wireframe"),
    "emitter": (*("sunsky", "timed_sunsky", "sky", "sun", "collimated"),),
    "sensor": ("batch", "distant", "fluencemeter", "perspective_rdist"),
    "film": ("specfilm", "ldrfilm", "mfilm", "tiledhdrfilm"),
    "rfilter": ("catmullrom", "lanczos", "mitchell"),
    "sampler": ("halton", "hammersley"),
    "integrator": (
        "depth",
        *("stokes", "volprim_rf_basic", "bdpt", "photonmapper", "ppm", "sppm", "pssmlt", "mlt", "erpt", "vpl"),
        *("adaptive", "irrcache", "multichannel"),
    ),
    "medium": ("heterogeneous", "homogeneous"),
    "phase": ("blendphase", "hg", "isotropic", "rayleigh", "sggx", "tabphase"),
    "volume": ("const", "constvolume", "grid", "gridvolume"),
}


#: Plugins that compute something else, or cannot be had, by kind, and what to use instead.
INSTEAD: dict[str, dict[str, str]] = {
    "bsdf": {
        "phong": "it is of Mitsuba 0.x; give 'ashikhminshirley'",
        "ward": "it is of Mitsuba 0.x; give 'roughconductor' with 'alpha_u' and 'alpha_v', or 'ashikhminshirley'",
        "coating": "it is of Mitsuba 0.x; give 'plastic', or 'principled' with 'clearcoat'",
        "roughcoating": "it is of Mitsuba 0.x; give 'roughplastic', or 'principled' with 'clearcoat'",
        "roughdiffuse": "it is of Mitsuba 0.x; give 'orennayar'",
        "difftrans": "it is of Mitsuba 0.x; give 'principledthin' with 'diff_trans'",
        "mixturebsdf": "it is of Mitsuba 0.x; give 'blendbsdf', one inside another for more than two",
    },
    "emitter": {"timed_sunsky": "give a 'sunsky' for each time, and average its images"},
    "integrator": {
        "depth": "give 'path' and call psdr.render_aov(scene, ['depth'])",
    },
}


def kind_of(name: str) -> str:
    """Return the only kind of plugin that has this name in Mitsuba; empty: none or several."""
    kinds = [kind for kind, names in MITSUBA.items() if name in names]
    return kinds[0] if len(kinds) == 1 else ""
