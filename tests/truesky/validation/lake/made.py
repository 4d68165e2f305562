"""Synthetic frames from a few lines of arithmetic, so that the results of checks are known beforehand."""

import numpy as np
import scipy.stats
from astropy.wcs import WCS
from scipy.special import erf

from lake_schema.fits import images
from truesky.validation.lake.measure import frame_context
from truesky.validation.lake.measure.references import Reference
from truesky.validation.lake.measure.rows import Place

SIDE, PRESCAN, OVERSCAN = 512, 8, 24
SCALE, FWHM, SECONDS, ZERO_POINT, SKY, DARK = 0.1, 0.17, 565.0, 25.9, 0.22, 0.0
GAIN, NOISE, BIAS, FULL = 3.4, 4.4, 1000.0, 1.5e5
HITS = 0.02


def system(shift=(0.0, 0.0), ra=10.0, dec=-20.0, side=2 * SIDE, stretch=1.0):
    """Return a simple projection whose header is wrong by a shift (pixels) and a stretch (factor)."""
    out = WCS(naxis=2)
    out.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    out.wcs.crval = [ra, dec]
    out.wcs.crpix = [side / 2 + 0.5 + shift[0], side / 2 + 0.5 + shift[1]]
    out.wcs.cd = stretch * SCALE / 3600.0 * np.array([[-1.0, 0.0], [0.0, 1.0]])
    return out


def scene(rng, n=160, faintest=21.0, side=2 * SIDE):
    """Return isolated stars on a jittered lattice."""
    per = int(np.ceil(np.sqrt(n)))
    step = (side - 80) / per
    x, y = (axis.ravel()[:n] for axis in np.meshgrid(*[40 + step * (np.arange(per) + 0.5)] * 2))
    x, y = (axis + 0.25 * step * (rng.random(n) - 0.5) for axis in (x, y))
    mag = 18.9 + (faintest - 18.9) * rng.random(n)
    # Some of the stars must saturate.
    mag[:12] = 14.0
    return known(x, y, mag)


def known(x, y, mag, seconds=SECONDS):
    """Return reference data of points, as from the tables of a lake."""
    n = len(x)
    ra, dec = system().all_pix2world(x, y, 0)
    electrons = seconds * 10 ** (-0.4 * (mag - ZERO_POINT))
    still, ids = np.zeros(n), (5 << 60) + np.arange(n)
    return Reference(ids, x, y, electrons, np.ones(n, bool), still, still.copy(), ra, dec, mag)


def light(of, side=2 * SIDE, fwhm=FWHM / SCALE, round_=1.0):
    """Return expected e- of points, each a Gaussian averaged over pixels; `round_` is the ratio of height to width."""
    out = np.zeros((side, side))
    sigma = np.sqrt(max(fwhm**2 - 0.7, 0.2)) / 2.3548
    edge = np.arange(-24, 26) - 0.5
    for x, y, flux in zip(of.x, of.y, of.expected, strict=True):
        i, j = round(x), round(y)
        across, up = (
            np.diff(0.5 * erf((edge - (place - middle)) / (np.sqrt(2) * sigma * factor)))
            for place, middle, factor in ((x, i, 1.0), (y, j, round_))
        )
        out[j - 24 : j + 25, i - 24 : i + 25] += flux * np.outer(up, across)
    return out


def hit(rng, image, part=HITS):
    """Add tracks of eight pixels along rows, with 1,500 e- each."""
    out, n = image.copy(), int(part * image.size / 8)
    for y, x in zip(rng.integers(0, image.shape[0], n), rng.integers(0, image.shape[1] - 8, n), strict=True):
        out[y, x : x + 8] += 1500.0
    return out


