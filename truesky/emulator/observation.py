"""Draw what a survey measures of catalogued sources, from models of detection and measurement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Array, Bool, Float, Int
from truesky.emulator import features, lookup
from truesky.emulator.examples import Outcomes
from truesky.emulator.features import Features, Neighbours
from truesky.emulator.model import Model
from truesky.randomness.per_source import PerSourceGenerator

# Magnitudes, their errors (mag) and radii (arcsec) are at most these. A detection with hardly any flux has huge ones;
# source-extractor writes 99 for magnitudes without flux.
_LARGEST_MAGNITUDE, _LARGEST_RADIUS = 99.0, 1e3
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
    east, north, detected = np.zeros(len(sources.ids)), np.zeros(len(sources.ids)), np.zeros(len(sources.ids), bool)
    for model in models:
        condition = conditions[model.band]
        band_observation = _observe_band(sources, condition, model, pairs, seed)
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


def _observe_band(sources: Sources, condition: Conditions, model: Model, pairs: Neighbours, seed: int) -> Observation:
    source_features, psf, radius = band_features(sources, condition, model.band, pairs)
    band_generator = PerSourceGenerator(sources.ids, seed, "emulator", model.band)
    # The bands are drawn independently: the correlation of their errors has not been measured.
    draw = band_generator.random
    numbers = draw(), draw(), draw(), draw()
    outcomes = model.examples.outcomes.select(lookup.draw(model.lookup, source_features, numbers))
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
