"""Extract H alpha emitters from slitless spectra with published files only, as an observer would.

The folder of a sequence contains raw frames of the sky with their headers, flats, a dark, the PSFs of direct images (in
the format of PSFEx), the configuration of the grism in each exposure (in the format of grismconf), and a catalogue with
positions and sizes, as an observer measures them in direct images. Nothing is imported from truesky.
"""

from dataclasses import dataclass
from pathlib import Path

import galsim
import galsim.des
import grismconf
import numpy as np
from astropy.io import fits
from astropy.wcs import WCS
from scipy.ndimage import binary_dilation, median_filter, uniform_filter

# Rest wavelengths in vacuum, Angstrom, and the ratio of the [N II] lines: Storey & Zeippen 2000, MNRAS 312, 813.
HALPHA, NII, NII_2, NII_RATIO = 6564.614, 6585.27, 6549.86, 3.05
# Velocity dispersion that is assumed for every galaxy, km/s. The simulated ones are 65 to 105 km/s, and the assumption
# raises fluxes by 1.3 %. With the true dispersions and radii, fluxes of bright lines are 0.2 +- 0.1 % too low.
DISPERSION, LIGHT = 100.0, 299_792.458
# Pivot wavelengths of the direct images, Angstrom: Euclid Collaboration: Schirmer et al. 2022, A&A 662, A92.
PIVOTS = {"euclid_j": 13_670.0, "euclid_h": 17_710.0}
# Side of a model image in pixels, samples per pixel, and half sides of the fitted box along and across the dispersion.
SIDE, FINE, ALONG, ACROSS = 32, 4, 12, 6
# Half-light radius of an exponential disc in units of its scale length.
HALF_LIGHT = 1.67835
# Largest ratio of the fluxes of [N II] 6585 and H alpha that a fit may have.
MOST_NII = 0.8
# Pixels between trial wavelengths of the search, and width of the median by which it removes continua.
STEP, MEDIAN = 0.5, 121


@dataclass(frozen=True)
class Frame:
    """Calibrated exposure: sky-subtracted electrons, usable pixels, noise of a pixel, and the geometry."""

    image: np.ndarray
    good: np.ndarray
    noise: float
    seconds: float
    wcs: WCS
    border: int
    grism: grismconf.Config


def read(path):
    """Return the electrons inside the reference border, pixels with a bad fit of the ramp, the cards, and the WCS."""
    with fits.open(path) as units:
        cards, pixels, quality = units[0].header + units[1].header, units[1].data, units[2].data
        system = WCS(units[1].header)
    inside = (slice(cards["REFPIX"], -cards["REFPIX"]),) * 2
    electrons = (pixels[inside].astype(float) - cards["BIAS"]) * cards["GAIN"]
    return electrons, quality[inside] > cards["QUALLIM"], cards, system


def response_of(paths):
    """Return the response of pixels relative to their surroundings, from the mean of flats; 1 without flats."""
    if not paths:
        return 1.0
    flat = np.median([read(path)[0] for path in paths], axis=0)
    filled = np.where(np.abs(flat / np.median(flat) - 1.0) < 0.5, flat, np.median(flat))
    return flat / uniform_filter(filled, 65, mode="nearest")


def frames(folder):
    """Return the calibrated exposures of a folder."""
    response = response_of(sorted(folder.glob("flat*.fits")))
    hot = np.zeros(1, bool)
    for path in folder.glob("dark*.fits"):
        dark, hit, *_ = read(path)
        hot = (np.abs(dark - np.median(dark)) > 50.0) & ~hit
    found = []
    for path in sorted(folder.glob("sky*.fits")):
        electrons, hit, cards, system = read(path)
        image = electrons / response
        # Pixels beside a cosmic ray or a hot pixel share its charge.
        bad = binary_dilation(hit | hot, np.ones((3, 3))) | (np.abs(np.broadcast_to(response, image.shape) - 1.0) > 0.3)
        sky = np.median(image[~bad])
        noise = 1.4826 * np.median(np.abs(image[~bad] - sky))
        grism = grismconf.Config(str(folder / f"{path.stem.replace('sky', 'grism')}.conf"))
        found.append(Frame(image - sky, ~bad, noise, cards["EXPTIME"], system, cards["REFPIX"], grism))
    return found


