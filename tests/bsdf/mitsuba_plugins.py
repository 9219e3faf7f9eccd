"""Mitsuba's plugins of the materials that the tests of scattering models use; None: its arithmetic does not do."""


def rgb(mat: dict, *names: str) -> dict:
    return {name: {"type": "rgb", "value": mat[name].tolist()} for name in names}


def mitsuba_rough(mat: dict, distribution: str) -> dict | None:
    # Mitsuba's arithmetic does not resolve narrow lobes.
    if min(mat["alpha_u"], mat["alpha_v"]) < 0.05:
        return None
    shape = {"distribution": distribution, "alpha_u": mat["alpha_u"], "alpha_v": mat["alpha_v"]}
    return {"type": "roughconductor", **shape, **rgb(mat, "specular_reflectance", "eta", "k")}


def mitsuba_dielectric(mat: dict, plugin: str = "dielectric") -> dict | None:
    # Its Fresnel reflectance cancels where the indices are nearly equal.
    if abs(mat["ior"] - 1.0) < 0.01:
        return None
    colors = rgb(mat, "specular_reflectance", "specular_transmittance")
    return {"type": plugin, "int_ior": mat["ior"], "ext_ior": 1.0, **colors}


def mitsuba_plastic(mat: dict, nonlinear: bool) -> dict | None:
    # A lobe whose reflectance is 0 is not drawn there, and here it is, since its derivative is not 0.
    if abs(mat["ior"] - 1.0) < 0.01 or mat["diffuse_reflectance"].max() * mat["specular_reflectance"].max() == 0.0:
        return None
    colors = rgb(mat, "diffuse_reflectance", "specular_reflectance")
    return {"type": "plastic", "int_ior": mat["ior"], "ext_ior": 1.0, "nonlinear": nonlinear, **colors}


def mitsuba_rough_plastic(mat: dict, distribution: str, nonlinear: bool) -> dict | None:
    smooth = mitsuba_plastic(mat, nonlinear)
    if smooth is None or mat["alpha"] < 0.05:
        return None
    return smooth | {"type": "roughplastic", "distribution": distribution, "alpha": mat["alpha"]}


def mitsuba_rough_glass(mat: dict, distribution: str) -> dict | None:
    smooth = mitsuba_dielectric(mat)
    if smooth is None or min(mat["alpha_u"], mat["alpha_v"]) < 0.05:
        return None
    shape = {"distribution": distribution, "alpha_u": mat["alpha_u"], "alpha_v": mat["alpha_v"]}
    return smooth | {"type": "roughdielectric", **shape}
