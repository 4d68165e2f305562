"""Eclipses and tides of close binaries: which stars have them, and their light curves.

Both stars of a binary are rows of table `stars`. Each row has its own light curve: the other star eclipses it once per
orbit, and tides make it an ellipsoid. The light of the pair is the sum of the two. Fluxes are relative to the light of
a star outside of eclipses, averaged over the tides, which is the flux of the catalogue.

Notes
-----
The size of an orbit is that from which the catalogue drew the distance between the stars on the sky; its period follows
from Kepler's third law. Orbits with a period below `CIRCULAR_BELOW` are circular. Main-sequence stars whose orbit is
too small for their Roche lobes become contact binaries: their orbit is the smallest one in which the stars fit. Giants
that do not fit have merged with their companions, and do not vary. Stars are spheres in eclipses. Reflection, spots,
third bodies, apsidal motion and light travel time are left out.

References
----------
Raghavan et al. 2010, ApJS 190, 1 (eccentricities); Eggleton 1983, ApJ 268, 368 (Roche lobes); Morris 1985, ApJ 295, 143
(tides)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Bool, Float, Int
from truesky.randomness.per_source import AnyGenerator

# Radius of the Sun in AU (nominal values of IAU 2015), and log10 of its surface gravity (cm s-2).
SUN_RADIUS_AU, _SUN_LOG_G = 0.00465047, 4.438
DAY_PER_YEAR = 365.25
# Period (d) below which tides have made orbits circular, and largest eccentricity of the others, which have a flat
# distribution (Raghavan et al. 2010, section 5.3.2).
CIRCULAR_BELOW, _LARGEST_ECCENTRICITY = 12.0, 0.6
# Smallest amplitude (mag in V) of an eclipse or of tides that makes a star variable.
SHALLOWEST = 1e-3
# Factor of the amplitude of tides, 0.15 (15 + u) (1 + g) / (3 - u), for the limb darkening u = 0.6 and the gravity
# darkening g = 0.32 of stars with a convective envelope (Morris 1985, eq. 1; Lucy 1967).
_TIDES = 0.15 * 15.6 * 1.32 / 2.4
# Largest amplitude of tides: stars near contact are not described by the expansion.
_LARGEST_TIDES = 0.15
# Largest axis of orbits with tides of at least `SHALLOWEST`, in units of the larger radius. A star with a companion of
# 20 times its mass is the extreme case.
_TIDAL_REACH = 32.0
# Number of discs that describe the limb darkening of an eclipsed star.
DISCS = 12
# Coefficients of linear limb darkening by pivot wavelength (A); adopted after Claret & Bloemen 2011, A&A 529, A75, for
# stars like the Sun.
_DARK_WAVELENGTH = np.array([3600.0, 4400.0, 5500.0, 6500.0, 8000.0, 12500.0, 16500.0, 22000.0])
_DARKENING = np.array([0.85, 0.78, 0.65, 0.57, 0.47, 0.35, 0.28, 0.24])
_V_WAVELENGTH = 5500.0


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Properties of n binaries.

    Attributes
    ----------
    mass, log_g : float array, shape (2, n)
        Masses (Msun), and log10 of the surface gravities (cm s-2), of the primaries and of the companions.
    can_touch : bool array, shape (n,)
        True if both stars are on the main sequence, so that they become a contact binary in an orbit that is too small.
    axis : float array, shape (n,)
        Semi-major axis, AU.
    """

    mass: Float
    log_g: Float
    can_touch: Bool
    axis: Float

    def select(self, chosen: Int | Bool) -> Pairs:
        """Return some of the binaries, given by indices or as a bool mask."""
        return Pairs(self.mass[:, chosen], self.log_g[:, chosen], self.can_touch[chosen], self.axis[chosen])


@dataclass(frozen=True, slots=True, eq=False)
class Eclipses:
    """Light curves of the two stars of n binaries; the first row of each array describes the primaries.

    Attributes
    ----------
    is_variable : bool array, shape (2, n)
        True for stars with eclipses or tides of at least `SHALLOWEST`.
    period : float array, shape (2, n)
        Period of the orbit, d.
    phase : float array, shape (2, n)
        Time from the eclipse of the primary until the eclipse of the star, in periods.
    radius_ratio : float array, shape (2, n)
        Radius of the other star in units of the star's radius; 0 without eclipses.
    impact : float array, shape (2, n)
        Smallest distance of the other star's centre from the star's centre on the sky, in units of the star's radius.
    duration : float array, shape (2, n)
        Duration of the eclipse, d; 0 without eclipses.
    tides : float array, shape (2, n)
        Relative semi-amplitude of the change of the flux by tides.
    amplitude : float array, shape (2, n)
        Difference between minimum and maximum of the star's own light in V, mag.
    """

    is_variable: Bool
    period: Float
    phase: Float
    radius_ratio: Float
    impact: Float
    duration: Float
    tides: Float
    amplitude: Float