class Models:
    """Images of emission lines of exponential discs, with the PSF of the direct images at their wavelength."""

    def __init__(self, folder, scale=0.3):
        self.scale, self.psfs = scale, {}
        frequency = np.fft.fftfreq(SIDE * FINE, 1.0 / FINE), np.fft.rfftfreq(SIDE * FINE, 1.0 / FINE)
        self.ky, self.kx = (2.0 * np.pi * part for part in (frequency[0][:, None], frequency[1]))
        for band in PIVOTS:
            (path,) = folder.glob(f"*{band}*.psf")
            star = galsim.des.DES_PSFEx(str(path))
            header = fits.getheader(path, 1)
            middle = galsim.PositionD(header["POLZERO1"], header["POLZERO2"])
            image = galsim.ImageD(SIDE * FINE, SIDE * FINE, scale=1.0 / FINE)
            star.getPSF(middle).drawImage(image, method="no_pixel", offset=(0.5, 0.5))
            light = header["PSFLIGHT"] * image.array
            self.psfs[band] = np.fft.rfft2(np.fft.ifftshift(light)) * self._coupling(folder)

    def _coupling(self, folder):
        """Return the transform of the coupling of neighbouring pixels, which the PSF of a direct image lacks."""
        side, diagonal = np.loadtxt(folder / "ipc.csv", delimiter=",", skiprows=1)
        cosines = np.cos(self.kx), np.cos(self.ky)
        return 1.0 + 2.0 * side * (cosines[0] + cosines[1] - 2.0) + 4.0 * diagonal * (cosines[0] * cosines[1] - 1.0)

    def transform(self, wavelength, radius, along):
        """Return the transform of a line of one electron; `radius` in arcsec, `along` in pixels per Angstrom (x, y)."""
        blue, red = PIVOTS["euclid_j"], PIVOTS["euclid_h"]
        # The peak of a diffraction pattern is proportional to wavelength^-2.
        share = (wavelength**-2 - red**-2) / (blue**-2 - red**-2)
        psf = share * self.psfs["euclid_j"] + (1.0 - share) * self.psfs["euclid_h"]
        length = radius / self.scale / HALF_LIGHT
        disc = (1.0 + (self.kx**2 + self.ky**2) * length**2) ** -1.5
        width = wavelength * DISPERSION / LIGHT * (along[0] * self.kx + along[1] * self.ky)
        return psf * disc * np.exp(-0.5 * width**2)

    def image(self, transform, x, y):
        """Return the image float[SIDE, SIDE] of a transform, with its centre (x, y) pixels from pixel SIDE / 2."""
        fine = np.fft.irfft2(transform * np.exp(-1j * (self.kx * x + self.ky * y)), (SIDE * FINE, SIDE * FINE))
        return np.fft.fftshift(fine)[::FINE, ::FINE] * FINE**2


