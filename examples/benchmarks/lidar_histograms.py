"""What a time-of-flight lidar makes of transient images: histograms of counts, and its calibration.

A zone z sees light L_t of optical path lengths l_t: a pixel of a transient film with bins much finer than its own. With
the pulse S as its bins see it, their width w, an offset o_z and a gain g_z, photons per laser shot are

    lambda_b = g_z sum_t L_t S(b - o_z - l_t / w).

Two things make counts less than photons. A zone's detectors are blind for some time after a photon, so that the share
alpha = exp(-kappa sum_b lambda_b) of them is awake. The timer takes the first photon of a shot alone (Coates 1968).
With a background a_z and N shots,

    e_b = alpha (lambda_b + a_z),    counts_b = N exp(-sum_{c < b} e_c) (1 - exp(-e_b)).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from common import psdr
from scipy.interpolate import BSpline, make_interp_spline
from scipy.optimize import least_squares

#: Error of the model: relative to a bin's counts, and of the edges of bins, in bins.
MODEL_ERROR = 0.02
#: Knots of the pulse, bins after the offset: narrow where it rises.
KNOTS = np.concatenate([np.arange(-4.0, 6.0, 0.5), np.arange(6.0, 12.0), np.arange(12.0, 61.0, 6.0)])
#: Where a calibration starts: kappa; shots of the laser over the most counts of a histogram.
BLIND, SHOTS = 0.4, 1.5
#: Counts are in millions where they make pulses walk.
MILLION = 1.0e-6
#: Most evaluations of a calibration; change of its loss from which on it is settled.
TRIED, SETTLED = 40, 5.0e-4
#: Weight of the conditions that pin what a pulse may exchange with gains and with offsets.
PINNED = 1.0e3


def reference_pulse(histogram: np.ndarray) -> BSpline:
    """Return the pulse that a reference detector saw, (B,) counts, with its peak at 0."""
    places = np.arange(len(histogram)) - float(np.argmax(histogram))
    spline = make_interp_spline(places, histogram / histogram.sum())
    return BSpline(spline.t, spline.c[:, None], spline.k, extrapolate=False)


def free_pulse(start: BSpline) -> BSpline:
    """Return the pulse as a sum of many splines, (n, 1) coefficients, least squares of another at first."""
    knots = np.concatenate([[KNOTS[0]] * 3, KNOTS, [KNOTS[-1]] * 3])
    x = np.linspace(KNOTS[0], KNOTS[-1] - 1e-6, 600)
    matrix = BSpline.design_matrix(x, knots, 3).toarray()
    return BSpline(knots, np.linalg.lstsq(matrix, values(start, x), rcond=None)[0], 3, extrapolate=False)


def values(spline: BSpline, x: np.ndarray) -> np.ndarray:
    """Return a pulse's values (..., 1), 0 outside of its knots."""
    return np.nan_to_num(spline(x))


def splines(pulse: BSpline, x: np.ndarray) -> np.ndarray:
    """Return the values of each of a pulse's splines, (..., n)."""
    flat, low, high = x.ravel(), pulse.t[pulse.k], pulse.t[-pulse.k - 1]
    inside = (flat >= low) & (flat < high)
    found = np.zeros((flat.size, len(pulse.c)))
    if np.any(inside):
        found[inside] = BSpline.design_matrix(flat[inside], pulse.t, pulse.k).toarray()
    return found.reshape(*x.shape, -1)


def deviation(counts: np.ndarray) -> np.ndarray:
    """Return standard deviations of counts (..., B): of their number, of the model, of uneven edges of bins."""
    slope = np.gradient(counts, axis=-1)
    return np.sqrt(counts + 1.0 + MODEL_ERROR**2 * (counts**2 + slope**2))


def counted(rate: np.ndarray, background: np.ndarray, shots: float, blind: float) -> np.ndarray:
    """Return counts of photons per shot, both (..., B), before a background (..., 1)."""
    e = np.exp(-blind * rate.sum(axis=-1, keepdims=True)) * (rate + background)
    return shots * np.exp(-(np.cumsum(e, axis=-1) - e)) * -np.expm1(-e)


def counted_moved(
    rate: np.ndarray,
    background: np.ndarray,
    shots: float,
    blind: float,
    rate_moved: np.ndarray | float = 0.0,
    background_moved: np.ndarray | float = 0.0,
    blind_moved: float = 0.0,
) -> np.ndarray:
    """Return the derivative of ``counted`` where its arguments have these derivatives, with further axes in front."""
    rate_moved = np.asarray(rate_moved) * np.ones_like(rate)
    total = rate.sum(axis=-1, keepdims=True)
    alpha = np.exp(-blind * total)
    e = alpha * (rate + background)
    fewer = blind * rate_moved.sum(axis=-1, keepdims=True) + blind_moved * total
    moved = alpha * (rate_moved + background_moved) - e * fewer
    before, before_moved = np.cumsum(e, axis=-1) - e, np.cumsum(moved, axis=-1) - moved
    return shots * np.exp(-before) * (np.exp(-e) * moved + np.expm1(-e) * before_moved)