def radius(mass: Float, log_g: Float) -> Float:
    """Return radii (AU) of stars with masses (Msun) and log10 of surface gravities (cm s-2)."""
    return np.asarray(SUN_RADIUS_AU * np.sqrt(mass * 10.0 ** (_SUN_LOG_G - log_g)))


def roche_radius(ratio: Float) -> Float:
    """Return the radius of a star's Roche lobe in units of the axis; `ratio` is its mass in units of the other's."""
    root = np.cbrt(ratio)
    return np.asarray(0.49 * root**2 / (0.6 * root**2 + np.log1p(root)))


def period_of_orbit(axis: Float, total_mass: Float) -> Float:
    """Return the periods (d) of orbits with semi-major axes (AU) and total masses (Msun)."""
    return np.asarray(DAY_PER_YEAR * np.sqrt(axis**3 / total_mass))


def may_vary(pairs: Pairs, cosine: Float) -> Int:
    """Return the indices of the binaries that may have eclipses or tides, most of them close ones.

    `cosine` is the cosine of each inclination, the first number that `draw` draws.
    """
    radii = radius(pairs.mass, pairs.log_g)
    nearest = (1.0 - _LARGEST_ECCENTRICITY) * pairs.axis
    return np.flatnonzero((cosine * nearest < radii.sum(0)) | (pairs.axis < _TIDAL_REACH * radii.max(0)))


def draw(pairs: Pairs, rng: AnyGenerator) -> Eclipses:
    """Draw inclinations, eccentricities and orientations of binaries, and compute their eclipses and tides.

    Parameters
    ----------
    pairs : Pairs
        n binaries.
    rng : AnyGenerator
        Random numbers, three per binary.

    Returns
    -------
    Eclipses
        The light curves of both stars.
    """
    n = pairs.axis.size
    cosine, share, angle = rng.random(n), rng.random(n), 2.0 * np.pi * rng.random(n)
    radii = radius(pairs.mass, pairs.log_g)
    smallest = (radii / roche_radius(pairs.mass / pairs.mass[::-1])).max(0)
    axis = np.where(pairs.can_touch, np.maximum(pairs.axis, smallest), pairs.axis)
    period = period_of_orbit(axis, pairs.mass.sum(0))
    # The stars must fit at their smallest distance, too.
    most_eccentric = np.minimum(_LARGEST_ECCENTRICITY, np.maximum(1.0 - smallest / axis, 0.0))
    eccentricity = np.where(period < CIRCULAR_BELOW, 0.0, share * most_eccentric)
    exists = axis >= smallest
    # Stars are eclipsed where the other one is in front: the angle from the periastron is pi/2 - angle there for one
    # star, and -pi/2 - angle for the other.
    sign = np.array([[1.0], [-1.0]])
    lean = sign * eccentricity * np.sin(angle)
    inverse_distance = (1.0 + lean) / (axis * (1.0 - eccentricity**2))
    anomaly = _mean_anomaly(0.5 * np.pi * sign - angle, eccentricity)
    phase = (anomaly - anomaly[0]) / (2.0 * np.pi) % 1.0
    sine = np.sqrt(1.0 - cosine**2)
    impact = cosine / inverse_distance / radii
    ratio = radii[::-1] / radii
    has_eclipse = exists & (impact < 1.0 + ratio)
    half_chord = radii * np.sqrt(np.maximum((1.0 + ratio) ** 2 - impact**2, 0.0)) * inverse_distance
    # The angle of the orbit during an eclipse, at the angular speed of the middle of the eclipse.
    swept = 2.0 * np.arcsin(np.minimum(half_chord / np.maximum(sine, 1e-9), 1.0))
    speed = (1.0 + lean) ** 2 / (1.0 - eccentricity**2) ** 1.5 * 2.0 * np.pi / period
    duration = np.where(has_eclipse, np.minimum(swept / speed, 0.5 * period), 0.0)
    tides = _TIDES * pairs.mass[::-1] / pairs.mass * (radii / axis) ** 3 * sine**2
    tides = np.where(exists & (eccentricity == 0.0), np.minimum(tides, _LARGEST_TIDES), 0.0)
    depth = eclipse_loss(np.minimum(impact, 1e3).ravel(), ratio.ravel(), limb_darkening(_V_WAVELENGTH)).reshape(2, n)
    depth = np.where(has_eclipse, depth, 0.0)
    amplitude = -2.5 * np.log10(np.maximum((1.0 - depth) * (1.0 - tides) / (1.0 + tides), 1e-4))
    has_eclipse &= depth > 0.0
    return Eclipses(
        amplitude >= SHALLOWEST,
        np.broadcast_to(period, (2, n)),
        phase,
        np.where(has_eclipse, ratio, 0.0),
        np.where(has_eclipse, impact, 0.0),
        np.where(has_eclipse, duration, 0.0),
        tides,
        amplitude,
    )


