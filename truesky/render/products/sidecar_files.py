"""Where a version of `products` keeps what lies beside its rows and images."""

from __future__ import annotations


def spectra_file(exposure_id: int, detector: str) -> str:
    """Where a version of `products` keeps where spectra lie on a detector."""
    return f"spectra/{exposure_id:06d}/{detector}.parquet"


def truth_file(exposure_id: int, detector: str) -> str:
    """Where a version of `products` keeps what was drawn on a detector."""
    return f"truth/{exposure_id:06d}/{detector}.parquet"


def psf_file(exposure_id: int, channel: str, band: str, detector: str) -> str:
    """Where a version of `products` keeps the PSF that a detector was drawn with, beside its images.

    exposure_id, channel, band, detector : of the image
    """
    return f"images/{exposure_id:06d}/{channel}_{band}_{detector}.psf"