def vis_file(path, electrons, rng, shift=(0.0, 0.0), told=GAIN, read=GAIN, noise=NOISE, zero_point=ZERO_POINT):
    """Write a raw file of four quadrants with prescan and overscan, and return its path.

    `electrons` contains the counted electrons of each pixel. `shift` is the error of the header's WCS. `told` is the
    gain in the header, and `read` is the true gain.
    """
    cards = {
        "CHANNEL": "VIS", "IMAGETYP": "science", "EXPTIME": SECONDS, "PIXSCALE": SCALE, "PSFFWHM": FWHM,
        "FILTER": "euclid_vis", "ZEROPNT": zero_point, "SKYRATE": SKY, "DARKRATE": DARK, "DETECTOR": "1-1",
    }  # fmt: skip
    units, place = [image(None, cards)], system(shift)
    for name, (row, column) in {"E": (0, 0), "F": (0, 1), "G": (1, 1), "H": (1, 0)}.items():
        part = electrons[row * SIDE : (row + 1) * SIDE, column * SIDE : (column + 1) * SIDE]
        whole = np.pad(part, ((0, 0), (PRESCAN, OVERSCAN)))
        adu = np.floor(BIAS + np.minimum(whole + noise * rng.standard_normal(whole.shape), FULL) / read + 0.5)
        x0, y0 = column * SIDE, row * SIDE
        own = {
            **placed(place, PRESCAN - x0, -y0),
            "GAIN": told, "RDNDRAWN": NOISE, "BIAS": BIAS, "SATURATE": BIAS + 0.99 * FULL / told, "BUNIT": "adu",
            "DATASEC": f"[{PRESCAN + 1}:{PRESCAN + SIDE},1:{SIDE}]",
            "BIASSEC": f"[{PRESCAN + SIDE + 1}:{PRESCAN + SIDE + OVERSCAN},1:{SIDE}]",
            "CCDSEC": f"[{x0 + 1}:{x0 + SIDE},{y0 + 1}:{y0 + SIDE}]",
        }  # fmt: skip
        units.append(image(np.clip(adu, 0, 65535).astype(np.uint16), own, f"1-1.{name}"))
    images.write_images(path, units)
    return path


def image(data, cards, name=""):
    """Return a unit of a FITS file."""
    return images.Image(data, tuple((key, value, "") for key, value in cards.items()), name)


def placed(place, x=0, y=0):
    """Return WCS cards of pixels that begin at an offset in an array."""
    cards = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CUNIT1": "deg", "CUNIT2": "deg"}
    for i in (0, 1):
        cards |= {f"CRVAL{i + 1}": float(place.wcs.crval[i]), f"CRPIX{i + 1}": float(place.wcs.crpix[i]) + (x, y)[i]}
        cards |= {f"CD{i + 1}_{j + 1}": float(place.wcs.cd[i][j]) for j in (0, 1)}
    return cards


def vis(folder, rng=None, of=None, hits=HITS, sky=SKY, stretched=1.0, bright=1.0, **wrong):
    """Return the context of a VIS frame, and its stars; `wrong` contains arguments of `vis_file`."""
    rng = np.random.default_rng(3) if rng is None else rng
    of = scene(rng) if of is None else of
    expected = light(of, round_=stretched) * bright + sky * SECONDS
    counted = hit(rng, rng.poisson(expected).astype(float), hits)
    path = vis_file(folder / "vis.fits", counted, rng, **wrong)
    return frame_context.measure_frame(path, Place("VIS", "euclid_vis", 1, "1-1"), of), of


def ramp_file(path, chi2, channel="NISP-S", border=4):
    """Write the signal of a ramp, a constant sky, and its chi^2."""
    ny, nx = chi2.shape
    cards = {
        "CHANNEL": channel, "IMAGETYP": "science", "EXPTIME": 549.6, "ELAPTIME": 573.0, "PIXSCALE": 0.3, "NG": 15,
        "PSFFWHM": 0.33, "NR": 16, "ND": 11, "ZEROPNT": 25.0, "SKYRATE": 1.0, "DARKRATE": 0.02,
        "QUALLIM": float(scipy.stats.chi2.isf(1e-3, 13)), "BIAS": 1024.0,
    }  # fmt: skip
    units = [image(None, cards)]
    own = {
        **placed(system()), "GAIN": 1.92, "RDNDRAWN": 8.0, "SATURATE": 60000.0, "BUNIT": "adu",
        "DATASEC": f"[{border + 1}:{border + nx},{border + 1}:{border + ny}]", "CCDSEC": f"[1:{nx},1:{ny}]",
    }  # fmt: skip
    for name, plane in (("SCI", np.full(chi2.shape, 1300, np.uint16)), ("CHI2", chi2.astype(np.uint8))):
        units.append(image(np.pad(plane, border), own, f"DET11.{name}"))
    images.write_images(path, units)
    return path


def verdicts(check, of):
    """Return verdicts by quantity."""
    return {row.quantity: row.verdict for row in check.run(of)}
