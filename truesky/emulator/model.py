"""Model of detection and measurement in one band: its file and its predictions."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from lake_schema import __version__, user_files
from lake_schema.arrays import Array, Bool, Float
from lake_schema.errors import BadInput
from lake_schema.store.provenance import canonical
from lake_schema.tables.survey.observed import EXAMPLES
from truesky.emulator import examples as example_tables
from truesky.emulator import lookup
from truesky.emulator.examples import Examples
from truesky.emulator.features import Features
from truesky.emulator.lookup import Lookup

# The depth may differ from the depths of the training by at most this (mag) without extrapolation.
DEPTH_MARGIN = 0.5
# Key of the metadata in a model file, and the name of its format.
_KEY, _FORMAT = b"truesky_emulator", 1
# Metadata that a file must have.
_FACTS = ("format", "camera", "band", "settings", "conditions", "faintest", "sha256")
# Edges of the bins of brightness (mag) in which the detected fraction is measured.
_EDGES = np.arange(-9.0, 1.75, 0.25)
# Galaxies fainter than this fraction of the examples are not detected. A catalogue of galaxies ends at a magnitude,
# beyond which there are stars and a few galaxies with unusual colours, too few to learn from.
_FAINTEST_GALAXIES = 0.99
# Kind of the file in `user_files`.
_KIND = "model"


@dataclass(frozen=True, slots=True)
class Model:
    """Model of detection and measurement in one band.

    Attributes
    ----------
    facts : mapping
        Camera, band, settings of the detection, calibration (with masters or not, and the level above which cosmic rays
        were replaced), and conditions of the training: smallest and largest `depth`, `sky` and `psf_area`, number of
        frames, and code.
    examples : Examples
        Sources and their measurements.
    lookup : Lookup
        Lists of similar examples.
    sha256 : str
        sha256 of the file.
    """

    facts: Mapping[str, Any]
    examples: Examples
    lookup: Lookup
    sha256: str

    @property
    def band(self) -> str:
        """Return the name of the passband."""
        return str(self.facts["band"])

    @property
    def camera(self) -> str:
        """Return the name of the camera."""
        return str(self.facts["camera"])

    @property
    def faintest(self) -> float:
        """Return the largest brightness (magnitude minus depth) of the examples; fainter sources are not detected."""
        return float(self.facts["faintest"])

    @property
    def faintest_galaxy(self) -> float:
        """Return the brightness to which there are many examples of galaxies; fainter galaxies are not detected."""
        galaxies = self.examples.features.brightness[~self.examples.features.is_point]
        return min(self.faintest, float(np.quantile(galaxies, _FAINTEST_GALAXIES))) if galaxies.size else self.faintest

    def has_examples(self, sources: Features) -> Bool:
        """Return True for sources that are not fainter than the examples of their type, points or galaxies."""
        return np.asarray(sources.brightness <= np.where(sources.is_point, self.faintest, self.faintest_galaxy))

    @property
    def depths(self) -> tuple[float, float]:
        """Return the smallest and largest depth for which the model is valid, mag."""
        low, high = self.facts["conditions"]["depth"]
        return float(low) - DEPTH_MARGIN, float(high) + DEPTH_MARGIN

    def is_extrapolated(self, depth: npt.ArrayLike) -> Bool:
        """Return True for depths outside the range of the model."""
        low, high = self.depths
        return (np.asarray(depth) < low) | (np.asarray(depth) > high)

    def detection_probability(self, magnitude: npt.ArrayLike, depth: npt.ArrayLike) -> Float:
        """Return the fraction of galaxies that are detected, averaged over sizes and neighbours.

        Parameters
        ----------
        magnitude : float or float array
            Total magnitudes.
        depth : float or float array
            Magnitude of a point source at 5 sigma there, of a shape that broadcasts with the magnitudes.

        Returns
        -------
        float array
            Fractions from 0 to 1; 0 for galaxies fainter than all examples.
        """
        fraction = example_tables.detected_fraction(self.examples, _EDGES)
        middle = 0.5 * (_EDGES[1:] + _EDGES[:-1])
        brightness = np.asarray(magnitude, float) - np.asarray(depth, float)
        return np.where(brightness > self.faintest_galaxy, 0.0, np.interp(brightness, middle, fraction))

    def half_detected(self) -> float:
        """Return the brightness (magnitude minus depth) beyond which less than half of the galaxies are detected."""
        fraction = example_tables.detected_fraction(self.examples, _EDGES)
        # The last bin counts, not the first one with a smaller fraction: bright bins contain few galaxies.
        detected_bins = np.flatnonzero(fraction >= 0.5)
        return min(
            float(_EDGES[detected_bins[-1] + 1]) if detected_bins.size else float(_EDGES[0]), self.faintest_galaxy
        )


def write_model(path: Path, examples: Examples, facts: Mapping[str, Any]) -> str:
    """Write a model file, and return its sha256.

    Parameters
    ----------
    path : Path
        Target, a Parquet file.
    examples : Examples
        Sources and their measurements.
    facts : mapping
        Metadata as JSON values, with at least camera, band, settings, conditions and faintest.

    Returns
    -------
    str
        sha256 of the file. Equal arguments give equal bytes.
    """
    rows = example_tables.to_table(examples)
    metadata = {**facts, "format": _FORMAT, "truesky": __version__, "sha256": _contents_sha256(rows)}
    rows = rows.replace_schema_metadata({_KEY: canonical(metadata)})
    with user_files.replace_atomically(path) as temporary:
        pq.write_table(rows, temporary, **EXAMPLES.parquet_options())
        return hashlib.sha256(temporary.read_bytes()).hexdigest()


def read_model(path: Path) -> Model:
    """Read a model file.

    Parameters
    ----------
    path : Path
        File of `truesky train`.

    Returns
    -------
    Model
        The model.

    Raises
    ------
    BadInput
        If the file does not exist, is not a model, has another format, or is damaged.
    """
    return _parse(user_files.read_bytes(path, _KIND), user_files.format_path(path))


@lru_cache(maxsize=8)
def _parse(content: bytes, name: str) -> Model:
    """Return the model in the bytes of a file; `name` is the file's, for messages.

    The bytes are the key of the cache, not the path, because a file may be replaced by a new model.
    """
    try:
        rows = pq.read_table(pa.BufferReader(content))
        facts = json.loads((rows.schema.metadata or {})[_KEY])
    except (KeyError, ValueError, OSError, pa.ArrowException) as error:
        problem = "it is not a model of truesky train" if isinstance(error, KeyError) else "the file is damaged"
        raise BadInput(f"{name}: {problem}: make it with truesky train LAKE --out MODEL") from None
    if not isinstance(facts, dict) or facts.get("format") != _FORMAT or any(key not in facts for key in _FACTS):
        raise BadInput(f"{name}: a model of another version of truesky: make it again with truesky train")
    if rows.schema.names != EXAMPLES.names or _contents_sha256(rows) != facts["sha256"] or not rows.num_rows:
        raise BadInput(f"{name}: the file is damaged: its contents differ from its sha256; make it again")
    examples = example_tables.from_table(rows)
    return Model(facts, examples, lookup.build(examples), hashlib.sha256(content).hexdigest())


def _contents_sha256(rows: pa.Table) -> str:
    """Return the sha256 of the values of all columns."""
    digest = hashlib.sha256()
    for column in rows.columns:
        values: Array = np.ascontiguousarray(column.to_numpy())
        digest.update(str(values.dtype).encode() + values.tobytes())
    return digest.hexdigest()
