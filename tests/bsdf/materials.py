"""Materials that the tests of scattering models use: values by name."""

import numpy as np

#: eta and k of gold at red, green and blue (rounded); of a perfect mirror; of a medium that absorbs nothing.
GOLD = ((0.143, 0.375, 1.442), (3.983, 2.386, 1.603))
MIRROR = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
LOSSLESS = ((1.5, 1.3, 2.0), (0.0, 0.0, 0.0))
BLACK = (0.0, 0.0, 0.0)


def material(**values) -> dict:
    """Values by name: numbers, and colours as (3,) arrays."""
    return {name: np.array(v, float) if np.ndim(v) else float(v) for name, v in values.items()}


def metal(indices=GOLD, reflectance=(0.9, 0.6, 0.3)) -> dict:
    return material(specular_reflectance=reflectance, eta=indices[0], k=indices[1])


def rough(alpha_u, alpha_v=None, metal=GOLD, reflectance=(0.9, 0.6, 0.3)) -> dict:
    alpha_v = alpha_u if alpha_v is None else alpha_v
    return material(specular_reflectance=reflectance, eta=metal[0], k=metal[1], alpha_u=alpha_u, alpha_v=alpha_v)


def abc(a, b, c, metal=GOLD, reflectance=(0.9, 0.6, 0.3)) -> dict:
    return material(specular_reflectance=reflectance, eta=metal[0], k=metal[1], A=a, B=b, C=c)


def glass(ior: float, reflectance=(0.9, 0.5, 0.1), transmittance=(0.2, 0.4, 0.6)) -> dict:
    return material(specular_reflectance=reflectance, specular_transmittance=transmittance, ior=ior)


def rough_glass(ior: float, alpha_u: float, alpha_v: float | None = None, **more) -> dict:
    return glass(ior, **more) | material(alpha_u=alpha_u, alpha_v=alpha_u if alpha_v is None else alpha_v)


def plastic(ior: float, diffuse=(0.2, 0.5, 0.8), specular=(0.9, 0.6, 0.3)) -> dict:
    return material(diffuse_reflectance=diffuse, specular_reflectance=specular, ior=ior)


def rough_plastic(ior: float, alpha: float, diffuse=(0.2, 0.5, 0.8), specular=(0.9, 0.6, 0.3)) -> dict:
    return plastic(ior, diffuse, specular) | {"alpha": alpha}
