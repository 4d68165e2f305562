"""Draw what a survey measures of catalogued sources, from models of detection and measurement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
import scipy

from lake_schema import sky
from lake_schema.arrays import Array, Bool, Float, Int
from truesky.emulator import features, lookup
from truesky.emulator.examples import Outcomes
from truesky.emulator.features import Features, Neighbours
from truesky.emulator.model import Model
from truesky.randomness.per_source import AnyGenerator, PerSourceGenerator

# Magnitudes, their errors (mag) and radii (arcsec) are at most these. A detection with hardly any flux has huge ones;
# source-extractor writes 99 for magnitudes without flux.
_LARGEST_MAGNITUDE, _LARGEST_RADIUS = 99.0, 1e3
# Correlations of two bands, measured in the same fields in VIS and NISP J (docs/emulator.md). Numbers of a source in a
# band are normal deviates that have a share of their variance in common with the numbers of other bands. Between two
# brightnesses (magnitude minus depth) the share falls linearly. Sources are blended in all bands or in none, mostly.
_BLENDING_SHARE = ((-3.0, -1.0), (0.95, 0.75))
# Errors of magnitudes and sizes are common because of the profile of a galaxy and its neighbours, which matter less in
# more noise.
_MAGNITUDE_SHARE = ((-4.5, -1.5), (0.7, 0.12))
# Measured positions differ by this much (arcsec) from the true ones at most, so that the margins of cells suffice.
_LARGEST_SHIFT = 1.0


@dataclass(frozen=True, slots=True)
class Sources:
    """Catalogued sources.

    Attributes
    ----------
    ids : int array, shape (n,)
        Identifiers.
    ra, dec : float array, shape (n,)
        Positions (lensed) in deg.
    radius : float array, shape (n,)
        Half-light radii in arcsec, 0 for points.
    magnitude : dict of str to float array, shape (n,)
        AB magnitudes in each band.
    """

    ids: Int
    ra: Float
    dec: Float
    radius: Float
    magnitude: Mapping[str, Float]


@dataclass(frozen=True, slots=True)
class Conditions:
    """Conditions of the images of one band at the places of n sources.

    Attributes
    ----------
    is_covered : bool array, shape (n,)
        True if an exposure covers the place.
    depth : float array, shape (n,)
        Magnitude of a point source at 5 sigma; any finite number where there is no exposure.
    psf_area : float array, shape (n,)
        Effective area of the PSF in arcsec^2; any positive number where there is no exposure.
    """

    is_covered: Bool
    depth: Float
    psf_area: Float


@dataclass(frozen=True, slots=True)
class Observation:
    """How n sources were observed in one band.

    Attributes
    ----------
    outcomes : Outcomes
        Detection, blending and flags, and for detected sources the measurements relative to the true values.
    psf : float array, shape (n,)
        Half-light radius of the PSF in arcsec.
    radius : float array, shape (n,)
        Half-light radius of the source after convolution in arcsec.
    """

    outcomes: Outcomes
    psf: Float
    radius: Float


def observe(
    sources: Sources, conditions: Mapping[str, Conditions], models: Sequence[Model], seed: int
) -> dict[str, Array]:
    """Draw the rows of the table `observed` for sources.

    Parameters
    ----------
    sources : Sources
        Sources with all their neighbours.
    conditions : mapping of str to Conditions
        Conditions at the sources in the band of each model.
    models : sequence of Model
        Models of the bands, in the order in which measured positions are preferred.
    seed : int
        Seed of the random numbers.

    Returns
    -------
    dict of str to array, shape (n,)
        Columns of the table. Values that are missing are masked.
    """
    depths = {name: condition.depth for name, condition in conditions.items()}
    is_bright = np.zeros(len(sources.ids), bool)
    for band, depth in depths.items():
        is_bright |= sources.magnitude[band] - depth < -features.BRIGHT
    pairs = features.find_neighbours(sources.ids, sources.ra, sources.dec, is_bright)
    columns: dict[str, Array] = {}
    common_generator = PerSourceGenerator(sources.ids, seed, "emulator.common")
    common = common_generator.standard_normal(), common_generator.standard_normal()
    east, north, detected = np.zeros(len(sources.ids)), np.zeros(len(sources.ids)), np.zeros(len(sources.ids), bool)
    for model in models:
        condition = conditions[model.band]
        band_observation = _observe_band(sources, condition, model, pairs, (seed, common))
        is_detected = band_observation.outcomes.detected
        is_first = is_detected & ~detected
        for shift, axis in ((east, band_observation.outcomes.dx), (north, band_observation.outcomes.dy)):
            shift[is_first] = (axis * band_observation.psf)[is_first]
        detected |= is_detected
        columns |= _columns(band_observation, sources.magnitude[model.band], condition, model)
    scale = np.minimum(1.0, _LARGEST_SHIFT / np.maximum(np.hypot(east, north), 1e-30))
    east, north = (np.radians(shift * scale / 3600.0) for shift in (east, north))
    ra, dec = sky.offset_positions(sources.ra, sources.dec, east, north)
    place = {"id": sources.ids, "ra": np.where(detected, ra, sources.ra), "dec": np.where(detected, dec, sources.dec)}
    return {**place, "detected": detected, **columns}


def band_features(
    sources: Sources, condition: Conditions, band: str, pairs: Neighbours
) -> tuple[Features, Float, Float]:
    """Return the features of sources in a band, and two radii.

    Parameters
    ----------
    sources : Sources
        The sources.
    condition : Conditions
        Conditions in the band.
    band : str
        Name of the band.
    pairs : Neighbours
        Pairs of neighbouring sources.

    Returns
    -------
    features : Features
        The features.
    psf : float array, shape (n,)
        Half-light radius of the PSF in arcsec.
    radius : float array, shape (n,)
        Half-light radius of each source after convolution in arcsec.
    """
    psf = features.psf_radius(condition.psf_area)
    radius = np.hypot(sources.radius, psf)
    brightness = sources.magnitude[band] - condition.depth
    # Relative to one depth, not to the local one: light of neighbours must not depend on the depth at their places.
    flux = 10.0 ** (-0.4 * (sources.magnitude[band] - 25.0))
    blending = features.neighbour_light(pairs, flux, radius, brightness < -features.BRIGHT)
    return Features(brightness, np.log10(radius / psf), blending, features.is_point(sources.ids)), psf, radius


def draw_outcomes(
    model: Model, source_features: Features, generator: AnyGenerator, common: tuple[Float, Float]
) -> Outcomes:
    """Draw the outcomes of n sources in one band.

    Parameters
    ----------
    model : Model
        Model of the band.
    source_features : Features
        Features in the band.
    generator : PerSourceGenerator or numpy Generator
        Generator of the band.
    common : (float array, float array), each of shape (n,)
        Normal deviates for blending and for magnitudes, which are the same in each band.

    Returns
    -------
    Outcomes
        Outcomes of examples. Blending and errors of magnitudes are correlated with other bands, and detection of
        sources that are not blended is not.
    """
    count = len(source_features.brightness)
    node = lookup.nodes(source_features, tuple(generator.random(count) for _ in range(3)))
    shares = (np.interp(source_features.brightness, *share) for share in (_BLENDING_SHARE, _MAGNITUDE_SHARE))
    # Correlated uniform numbers: the distribution function of normal deviates (a Gaussian copula).
    blending, magnitude = (
        scipy.special.ndtr(np.sqrt(share) * normal + np.sqrt(1.0 - share) * generator.standard_normal(count))
        for share, normal in zip(shares, common, strict=True)
    )
    index = lookup.draw_in_steps(model.lookup, node, blending, generator.random(count), magnitude)
    return model.examples.outcomes.select(index)


def _observe_band(
    sources: Sources,
    condition: Conditions,
    model: Model,
    pairs: Neighbours,
    randomness: tuple[int, tuple[Float, Float]],
) -> Observation:
    """Return the observation of one band; `randomness` is the seed, and the common numbers of all bands."""
    source_features, psf, radius = band_features(sources, condition, model.band, pairs)
    generator = PerSourceGenerator(sources.ids, randomness[0], "emulator", model.band)
    outcomes = draw_outcomes(model, source_features, generator, randomness[1])
    can_be_seen = condition.is_covered & model.has_examples(source_features)
    values = {field.name: getattr(outcomes, field.name) for field in fields(Outcomes)}
    values |= {name: values[name] & can_be_seen for name in ("detected", "blended")}
    return Observation(Outcomes(**values), psf, radius)


def _columns(band_observation: Observation, magnitude: Float, condition: Conditions, model: Model) -> dict[str, Array]:
    """Return the columns of one band; values are masked where the band does not cover or not detect a source."""
    outcomes, band = band_observation.outcomes, model.band
    is_missing, is_lost = ~condition.is_covered, ~outcomes.detected
    magnitudes = {
        "mag_auto": magnitude + outcomes.mag_auto, "magerr_auto": outcomes.magerr_auto,
        "mag_aper": magnitude + outcomes.mag_aper, "magerr_aper": outcomes.magerr_aper,
    }  # fmt: skip
    measured = {name: np.minimum(values, _LARGEST_MAGNITUDE) for name, values in magnitudes.items()}
    measured["flux_radius"] = np.minimum(outcomes.radius * band_observation.radius, _LARGEST_RADIUS)
    measured["flags"] = outcomes.flags
    flags = {
        "detected": outcomes.detected, "blended": outcomes.blended,
        "extrapolated": model.is_extrapolated(condition.depth),
    }  # fmt: skip
    out: dict[str, Array] = {f"{name}_{band}": np.ma.masked_array(values, is_missing) for name, values in flags.items()}
    return out | {f"{name}_{band}": np.ma.masked_array(values, is_lost) for name, values in measured.items()}
