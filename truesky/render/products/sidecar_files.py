"""Paths of the files that are stored with the images of a detector, relative to the folder of the table `products`."""

from __future__ import annotations


def spectra_file(exposure_id: int, detector: str) -> str:
    """Return the path of the Parquet table with the positions of spectra on a detector (rows of `rendered_spectra`)."""
    return f"spectra/{exposure_id:06d}/{detector}.parquet"


def truth_file(exposure_id: int, detector: str) -> str:
    """Return the path of the Parquet table of the sources drawn on a detector (rows of `rendered_truth`)."""
    return f"truth/{exposure_id:06d}/{detector}.parquet"


def psf_file(exposure_id: int, channel: str, band: str, detector: str) -> str:
    """Return the path of the PSFEx file with the PSF of an image, which lies in the same folder as the image.

    Parameters
    ----------
    exposure_id : int
        Number of the exposure.
    channel, band, detector : str
        Names of the image's channel, band and detector.

    Returns
    -------
    str
        Path relative to the folder of the stored version of the table `products`.
    """
    return f"images/{exposure_id:06d}/{channel}_{band}_{detector}.psf"
