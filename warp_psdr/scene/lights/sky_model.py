"""The clear sky and the sun of Hosek and Wilkie 2012 and 2013, from their tables.

With the angle theta of a direction from the zenith, gamma from the sun, and nine numbers A ... I and a radiance L_M of
a channel, a turbidity, an albedo of the ground and an elevation eta of the sun,

    L = (1 + A exp(B / (cos theta + 0.01)))
        (C + D exp(E gamma) + F cos^2 gamma + G chi(H, gamma) + I sqrt(cos theta)) L_M,
    chi(g, a) = (1 + cos^2 a) / (1 + g^2 - 2 g cos a)^(3/2).

The numbers are linear in turbidity and albedo between tabulated ones, and Bezier curves of degree 5 in
(2 eta / pi)^(1/3). The sun's radiance, a mean over its disk, is cubic in eta on 45 stretches, and linear in turbidity.

``sky_tables.npz`` holds the tables for red, green and blue under the licence beside it: "sky", (10 turbidities from 1
to 10, albedos 0 and 1, 6 points of the curve, channel, A B C D E F G I H L_M), and "sun", (10 turbidities, 45
stretches, channel, 4 powers of the elevation above the stretch's beginning).
"""

from __future__ import annotations

import datetime
import functools
import math
from pathlib import Path

import numpy as np

#: Mitsuba's units of radiance in RGB: one over the integral of the CIE's y curve, and the sun's spectra in them.
SKY_UNIT = 1.0 / 106.7502593994140625
SUN_UNIT = 467.069280386 * SKY_UNIT
#: Half the angle of the sun, radians, that its tables hold, and its solid angle.
HALF_ANGLE = math.radians(0.5 * 0.5358)
SOLID_ANGLE = 2.0 * math.pi * (1.0 - math.cos(HALF_ANGLE))
#: Turbidities of the tables.
TURBIDITIES = (1.0, 10.0)
_STRETCHES = 45


@functools.cache
def _tables() -> dict[str, np.ndarray]:
    with np.load(Path(__file__).with_name("sky_tables.npz")) as file:
        return {name: file[name].astype(np.float64) for name in file.files}


def _at_turbidity(table: np.ndarray, turbidity: float) -> np.ndarray:
    place = min(max(turbidity, TURBIDITIES[0]), TURBIDITIES[1]) - TURBIDITIES[0]
    low = min(int(place), len(table) - 2)
    return table[low] + (place - low) * (table[low + 1] - table[low])


def sky_radiance(directions: np.ndarray, sun: np.ndarray, turbidity: float, albedo: np.ndarray) -> np.ndarray:
    """Return the radiance of the sky, W/m^2/sr in Mitsuba's units of RGB, (..., 3); 0 if the sun is below the horizon.

    Args:
        directions: (..., 3) unit, z up, none below the horizon.
        sun: (3,) unit, towards the sun.
        turbidity: from 1 to 10.
        albedo: (3,) of the ground, from 0 to 1.
    """
    if sun[2] < 0.0:
        return np.zeros(directions.shape)
    x = np.cbrt(2.0 * math.asin(min(float(sun[2]), 1.0)) / math.pi)
    curve = [math.comb(5, i) * x**i * (1.0 - x) ** (5 - i) for i in range(6)]
    numbers = np.tensordot(_at_turbidity(_tables()["sky"], turbidity), curve, axes=(1, 0))  # (albedo, channel, number)
    numbers = numbers[0] + albedo[:, None] * (numbers[1] - numbers[0])
    z = np.maximum(directions[..., 2], 0.0)
    cosine = np.clip(directions @ sun, -1.0, 1.0)
    gamma = np.arccos(cosine)
    result = np.empty(directions.shape)
    for channel, (a, b, c, d, e, f, g, i, h, mean) in enumerate(numbers):
        chi = (1.0 + cosine**2) / (1.0 + h * h - 2.0 * h * cosine) ** 1.5
        lobes = c + d * np.exp(e * gamma) + f * cosine**2 + g * chi + i * np.sqrt(z)
        result[..., channel] = (1.0 + a * np.exp(b / (z + 0.01))) * lobes * mean
    return SKY_UNIT * np.maximum(result, 0.0)


def sun_irradiance(sun: np.ndarray, turbidity: float) -> np.ndarray:
    """Return what a surface that faces the sun receives of it, W/m^2 in Mitsuba's units of RGB, (3,); 0 at night.

    Args:
        sun: (3,) unit, towards the sun, z up.
        turbidity: from 1 to 10.
    """
    if sun[2] < 0.0:
        return np.zeros(3)
    elevation = math.asin(min(float(sun[2]), 1.0))
    stretch = min(int(np.cbrt(2.0 * elevation / math.pi) * _STRETCHES), _STRETCHES - 1)
    above = elevation - 0.5 * math.pi * (stretch / _STRETCHES) ** 3
    powers = _at_turbidity(_tables()["sun"], turbidity)[stretch]
    return SUN_UNIT * SOLID_ANGLE * np.maximum(powers @ above ** np.arange(4.0), 0.0)


def sun_at(when: datetime.datetime, latitude: float, longitude: float) -> np.ndarray:
    """Return the direction towards the sun, (3,) float64 unit, z up, x south, y west, to some 0.01 degrees.

    M. Blanco-Muriel et al., "Computing the solar vector", Solar Energy 70(5), 2001.

    Args:
        when: universal time.
        latitude: degrees, north is positive.
        longitude: degrees, east is positive.
    """
    hours = (when - datetime.datetime.combine(when.date(), datetime.time())).total_seconds() / 3600.0
    days = when.date().toordinal() + 1721424.5 + hours / 24.0 - 2451545.0
    node = 2.1429 - 0.0010394594 * days
    anomaly = 6.2400600 + 0.0172019699 * days
    ecliptic = 4.8950630 + 0.017202791698 * days + 0.03341607 * math.sin(anomaly) + 0.00034894 * math.sin(2.0 * anomaly)
    ecliptic += -0.0001134 - 0.0000203 * math.sin(node)
    obliquity = 0.4090928 - 6.2140e-9 * days + 0.0000396 * math.cos(node)
    ascension = math.atan2(math.cos(obliquity) * math.sin(ecliptic), math.cos(ecliptic))
    declination = math.asin(math.sin(obliquity) * math.sin(ecliptic))
    sidereal = 6.6974243242 + 0.0657098283 * days + hours
    turn = math.radians(15.0 * sidereal + longitude) - ascension
    lat = math.radians(latitude)
    up = math.cos(lat) * math.cos(turn) * math.cos(declination) + math.sin(declination) * math.sin(lat)
    zenith = math.acos(min(max(up, -1.0), 1.0))
    north = math.tan(declination) * math.cos(lat) - math.sin(lat) * math.cos(turn)
    azimuth = math.atan2(-math.sin(turn), north)  # from north to east
    zenith += 6371.01 / 149597890.0 * math.sin(zenith)  # parallax
    return np.array([-math.sin(zenith) * math.cos(azimuth), -math.sin(zenith) * math.sin(azimuth), math.cos(zenith)])
