"""Make the rows of the tables `rendered_truth` and `rendered_spectra` of a detector."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Float, Int
from lake_schema.tables.rendered_truth import RENDERED_SPECTRA, RENDERED_TRUTH
from truesky.render.drawing import transfer
from truesky.render.exposure.rendered_detector import RenderedDetector
from truesky.render.psf import centroids
from truesky.render.sources.source_list import Sources

# Codes of `method` in the table `rendered_truth`.
POINT, PROFILE, PICTURE, TRAIL = 0, 1, 2, 3


def truth(rendered: RenderedDetector) -> pa.Table:
    """Return one row of `rendered_truth` per drawn source, sorted by id."""
    sources, n, (psf_x, psf_y) = rendered.sources, len(rendered.sources), _centroids(rendered)
    trail = np.zeros((n, 2)) if sources.trail is None else sources.trail
    return RENDERED_TRUTH.build(
        {
            "exposure_id": np.full(n, rendered.exposure.exposure_id, np.int64),
            "detector": [rendered.detector.name] * n,
            "id": sources.ids,
            "x": sources.column,
            "y": sources.row,
            "expected": sources.electrons,
            "drawn": rendered.drawn_electrons,
            "stamp": rendered.sizes,
            "method": _methods(sources),
            "trail_x": trail[:, 0],
            "trail_y": trail[:, 1],
            "psf_x": psf_x,
            "psf_y": psf_y,
            "mag": _magnitudes(rendered),
        }
    )


def _centroids(rendered: RenderedDetector) -> tuple[Float | None, Float | None]:
    """Return the PSF centroid of each source's colour, pixels from its position; None without PSF or with spectra."""
    sources, psf = rendered.sources, rendered.psf
    if psf is None or rendered.spectra is not None:
        return None, None
    return centroids.offsets(psf, transfer.basis_weights(psf, sources.photons, sources.column, sources.row))


def _magnitudes(rendered: RenderedDetector) -> Float:
    """Return the magnitudes for zero point and exposure time of the header; masked if no electrons are expected."""
    electrons = rendered.sources.electrons
    shines = electrons > 0.0
    rate = np.where(shines, electrons, 1.0) / rendered.scene.exposure_time_s
    return np.ma.masked_array(rendered.zero_point - 2.5 * np.log10(rate), ~shines)


def spectra(rendered: RenderedDetector) -> pa.Table | None:
    """Return one row of `rendered_spectra` per source and order with light on the detector, or None without a grism."""
    if rendered.spectra is None:
        return None
    n = len(rendered.spectra["id"])
    return RENDERED_SPECTRA.build(
        {
            "exposure_id": np.full(n, rendered.exposure.exposure_id, np.int64),
            "detector": [rendered.detector.name] * n,
            **rendered.spectra,
        }
    )


def _methods(sources: Sources) -> Int:
    pictured = np.zeros(len(sources), bool) if sources.picture is None else sources.picture >= 0
    method = np.where(sources.shape >= 0, PROFILE, np.where(pictured, PICTURE, POINT))
    return np.where(sources.trail_length > 0, TRAIL, method)
