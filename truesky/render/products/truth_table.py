"""Make the tables `rendered_truth` (sources drawn on a detector) and `rendered_spectra` (spectra drawn on it)."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Float, Int
from lake_schema.tables.rendered_truth import RENDERED_SPECTRA, RENDERED_TRUTH
from truesky.render.drawing import transfer
from truesky.render.exposure.rendered_detector import RenderedDetector
from truesky.render.psf import centroids
from truesky.render.sources.source_list import Sources

# Codes of the column `method` in the table `rendered_truth`, which tells how a source was drawn: as a point source, as
# a galaxy profile, from an image, or as the trail of a moving body.
POINT, PROFILE, PICTURE, TRAIL = 0, 1, 2, 3


def truth(rendered: RenderedDetector) -> pa.Table:
    """Return the rows of the table `rendered_truth` for a detector: one per drawn source, sorted by its identifier.

    A row has the position in pixels, the expected and drawn electrons, and the magnitude.
    """
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
    """Return the offsets (columns, rows) in pixels of each source's light from its position, due to the PSF.

    The PSF is that for the colour and place of the source. Both results are None if there is no PSF, or for spectra.
    """
    sources, psf = rendered.sources, rendered.psf
    if psf is None or rendered.spectra is not None:
        return None, None
    return centroids.offsets(psf, transfer.basis_weights(psf, sources.photons, sources.column, sources.row))


def _magnitudes(rendered: RenderedDetector) -> Float:
    """Return the AB magnitudes that follow from the expected electrons, the zero point and the exposure time.

    They are masked for sources without expected electrons.
    """
    electrons = rendered.sources.electrons
    shines = electrons > 0.0
    rate = np.where(shines, electrons, 1.0) / rendered.scene.exposure_time_s
    return np.ma.masked_array(rendered.zero_point - 2.5 * np.log10(rate), ~shines)


def spectra(rendered: RenderedDetector) -> pa.Table | None:
    """Return the rows of the table `rendered_spectra`: one per source and spectral order with light on the detector.

    Return None for a detector without a grism.
    """
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
