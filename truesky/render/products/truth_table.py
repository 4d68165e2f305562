"""Make the tables `rendered_truth` (sources drawn on a detector) and `rendered_spectra` (spectra drawn on it)."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Float, Int
from lake_schema.tables.exposures import ExposureRow
from lake_schema.tables.rendered_truth import RENDERED_SPECTRA, RENDERED_TRUTH
from truesky.render.drawing import transfer
from truesky.render.exposure.rendered_detector import RenderedDetector
from truesky.render.psf import centroids
from truesky.render.psf.model import Psf
from truesky.render.sources.source_list import Sources

# Codes of the column `method` in the table `rendered_truth`, which tells how a source was drawn: as a point source, as
# a galaxy profile, from an image, or as the trail of a moving body.
POINT, PROFILE, PICTURE, TRAIL = 0, 1, 2, 3


def truth(rendered: RenderedDetector) -> pa.Table:
    """Return the rows of the table `rendered_truth` for a detector: one per drawn source, sorted by its identifier.

    A row has the position in pixels, the expected and drawn electrons, and the magnitude.
    """
    psf = None if rendered.spectra is not None else rendered.psf
    place = rendered.exposure, rendered.detector.name
    return rows_of_sources(*place, rendered.sources, rendered.sizes, rendered.drawn_electrons, psf)


def rows_of_sources(
    exposure: ExposureRow, detector: str, sources: Sources, sizes: Int, drawn_electrons: Float, psf: Psf | None
) -> pa.Table:
    """Return the rows of the table `rendered_truth` for n sources.

    Parameters
    ----------
    exposure : ExposureRow
        Row of the table `exposures`.
    detector : str
        Name of the detector.
    sources : Sources
        The sources.
    sizes : int array, shape (n,)
        Sides of their stamps, pixels.
    drawn_electrons : float64 array, shape (n,)
        Electrons of each source's stamp on the image.
    psf : Psf or None
        PSF, for the offsets of the light of each source from its position; None for spectra, which have none.

    Returns
    -------
    pyarrow.Table
        The rows, in the order of the sources.
    """
    n, psf_x, psf_y, window = len(sources), None, None, None
    if psf is not None:
        # The PSF of a source depends on its colour and its place.
        weights = transfer.basis_weights(psf, sources.photons, sources.column, sources.row)
        psf_x, psf_y = centroids.offsets(psf, weights)
        window = np.full(n, centroids.window_rms(psf))
    trail = np.zeros((n, 2)) if sources.trail is None else sources.trail
    return RENDERED_TRUTH.build(
        {
            "exposure_id": np.full(n, exposure.exposure_id, np.int64),
            "detector": [detector] * n,
            "id": sources.ids,
            "x": sources.column,
            "y": sources.row,
            "expected": sources.electrons,
            "drawn": drawn_electrons,
            "stamp": sizes,
            "method": _methods(sources),
            "trail_x": trail[:, 0],
            "trail_y": trail[:, 1],
            "psf_x": psf_x,
            "psf_y": psf_y,
            "psf_window": window,
            "mag": _magnitudes(sources.electrons, exposure),
        }
    )


def _magnitudes(electrons: Float, exposure: ExposureRow) -> Float:
    """Return the AB magnitudes that follow from the expected electrons, the zero point and the exposure time.

    They are masked for sources without expected electrons.
    """
    shines = electrons > 0.0
    rate = np.where(shines, electrons, 1.0) / exposure.exposure_time_s
    return np.ma.masked_array(exposure.zero_point - 2.5 * np.log10(rate), ~shines)


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