@dataclass(frozen=True)
class Instrument:
    """A lidar of Z zones.

    Attributes:
        blind: kappa.
        shots: N of a histogram.
        walk: bins by which pulses come later for a million counts of all zones together.
        geometry: what of the scene a calibration finds.
        widths: (Z,) of bins, optical path length, m.
        offsets: (Z,) bins.
        gains, background: (Z,).
        pulse: one spline.
    """

    blind: float
    shots: float
    walk: float
    geometry: np.ndarray
    widths: np.ndarray
    offsets: np.ndarray
    gains: np.ndarray
    background: np.ndarray
    pulse: BSpline

    def response(self, lengths: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return photons per light, and their derivative as the pulse gets longer, (Z, B, T).

        Args:
            lengths: (T,) of the light.
            counts: (Z, B) of the histograms, for their sum.
        """
        offsets = self.offsets + self.walk * MILLION * counts.sum()
        x = np.arange(counts.shape[1])[:, None] - offsets[:, None, None] - lengths / self.widths[:, None, None]
        gains = self.gains[:, None, None]
        return gains * values(self.pulse, x)[..., 0], -gains * x * values(self.pulse.derivative(), x)[..., 0]


class Histograms(psdr.Observation):
    """Histograms of a lidar's zones, compared with a transient image; residuals (zones, bins, 1).

    Args:
        counts: (Z, B).
        instrument: which counted.
        response: what its ``response`` returns.
        shape: (H, W, T) of the images, H W = Z.

    The background is unknown, as a factor of that of the calibration.
    """

    def __init__(
        self,
        counts: np.ndarray,
        instrument: Instrument,
        response: tuple[np.ndarray, np.ndarray],
        shape: tuple[int, int, int],
    ):
        super().__init__(np.zeros((*shape, 3)), name="histograms")
        self.unknowns, self.values = ("background",), {"background": np.ones(1)}
        self.linear = counts[..., None].astype(float)
        self.weights = 1.0 / deviation(counts.astype(float))[..., None]
        self._response, self._instrument = response, instrument

    def _rate(self, image: np.ndarray, stretch: bool = False) -> np.ndarray:
        zones = image[..., 0].reshape(len(self.linear), -1)
        return np.einsum("zbt,zt->zb", self._response[int(stretch)], zones)

    def _state(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, float]:
        i = self._instrument
        return self._rate(image), i.background[:, None] * self.values["background"], i.shots, i.blind

    def counts(self, image: np.ndarray) -> np.ndarray:
        """Return the counts that an image gives, (Z, B)."""
        return counted(*self._state(image))

    def residual(self, image: np.ndarray) -> np.ndarray:
        """Return what an image's counts have too much."""
        return self.weights * (self.counts(image)[..., None] - self.linear)

    def pushed(self, image: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """Return the derivative of the residual."""
        return self.weights * counted_moved(*self._state(image), rate_moved=self._rate(moved))[..., None]

    def derivatives(self, image: np.ndarray) -> np.ndarray:
        """Return the derivative by the background."""
        moved = counted_moved(*self._state(image), background_moved=self._instrument.background[:, None])
        return (self.weights * moved[..., None])[None]

    def doubts(self, image: np.ndarray) -> np.ndarray:
        """Return derivatives by the pulse's length, the number of shots, and the time for which detectors are blind."""
        state = self._state(image)
        found = [
            counted_moved(*state, rate_moved=self._rate(image, stretch=True)),
            counted(*state) - counted_moved(*state, rate_moved=state[0], background_moved=state[1]),
            counted_moved(*state, blind_moved=1.0),
        ]
        return self.weights * np.array(found)[..., None]


def guessed(
    counts: np.ndarray, lengths: np.ndarray, images: np.ndarray, width: float, geometry: np.ndarray, pulse: BSpline
) -> Instrument:
    """Return where a calibration starts: arguments as of ``calibrated``; images (n, Z, T) and width are guesses."""
    shots = SHOTS * counts.sum(axis=2).max()
    # Blind detectors make counts less: the most per light is nearest to the gain.
    gains = (counts.sum(axis=2) / images.sum(axis=2)).max(axis=0) / shots
    offsets = np.median(counts.argmax(axis=2) - (images @ lengths) / images.sum(axis=2) / width, axis=0)
    background = np.maximum(np.median(counts, axis=2).max(axis=0), 1.0) / shots
    return Instrument(BLIND, shots, 0.0, geometry, np.full(len(gains), width), offsets, gains, background, pulse)


def calibrated(
    counts: np.ndarray,
    lengths: np.ndarray,
    light: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    start: Instrument,
    clocks: np.ndarray,
    bounds: np.ndarray,
) -> tuple[Instrument, np.ndarray]:
    """Find an instrument from histograms at known places, by least squares.

    Args:
        counts: (n, Z, B).
        lengths: (T,) of the images' bins.
        light: geometry -> images (n, Z, T), and their derivatives by each of its numbers (g, n, Z, T).
        start: the instrument at first.
        clocks: (Z,) which clock a zone has; zones of one clock have bins of one width.
        bounds: (2, g) least and most of the geometry's numbers.

    Returns:
        The instrument, and the residuals over their standard deviations, (n, Z, B).
    """
    zones, pulse, g = counts.shape[1], start.pulse, 3 + len(start.geometry)
    sigma, places = deviation(counts), np.arange(counts.shape[2])
    load = MILLION * counts.sum(axis=(1, 2))
    _clocks, of_clock = np.unique(clocks, return_index=True)
    per_zone = g + len(of_clock)
    per_pulse = per_zone + 3 * zones

    def instrument(x: np.ndarray) -> Instrument:
        offsets, gains, background = x[per_zone:per_pulse].reshape(3, zones)
        own = BSpline(pulse.t, x[per_pulse:, None], pulse.k, extrapolate=False)
        widths = x[g:per_zone][clocks]
        return Instrument(x[0], np.exp(x[1]), x[2], x[3:g], widths, offsets, np.exp(gains), np.exp(background), own)

    @functools.lru_cache(maxsize=2)
    def evaluated(held: bytes) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals and their derivatives, (n, Z, B) and (n, Z, B, numbers)."""
        x = np.frombuffer(held)
        now = instrument(x)
        images, moved_images = light(now.geometry)
        residual, jacobian = np.zeros(counts.shape), np.zeros((*counts.shape, len(x)))
        for i, z in np.ndindex(counts.shape[:2]):
            lit = np.flatnonzero(images[i].any(axis=0))
            sub, own, moved = lengths[lit], images[i, z, lit], moved_images[:, i, z, lit]
            at = places[:, None] - now.offsets[z] - now.walk * load[i] - sub / now.widths[z]
            seen = now.gains[z] * values(now.pulse, at)[..., 0]
            slope = now.gains[z] * values(now.pulse.derivative(), at)[..., 0]
            by_pulse = now.gains[z] * np.tensordot(own, splines(pulse, at), (0, 1))
            rate = seen @ own
            by_offset, by_width = -slope @ own, slope @ (own * sub) / now.widths[z] ** 2
            photons = [load[i] * by_offset, *(moved @ seen.T), by_width, by_offset, rate, *by_pulse.T]
            state = rate, now.background[z], now.shots, now.blind
            residual[i, z] = (counted(*state) - counts[i, z]) / sigma[i, z]
            zone = per_zone + z
            numbers = [*range(2, g), g + clocks[z], zone, zone + zones, *range(per_pulse, len(x))]
            jacobian[i, z][:, numbers] = counted_moved(*state, rate_moved=np.array(photons)).T
            jacobian[i, z, :, 0] = counted_moved(*state, blind_moved=1.0)
            jacobian[i, z, :, 1] = counted(*state)
            jacobian[i, z, :, zone + 2 * zones] = counted_moved(*state, background_moved=now.background[z])
        return residual, jacobian / sigma[..., None]

    logarithms = np.log(start.gains), np.log(start.background)
    scene = [start.blind, np.log(start.shots), start.walk, *start.geometry]
    first = np.concatenate([scene, start.widths[of_clock], start.offsets, *logarithms, pulse.c[:, 0]])
    limits = np.array([[-np.inf], [np.inf]]) * np.ones(len(first))
    limits[:, 3:g] = bounds
    pins = np.zeros((2, len(first)))
    pins[:, per_pulse:] = PINNED * np.stack([np.ones(len(pulse.c)), np.arange(len(pulse.c))]) / np.abs(pulse.c).sum()

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.concatenate([evaluated(x.tobytes())[0].ravel(), pins @ (x - first)])

    def derivatives(x: np.ndarray) -> np.ndarray:
        return np.concatenate([evaluated(x.tobytes())[1].reshape(-1, len(first)), pins])

    options = {
        "bounds": limits,
        "loss": "soft_l1",
        "x_scale": "jac",
        "tr_solver": "lsmr",
        "max_nfev": TRIED,
        "ftol": SETTLED,
    }
    with np.errstate(over="ignore", invalid="ignore"):  # of steps that are too long, which are taken back
        found = least_squares(residuals, first, derivatives, **options).x
    return instrument(found), evaluated(found.tobytes())[0]