def _mean_anomaly(true_anomaly: Float, eccentricity: Float) -> Float:
    """Return the mean anomaly (rad) at a true anomaly (rad), in any turn."""
    eccentric = 2.0 * np.arctan2(
        np.sqrt(1.0 - eccentricity) * np.sin(0.5 * true_anomaly),
        np.sqrt(1.0 + eccentricity) * np.cos(0.5 * true_anomaly),
    )
    return np.asarray(eccentric - eccentricity * np.sin(eccentric))


def limb_darkening(wavelength: float) -> float:
    """Return the coefficient u of linear limb darkening, I = 1 - u (1 - mu), at a pivot wavelength (A)."""
    return float(np.interp(np.log(wavelength), np.log(_DARK_WAVELENGTH), _DARKENING))


def eclipse_loss(distance: Float, ratio: Float, darkening: float, discs: int = DISCS) -> Float:
    """Return the fraction of a star's light that another star hides.

    The eclipsed star is the sum of concentric discs of constant brightness, whose overlaps with the other star are
    exact.

    Parameters
    ----------
    distance : float array, shape (n,)
        Distance of the centres on the sky, in units of the radius of the eclipsed star.
    ratio : float array, shape (n,)
        Radius of the other star, in the same unit.
    darkening : float
        Coefficient of linear limb darkening.
    discs : int
        Number of discs. With 12, the loss is right within 0.003.

    Returns
    -------
    float array, shape (n,)
        Fractions, 0 to 1.
    """
    loss = np.zeros(distance.size)
    covered = np.flatnonzero(distance < 1.0 + ratio)
    # A distance of 0 would divide by 0; each disc is then completely visible or hidden.
    d, k = np.maximum(distance[covered], 1e-9), ratio[covered]
    edge = np.arange(discs + 1) / discs
    # Mean brightness of each ring between two discs: the integral of mu over the ring has a closed form.
    mean_mu = -np.diff((1.0 - edge) ** 1.5) * discs / 1.5
    brightness = 1.0 - darkening * (1.0 - mean_mu)
    steps = brightness - np.append(brightness[1:], 0.0)
    hidden = np.zeros(covered.size)
    for square, step in zip(edge[1:], steps / (np.pi * brightness.sum() / discs), strict=True):
        if step != 0.0:
            hidden += step * _overlap(d, k, float(square))
    loss[covered] = np.clip(hidden, 0.0, 1.0)
    return loss


def _overlap(distance: Float, radius_2: Float, square: float) -> Float:
    """Return the area in which a disc with the squared radius `square` and a disc with `radius_2` overlap."""
    r = float(np.sqrt(square))
    first = np.clip((distance**2 + square - radius_2**2) / (2.0 * r * distance), -1.0, 1.0)
    second = np.clip((distance**2 + radius_2**2 - square) / (2.0 * radius_2 * distance), -1.0, 1.0)
    return np.asarray(
        square * (np.arccos(first) - first * np.sqrt(1.0 - first**2))
        + radius_2**2 * (np.arccos(second) - second * np.sqrt(1.0 - second**2))
    )


def flux_factors(
    phase: Float, period: Float, shadow: tuple[Float, Float, Float], tides: Float, darkening: float
) -> Float:
    """Return the flux of stars relative to their flux outside of eclipses.

    Parameters
    ----------
    phase : float array, shape (n, m)
        Phases from the middle of the eclipse of the star, in periods.
    period : float array, shape (n,)
        Periods, d.
    shadow : tuple of float array, shape (n,)
        Radius of the other star and smallest distance of its centre (in units of the star's radius), and duration of
        the eclipse (d).
    tides : float array, shape (n,)
        Relative semi-amplitude of the change of the flux by tides.
    darkening : float
        Coefficient of linear limb darkening.

    Returns
    -------
    float array, shape (n, m)
        Flux relative to that outside of eclipses.
    """
    ratio, impact, duration = shadow
    out = np.ones(phase.shape)
    tidal = np.flatnonzero(tides > 0.0)
    out[tidal] -= tides[tidal, None] * np.cos((4.0 * np.pi) * phase[tidal])
    with np.errstate(divide="ignore", invalid="ignore"):
        # Time from the middle of the eclipse in units of half of its duration.
        time = (phase - np.rint(phase)) * np.where(duration > 0.0, 2.0 * period / duration, np.inf)[:, None]
    row, column = np.nonzero(np.abs(time) < 1.0)
    chord = (1.0 + ratio[row]) ** 2 - impact[row] ** 2
    distance = np.sqrt(impact[row] ** 2 + np.maximum(chord, 0.0) * time[row, column] ** 2)
    out[row, column] *= 1.0 - eclipse_loss(distance, ratio[row], darkening)
    return out
