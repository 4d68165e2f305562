"""Emission lines on noisy frames of NISP-S: drawn by the channel, and measured by weighted sums of pixels."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import scipy.fft
from scipy.ndimage import convolve

from lake_schema import units
from tests.truesky.render import fields, infrared, spectroscopic
from tests.truesky.render.spectroscopic import MISSION, TIME
from truesky.fluxes import passbands, wavelength_windows
from truesky.fluxes.libraries import templates
from truesky.fluxes.sources import galaxies_from_table
from truesky.randomness import rng
from truesky.render.channels import registry
from truesky.render.effects.effect import apply_all
from truesky.render.exposure.rendered_detector import random_identity
from truesky.render.sources import colours

BAND = passbands.load("nisp_red")
CHANNEL = registry.CHANNELS["NISP-S"]
HALPHA = 6564.614
# Effects that an observer has corrected, or masks.
CLEAN = dict.fromkeys(("ramp_cosmic_rays", "dark_map", "pixel_response", "output_gain"), False)
# Half of the side of a box around a line, pixels.
HALF = 12
OUTPUTS, FOLLOWED = 32, 64


@dataclass(frozen=True)
class Lines:
    """H alpha lines of n galaxies: wavelength (A), flux (erg s-1 cm-2) and half-light radius (arcsec), all [n].

    `nii` is the flux of [N II] 6585 relative to H alpha, [n] or a number.
    """

    wavelength: np.ndarray
    flux: np.ndarray
    radius: np.ndarray
    nii: np.ndarray | float = 0.0


def trace(detector, grism, angle, number=1):
    """Return the trace of the first order of an exposure."""
    row = fields.exposure(**spectroscopic.exposed(detector, grism, angle, number=number))
    return next(one for one in CHANNEL.dispersion.traces(row, detector, MISSION, infrared.SEED) if one.order == 1)


def grid(detector, step):
    """Return columns and rows [2, n], every `step` pixels of a detector, at which lines do not overlap."""
    places = [np.arange(step, n - step, step, dtype=float) for n in (detector.nx, detector.ny)]
    return np.stack(np.meshgrid(*places)).reshape(2, -1)


def undispersed(path, wavelength, at):
    """Return the positions [2, n] of galaxies whose lines are at columns and rows [2, n]."""
    found = at.copy()
    for _ in range(4):
        for i, (column, row) in enumerate(found.T.tolist()):
            x, y = path.offsets(column, row, wavelength[i])
            found[:, i] = at[:, i] - (float(x), float(y))
    return found


def exposure(lines, places, detector, shining=True, forced=CLEAN, **columns):
    """Render the spectra of galaxies on a detector, with or without their lines; their continua have about 24 mag.

    `forced` switches effects on and off.
    """
    n = len(lines.flux)
    body = {name: np.zeros(n) for name in colours.GALAXY_COLUMNS}
    body |= {
        "z_obs": lines.wavelength / HALPHA - 1.0, "mag_r01": np.full(n, 26.5), "abs_mag_r01": np.full(n, -20.0),
        "frac_1": np.ones(n), "sed_1": np.full(n, 8.0), "flux_halpha": lines.flux if shining else np.zeros(n),
        "flux_nii": lines.flux * lines.nii * shining,
        "disk_half_light_radius": lines.radius, "kind": np.zeros(n),
    }  # fmt: skip
    library = templates.galaxy_library()
    table = pa.table({**body, "id": np.arange(n)})
    spectra = wavelength_windows.galaxy_spectra(
        galaxies_from_table(table, library), int(BAND.wavelength[0]), len(BAND.wavelength), library
    )
    flux = np.array([passbands.ab_flux(BAND, BAND.wavelength, one) for one in spectra])
    mags = units.AB_UJY - 2.5 * np.log10(units.ujy_of_cgs(flux))
    return spectroscopic.rendered(mags, *places, detector=detector, body=body, forced=forced, **columns)


# ---------------------------------------------------------------------------------------------- noise


def kernel():
    """Return the coupling of pixels by inter-pixel capacitance in the mission, float64[3, 3]."""
    on = MISSION.value("nisp.ipc_spectroscopic")
    side, corner = on * MISSION.value("nisp.ipc.side"), on * MISSION.value("nisp.ipc.diagonal")
    out = np.array([[corner, side, corner], [side, 0.0, side], [corner, side, corner]])
    out[1, 1] = 1.0 - out.sum()
    return out


def ramp_variance(rates, numbers, ramps=6000):
    """Return the variances [n] (e-^2) of signals of ramps that collect `rates` e- per second, from simulated frames.

    The signal is the maximum-likelihood estimate from n differences of groups, whose noise depends on the signal (Kubik
    et al. 2016). Its variance is measured relative to the difference between the last and the first group, whose
    variance is known. Without this comparison, it would be uncertain by 2 % because there are few ramps.
    """
    groups, reads, drops = (
        int(MISSION.value(f"nisp.macc.spectroscopic.{name}")) for name in ("groups", "reads", "drops")
    )
    noise, n = MISSION.value("nisp.read_noise", "electron"), groups - 1
    a = 1.0 + (1.0 - reads**2) / (3.0 * reads * (reads + drops))
    beta = 2.0 * noise**2 / (reads * a)
    first = (reads + drops) * np.arange(groups)[:, None] + np.arange(reads)
    # Contribution of an electron to the difference between the last and first group, by the frame of its arrival.
    begin, *_, end = (np.arange(first[-1, -1] + 1)[:, None] <= group for group in first)
    weight = end.mean(axis=1) - begin.mean(axis=1)
    found = []
    for rate in rates * MISSION.value("nisp.frame_time", "s"):
        charge = numbers.poisson(rate, (ramps, len(weight))).cumsum(axis=1, dtype=np.int32)
        group = charge[:, first].mean(axis=2) + numbers.normal(0.0, noise / reads**0.5, (ramps, groups))
        square = ((np.diff(group, axis=1) + beta) ** 2).mean(axis=1)
        signal = n * (2.0 * square / (a + np.hypot(a, 2.0 * square**0.5)) - beta)
        known = rate * (weight**2).sum() + 2.0 * noise**2 / reads
        found.append(np.var(signal) / np.var(group[:, -1] - group[:, 0]) * known)
    return np.array(found)


class Noise:
    """Noise of the pixels of a frame: photons, shared among neighbours, reads, and drifts of the outputs."""

    def __init__(self, background, shape, numbers):
        """Compute the noise of a frame; `background` is the rate of sky and dark current (e- per second)."""
        rates = background * np.array([0.0, 1.0, 2.0, 4.0, 8.0])
        reads, *photons = ramp_variance(rates, numbers)
        self.reads, self.levels, self.photons = reads, rates * TIME, np.array([0.0, *(v - reads for v in photons)])
        self.background, self.shape, self.kernel = background * TIME, shape, kernel()
        self.drift = MISSION.value("nisp.drift_spectroscopic", "electron")
        # Column edges of the outputs. The pixels of an output, row by row, have 1/f noise that reference pixels miss.
        self.edges = np.linspace(0, shape[1], OUTPUTS + 1).astype(int)

    def photons_of(self, light):
        """Return the photon noise (variance, e-^2) of pixels with `light` electrons of sources."""
        return np.interp(light + self.background, self.levels, self.photons)

    def weights(self, template, light):
        """Return weights [ny, nx] of the pixels of a box. The weighted sum is the best measure of a template.

        The background in the box is constant. `light` contains the electrons of sources. Drifts are treated as white
        noise.
        """
        basis = np.stack([template.ravel(), np.ones(template.size)])
        scaled = basis / (self.photons_of(light) + self.reads + self.drift**2).ravel()
        return np.linalg.solve(scaled @ basis.T, scaled)[0].reshape(template.shape)

    def variance(self, weights, light, corner):
        """Return the variance of a weighted sum of the pixels of a box.

        `light` contains the electrons of sources in the box, and `corner` is the row and column of its first pixel.
        """
        seen = np.pad(weights, 1)
        own = convolve(seen, self.kernel, mode="constant")[1:-1, 1:-1]
        total = (own**2 * self.photons_of(light)).sum() + self.reads * (weights**2).sum()
        return total + self.drift**2 * self._drifts(weights, corner)

    def _drifts(self, weights, corner):
        """Return the variance of a weighted sum of pixels if the outputs drift by 1 e- rms."""
        (low, left), rows, total = corner, self.shape[0], 0.0
        for first, last in zip(self.edges[:-1], self.edges[1:], strict=True):
            begin, end = max(first, left), min(last, left + weights.shape[1])
            if begin >= end:
                continue
            stream = np.zeros((rows, last - first))
            stream[low : low + len(weights), begin - first : end - first] = weights[:, begin - left : end - left]
            size = scipy.fft.next_fast_len(stream.size, real=True)
            power, frequency = np.abs(scipy.fft.rfft(stream.ravel(), size)) ** 2, np.arange(size // 2 + 1)
            slowest = max(rows // FOLLOWED, 1)
            law = np.where(frequency >= slowest, 1.0 / np.maximum(frequency, 1), 0.0)
            share = np.where((frequency == size / 2) | (frequency == 0), 1.0, 2.0)
            total += (share * law * power).sum() / (share * law).sum()
        return total


# ---------------------------------------------------------------------------------------------- measuring


def measured(noisy, without, at, noise, images=1):
    """Return relative fluxes [images, n] of lines, and their expected errors [n], from weighted sums of pixels.

    The background is fitted with each line. `noisy` and `without` are exposures with and without the lines, whose pixel
    positions are `at` [2, n]. `images` is the number of images of the same light with independent noise.
    """
    shared = [convolve(one.noise_free.astype(float), noise.kernel) for one in (noisy, without)]
    seen = [
        infrared.electrons(noisy) - shared[1],
        *(_again(noisy, noisy.seed + k) - shared[1] for k in range(1, images)),
    ]
    template, found = shared[0] - shared[1], []
    for column, row in np.rint(at.T).astype(int).tolist():
        corner = row - HALF, column - HALF
        box = np.s_[corner[0] : row + HALF + 1, corner[1] : column + HALF + 1]
        light = noisy.noise_free[box].astype(float)
        weights = noise.weights(template[box], light)
        found.append([*((weights * one[box]).sum() for one in seen), noise.variance(weights, light, corner) ** 0.5])
    found = np.array(found).T
    return found[:-1], found[-1]


def _again(one, noise_seed):
    """Return the electrons [ny, nx] of the same light on the same detector, with noise of another seed."""

    def stream(effect):
        return rng.stream(*random_identity(effect, one.exposure, one.detector.name, one.seed, noise_seed))

    found, _ = apply_all(one.noise_free.astype(float), CHANNEL.effects["science"], one.scene, stream)
    readout = CHANNEL.readout.make_readout(found, one.scene, one.detector.name, one.wcs)
    return infrared.electrons(SimpleNamespace(science=readout.pixels, scene=one.scene))
