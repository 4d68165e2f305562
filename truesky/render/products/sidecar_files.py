"""Paths of the sidecar files in a version of `products`, relative to the version."""

from __future__ import annotations


def spectra_file(exposure_id: int, detector: str) -> str:
    """Return the path of the table with the positions of spectra on a detector."""
    return f"spectra/{exposure_id:06d}/{detector}.parquet"


def truth_file(exposure_id: int, detector: str) -> str:
    """Return the path of the table of the sources drawn on a detector."""
    return f"truth/{exposure_id:06d}/{detector}.parquet"


def psf_file(exposure_id: int, channel: str, band: str, detector: str) -> str:
    """Return the path of the PSF that was used for a detector, in the folder of its images.

    Parameters
    ----------
    exposure_id : int
        Number of the exposure.
    channel, band, detector : str
        Names of the image's channel, band and detector.

    Returns
    -------
    str
        Path relative to the version of `products`.
    """
    return f"images/{exposure_id:06d}/{channel}_{band}_{detector}.psf"