class Emitter:
    """A source of the catalogue on all exposures: its traces, and the fits of its lines."""

    def __init__(self, row, exposures, models):
        self.radius, self.models, self.exposures = row["radius"], models, exposures
        self.places = []
        for one in exposures:
            x, y = one.wcs.all_world2pix(row["ra"], row["dec"], 0)
            self.places.append((float(x) - one.border, float(y) - one.border))
        self.ends = exposures[0].grism.DISPL("+1", *self.places[0], np.array([0.0, 1.0]))

    def trace(self, number, wavelength):
        """Return the positions x, y of light of a wavelength in an exposure, 0-based pixels."""
        grism, (x, y) = self.exposures[number].grism, self.places[number]
        t = (np.asarray(wavelength) - self.ends[0]) / (self.ends[1] - self.ends[0])
        return x + grism.DISPX("+1", x, y, t), y + grism.DISPY("+1", x, y, t)

    def electrons(self, number, wavelength):
        """Return the electrons of a line of 1 erg s-1 cm-2 in an exposure."""
        one = self.exposures[number]
        return one.grism.SENS["+1"](wavelength) * one.seconds

    def transform(self, number, wavelength):
        x, y = self.trace(number, np.array([wavelength - 10.0, wavelength + 10.0]))
        return self.models.transform(wavelength, self.radius, (np.diff(x)[0] / 20.0, np.diff(y)[0] / 20.0))

    def search(self):
        """Return the wavelength of the most significant peak of a matched filter along the traces."""
        length = abs(np.diff(self.trace(0, self.ends)[0])[0])
        waves = np.linspace(*self.ends, int(length / STEP))
        total, weight = np.zeros(len(waves)), np.zeros(len(waves))
        for number, one in enumerate(self.exposures):
            shape = self.models.image(self.transform(number, 15_500.0), 0.0, 0.0)
            half = SIDE // 2
            shape = shape[half - 4 : half + 5, half - 4 : half + 5]
            x, y = (np.rint(part).astype(int) for part in self.trace(number, waves))
            ny, nx = one.image.shape
            inside = (x > 20) & (x < nx - 21) & (y > 8) & (y < ny - 9)
            around = np.arange(-4, 5)
            rows = np.where(inside, y, 20)[:, None, None] + around[:, None]
            columns = np.where(inside, x, 30)[:, None, None] + around
            good = one.good[rows, columns]
            light = (good * one.image[rows, columns] * shape).sum(axis=(1, 2))
            square = (good * shape**2).sum(axis=(1, 2))
            # Continua are removed before the exposures are added.
            level = median_filter(light / np.maximum(square, 1e-9), MEDIAN, mode="nearest")
            scale = self.electrons(number, waves)
            usable = inside & (square > 0.5 * (shape**2).sum()) & (scale > 0.2 * scale.max())
            total += np.where(usable, scale * (light - level * square), 0.0) / one.noise**2
            weight += np.where(usable, scale**2 * square, 0.0) / one.noise**2
        return float(waves[np.argmax(total / np.sqrt(np.maximum(weight, 1e-300)))])

    def normal(self, z):
        """Return the normal equations for the fluxes of H alpha and [N II] at a redshift, without nuisances."""
        matrix, vector = np.zeros((2, 2)), np.zeros(2)
        for number, one in enumerate(self.exposures):
            wavelength = HALPHA * (1.0 + z)
            x, y = (float(part) for part in self.trace(number, wavelength))
            column, row = round(x), round(y)
            ny, nx = one.image.shape
            if not (ALONG <= column < nx - ALONG and ACROSS <= row < ny - ACROSS):
                continue
            transform, half = self.transform(number, wavelength), SIDE // 2
            box = np.s_[half - ACROSS : half + ACROSS + 1, half - ALONG : half + ALONG + 1]
            images = []
            for rest, ratio in ((HALPHA, 1.0), (NII, 1.0), (NII_2, 1.0 / NII_RATIO)):
                at = self.trace(number, rest * (1.0 + z))
                shape = self.models.image(transform, float(at[0]) - column, float(at[1]) - row)
                images.append(ratio * self.electrons(number, rest * (1.0 + z)) * shape[box])
            lines = np.stack([images[0].ravel(), (images[1] + images[2]).ravel()])
            cut = np.s_[row - ACROSS : row + ACROSS + 1, column - ALONG : column + ALONG + 1]
            good = one.good[cut].ravel()
            basis = self._smooth(number, transform, (x, y), (column, row))[:, good]
            data = one.image[cut].ravel()[good]
            orthogonal, _ = np.linalg.qr(basis.T)
            free = lines[:, good] - (lines[:, good] @ orthogonal) @ orthogonal.T
            matrix += free @ free.T / one.noise**2
            vector += free @ data / one.noise**2
        return matrix, vector

    def _smooth(self, number, transform, centre, corner):
        """Return the light that is fitted with the lines: the source's continuum with a slope, and a background."""
        columns = np.arange(-ALONG, ALONG + 1) + corner[0]
        rows = np.arange(-ACROSS, ACROSS + 1)[:, None] + corner[1]
        # Profile across the trace: sum of the model image along it, in fine steps.
        profile = np.fft.fftshift(np.fft.irfft(transform[: SIDE * FINE // 2 + 1, 0], SIDE * FINE)) * FINE
        ends = self.trace(number, np.array([-150.0, 150.0]) + HALPHA * (1.0 + 1.2))
        slope = np.diff(ends[1])[0] / np.diff(ends[0])[0]
        offset = rows - (centre[1] + slope * (columns - centre[0]))
        own = np.interp(offset, (np.arange(SIDE * FINE) - SIDE * FINE // 2) / FINE, profile)
        step = np.broadcast_to((columns - corner[0]) / ALONG, own.shape)
        tilt = np.broadcast_to((rows - corner[1]) / ACROSS, own.shape)
        return np.stack([part.ravel() for part in (own, own * step, np.ones(own.shape), tilt)])

    def fluxes(self, z):
        """Return the improvement of chi^2, the fluxes of H alpha and [N II] 6585, and the error of H alpha."""
        matrix, vector = self.normal(z)
        if matrix[0, 0] == 0.0:
            return 0.0, 0.0, 0.0, np.inf
        flux = np.linalg.solve(matrix, vector)
        if not 0.0 <= flux[1] <= MOST_NII * flux[0]:
            # Fit one amplitude at the closest allowed ratio.
            ratio = 0.0 if flux[1] < 0.0 else MOST_NII
            mix = np.array([1.0, ratio])
            flux = mix * float(mix @ vector) / float(mix @ matrix @ mix)
        error = float(np.linalg.inv(matrix)[0, 0] ** 0.5)
        return float(2.0 * vector @ flux - flux @ matrix @ flux), *(float(part) for part in flux), error

    def fit(self):
        """Return redshift, fluxes of H alpha and [N II] 6585, and the error of H alpha: the maximum of likelihood."""
        z, step = self.search() / HALPHA - 1.0, 13.4 / HALPHA
        trials = z + step * np.arange(-3.0, 3.5, 0.5)
        better = [self.fluxes(one)[0] for one in trials]
        z = trials[int(np.argmax(better))]
        for width in (0.25 * step, 0.06 * step):
            low, middle, high = (self.fluxes(z + side * width)[0] for side in (-1.0, 0.0, 1.0))
            bend = low - 2.0 * middle + high
            z += width * float(np.clip(0.5 * (low - high) / bend, -1.5, 1.5)) if bend < 0.0 else 0.0
        return z, *self.fluxes(z)[1:]


def extract(folder: Path):
    """Return redshift, flux of H alpha, flux of [N II] 6585 (erg s-1 cm-2) and error of H alpha per catalogue row."""
    catalogue = np.genfromtxt(folder / "catalogue.csv", delimiter=",", names=True)
    exposures, models = frames(folder), Models(folder)
    found = [Emitter(row, exposures, models).fit() for row in np.atleast_1d(catalogue)]
    return np.array(found).T
