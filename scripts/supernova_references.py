"""Print magnitudes of type Ia supernovae from sncosmo, with which the tests compare truesky.

    python -m scripts.supernova_references hsiao.h5 > tests/truesky/variability/supernova_references.csv

The package sncosmo must be installed; its version is in the first line of the file. hsiao.h5 is the file from which
scripts/supernova_template.py makes the table of truesky. sncosmo interpolates spectra by cubic splines, and computes
integrals, dust and redshifts independently. It gets the responses of the passbands of truesky.
"""

from __future__ import annotations

import csv
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np

from truesky.fluxes import passbands
from truesky.variability.supernova_templates import PEAK_BAND

BANDS, COUNT, SEED = ("euclid_vis", "euclid_j", "lsst_g", "lsst_r", "lsst_z"), 100, 5
COLUMNS = ("z", "peak_mjd", "magnitude", "stretch", "ebv", "a_v", "band", "mjd", "mag")
# R_V of both laws of dust.
R_V = 3.1


def main(path: Path) -> None:
    """Print the table."""
    import extinction
    import h5py
    import sncosmo

    with h5py.File(path) as file:
        phase, wavelength, flux = (np.array(file[f"default/{name}"], float) for name in ("phase", "wave", "flux"))
    source = sncosmo.StretchSource(phase, wavelength, flux)
    effects = [sncosmo.OD94Dust(), sncosmo.OD94Dust()]
    model = sncosmo.Model(source, effects, ["host", "mw"], ["rest", "obs"])
    bands = {}
    for name in (PEAK_BAND, *BANDS):
        band = passbands.load(name)
        bands[name] = sncosmo.Bandpass(band.wavelength, band.response, name=name)
    middle = np.array([passbands.pivot_wavelength(passbands.load(PEAK_BAND))])
    k_middle = float(extinction.odonnell94(middle, R_V, R_V)[0])
    peak = source.peakmag(bands[PEAK_BAND], "ab")
    rng = np.random.default_rng(SEED)
    print(f"# sncosmo {version('sncosmo')}")
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(COLUMNS)
    written = 0
    while written < COUNT:
        z, stretch, ebv, a_v = (
            rng.uniform(0.02, 1.2),
            rng.uniform(0.8, 1.1),
            rng.uniform(-0.2, 0.4),
            rng.uniform(0, 0.5),
        )
        magnitude, age, band = rng.uniform(17.0, 25.0), rng.uniform(-12.0, 70.0), BANDS[rng.integers(len(BANDS))]
        amplitude = 10.0 ** (-0.4 * (magnitude - peak - k_middle * ebv))
        model.set(z=z, t0=60000.0, amplitude=amplitude, s=stretch, hostebv=ebv, hostr_v=R_V, mwebv=a_v / R_V, mwr_v=R_V)
        mjd = 60000.0 + age * (1.0 + z) * stretch
        mag = model.bandmag(bands[band], "ab", mjd)
        if np.isfinite(mag):
            row = (z, 60000.0, magnitude, stretch, ebv, a_v)
            writer.writerow([*(f"{value:.6f}" for value in row), band, f"{mjd:.6f}", f"{mag:.5f}"])
            written += 1


if __name__ == "__main__":
    main(Path(sys.argv[1]))
