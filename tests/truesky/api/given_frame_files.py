"""Small frames of a telescope with strong distortion, as FITS files for tests."""

import numpy as np
from astropy.io import fits

from lake_schema.fits import psfex
from truesky.render.camera import tpv

NX, NY, SCALE = 256, 240, 0.26
LINEAR = {
    "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CUNIT1": "deg", "CUNIT2": "deg", "CRVAL1": 150.0, "CRVAL2": 2.2,
    "CRPIX1": 130.0, "CRPIX2": 115.0, "CD1_1": -SCALE / 3600, "CD1_2": 3e-6, "CD2_1": 2.5e-6, "CD2_2": SCALE / 3600,
}  # fmt: skip
SIP = {
    **LINEAR, "CTYPE1": "RA---TAN-SIP", "CTYPE2": "DEC--TAN-SIP", "A_ORDER": 3, "B_ORDER": 3, "A_2_0": 4e-5,
    "A_1_1": -3e-5, "A_0_3": 2e-7, "B_0_2": 5e-5, "B_2_0": -2e-5, "B_3_0": 1e-7,
}  # fmt: skip
TPV = {keyword: value for keyword, value, _ in tpv.from_sip([(k, v, "") for k, v in SIP.items()])}
CALIBRATION = {"MAGZERO": 30.0, "GAIN": 2.0, "SATURATE": 60000.0}


def psf_file(folder, side=51, step=0.7, centre=(125.0, 118.0), span=(230.0, 220.0)):
    """Write a PSFEx file: a Moffat profile, whose width and ellipticity depend on the position on the frame."""
    y, x = (np.mgrid[:side, :side] - side // 2) * step
    taper = np.clip(1.3 - np.hypot(x, y) / (0.5 * side * step), 0.0, 0.3) / 0.3
    light = (1.0 + (x**2 + 1.1 * y**2) / 6.0) ** -3.0 * taper
    light /= light.sum()
    wider, longer = light * (x**2 + y**2 - 6.0) / 60.0, light * (x**2 - y**2) / 60.0
    planes = np.stack([light, wider, 0.3 * longer, longer, 0.2 * wider, -0.3 * longer])
    psfex.write(folder / "frame.psf", planes.astype(np.float32), step, 3.0, centre, span, float(planes[0].sum()))
    return folder / "frame.psf"


def frame_file(path, wcs=SIP, pixels=None, others=(), **cards):
    """Write a frame, by default of zeros; cards that are None are left out."""
    header = {key: value for key, value in {**wcs, **CALIBRATION, **cards}.items() if value is not None}
    pixels = np.zeros((NY, NX), np.float32) if pixels is None else pixels
    fits.HDUList([fits.PrimaryHDU(pixels, fits.Header(header)), *others]).writeto(path, overwrite=True)
    return path
