"""Examples: true sources on images, with the measurements of a detection program."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Array, Bool, Float, Int
from lake_schema.tables.survey.observed import EXAMPLES
from truesky.emulator.features import Features


@dataclass(frozen=True, slots=True)
class Outcomes:
    """How n sources were detected and measured; floats are NaN, and flags 0, if a source was not detected.

    Attributes
    ----------
    detected, blended : bool array, shape (n,)
        True for detected sources, and for those in a detection of a brighter source.
    mag_auto, magerr_auto : float32 array, shape (n,)
        MAG_AUTO minus the true magnitude, and its error.
    mag_aper, magerr_aper : float32 array, shape (n,)
        MAG_APER minus the true magnitude, and its error.
    radius : float32 array, shape (n,)
        FLUX_RADIUS over the true half-light radius after convolution with the PSF.
    dx, dy : float32 array, shape (n,)
        Measured minus true position in half-light radii of the PSF.
    flags : int16 array, shape (n,)
        FLAGS of SourceExtractor.
    """

    detected: Bool
    blended: Bool
    mag_auto: Array
    magerr_auto: Array
    mag_aper: Array
    magerr_aper: Array
    radius: Array
    dx: Array
    dy: Array
    flags: Array

    def select(self, rows: Int | Bool) -> Outcomes:
        """Return the outcomes of some sources, given by indices or by a boolean mask."""
        return Outcomes(*(getattr(self, field.name)[rows] for field in fields(self)))


@dataclass(frozen=True, slots=True)
class Examples:
    """Features of n sources, and the outcomes of their measurement."""

    features: Features
    outcomes: Outcomes

    def select(self, rows: Int | Bool) -> Examples:
        """Return some examples, given by indices or by a boolean mask."""
        return Examples(self.features.select(rows), self.outcomes.select(rows))

    def __len__(self) -> int:
        return len(self.features.brightness)


def join(parts: Sequence[Examples]) -> Examples:
    """Return the examples of several images together, at least one, in their order."""

    def concatenate_fields(kind: type, records: Sequence[object]) -> list[Array]:
        return [np.concatenate([getattr(record, field.name) for record in records]) for field in fields(kind)]

    return Examples(
        Features(*concatenate_fields(Features, [part.features for part in parts])),
        Outcomes(*concatenate_fields(Outcomes, [part.outcomes for part in parts])),
    )


def to_table(examples: Examples) -> pa.Table:
    """Return examples as the rows of the table `EXAMPLES`."""
    records = (examples.features, examples.outcomes)
    return EXAMPLES.build({field.name: getattr(record, field.name) for record in records for field in fields(record)})


def from_table(rows: pa.Table) -> Examples:
    """Return the examples in rows of the table `EXAMPLES`; features become float64."""

    def values(kind: type) -> list[Array]:
        return [rows[field.name].to_numpy() for field in fields(kind)]

    numbers = [array.astype(float) if array.dtype.kind == "f" else array for array in values(Features)]
    return Examples(Features(*numbers), Outcomes(*values(Outcomes)))


def detected_fraction(examples: Examples, edges: Float) -> Float:
    """Return the fraction of galaxies that are detected in each bin of brightness.

    Parameters
    ----------
    examples : Examples
        Examples of all sizes and types.
    edges : float array, shape (k + 1,)
        Edges of the bins, magnitude minus depth.

    Returns
    -------
    float array, shape (k,)
        Fraction of the extended sources, 1 in empty bins that are brighter than all, and else that of the bin before.
    """
    is_galaxy = ~examples.features.is_point
    brightness, detected = examples.features.brightness[is_galaxy], examples.outcomes.detected[is_galaxy]
    count = np.histogram(brightness, edges)[0]
    detected_count = np.histogram(brightness[detected], edges)[0]
    fraction = np.ones(len(count))
    for i in range(len(count)):
        fraction[i] = detected_count[i] / count[i] if count[i] else fraction[max(i - 1, 0)]
    return fraction
