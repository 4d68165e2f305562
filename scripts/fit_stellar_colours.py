"""Make truesky/fluxes/libraries/model_stars.csv: colours and bolometric corrections of model atmospheres.

    python scripts/fit_stellar_colours.py GRID [--out FILE]

GRID is a text table of mean surface fluxes f_lambda (erg s-1 cm-2 um-1) of model atmospheres in the passbands of
TITLES. Its first three columns are Teff, log g and [Fe/H]. One such table is model_grid_CK04.dat of astroARIADNE
(https://github.com/jvines/astroARIADNE, MIT licence). Logarithms of fluxes are interpolated linearly in ln Teff, log g
and [Fe/H].
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy.interpolate import RegularGridInterpolator

import lake_schema  # noqa: F401  (restricts numpy, imported later, to common CPU instructions)

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from lake_schema.arrays import Float
from lake_schema.units import LIGHT_ANGSTROM_S
from truesky.fluxes import passbands
from truesky.fluxes.libraries import model_stars

# Title of the column of GRID for each passband.
TITLES = {
    "sdss_u": "SDSS_u", "sdss_g": "SDSS_g", "bessell_v": "GROUND_JOHNSON_V", "sdss_r": "SDSS_r", "sdss_i": "SDSS_i",
    "sdss_z": "SDSS_z", "twomass_j": "2MASS_J", "twomass_h": "2MASS_H", "twomass_ks": "2MASS_Ks",
}  # fmt: skip
SOURCE = """# Model atmospheres of Castelli & Kurucz 2003 (IAU Symp. 210, A20; CK04), from mean fluxes in bands of
# astroARIADNE 1.5.2 (Vines & Jenkins 2022, MNRAS 513, 2719), which are Copyright (c) 2019 Jose Vines, MIT licence:
# https://github.com/jvines/astroARIADNE/blob/master/LICENSE.
# Made by scripts/fit_stellar_colours.py.  Bands: AB magnitude less that in bessell_v; bolometric_h: M_bol - M_H
# (AB)."""
# Luminosity of a star with absolute bolometric magnitude 0 (IAU 2015), erg/s.
_L0 = 3.0128e35
# Stefan-Boltzmann constant, erg s-1 cm-2 K-4.
_SIGMA = 5.670374419e-5
# Ten parsecs, cm.
_TEN_PC = 3.0856775814913673e19
# AB magnitude of f_nu = 1 erg s-1 cm-2 Hz-1, with the opposite sign.
_AB = 48.6
_ANGSTROM_PER_UM = 1e4


def read(path: Path) -> tuple[tuple[Float, Float, Float], Float]:
    """Read a grid of model atmospheres.

    Return its axes (Teff in K, log g, [Fe/H]; ascending) and ln f_nu (erg s-1 cm-2 Hz-1) with the axes [Teff, log g,
    [Fe/H], passband of TITLES]. Combinations that the grid does not contain are NaN.
    """
    with path.open(encoding="utf-8") as file:
        titles = file.readline().lstrip("#").split()
    table = np.loadtxt(path)
    axes = tuple(np.unique(table[:, k]) for k in range(3))
    at = tuple(np.searchsorted(axis, table[:, k]) for k, axis in enumerate(axes))
    out = np.full((*(axis.size for axis in axes), len(TITLES)), np.nan)
    for k, (band, title) in enumerate(TITLES.items()):
        pivot = passbands.pivot_wavelength(passbands.load(band))
        with np.errstate(divide="ignore"):
            out[(*at, k)] = np.log(table[:, titles.index(title)] / _ANGSTROM_PER_UM * pivot**2 / LIGHT_ANGSTROM_S)
    return axes, out


def main() -> int:
    """Run the command and return the exit status 0.

    SystemExit is raised if GRID lacks models around a combination of Teff, log g and [M/H] of the result. ValueError is
    raised if a combination lies outside the range of GRID.
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("grid", type=Path)
    parser.add_argument("--out", type=Path, default=model_stars.TABLE)
    options = parser.parse_args()
    (teff, log_g, metals), ln_f = read(options.grid)
    look_up = RegularGridInterpolator((np.log(teff), log_g, metals), ln_f)
    bands = list(TITLES)
    lines = [
        SOURCE,
        ",".join(["teff", "log_g", "metallicity", "bolometric_h", *(b for b in bands if b != "bessell_v")]),
    ]
    for t in model_stars.TEFF:
        for g in model_stars.LOG_G:
            for z in model_stars.METALLICITY:
                mags = -2.5 / np.log(10.0) * look_up((np.log(t), g, z))
                if not np.isfinite(mags).all():
                    raise SystemExit(f"{options.grid}: the grid has no model with {t:.0f} K, log g {g}, [M/H] {z}")
                v = mags[bands.index("bessell_v")]
                colors = [f"{m - v:.4f}" for b, m in zip(bands, mags, strict=True) if b != "bessell_v"]
                # Both magnitudes are for a star with a radius of 10 pc, whose flux at 10 pc is its surface flux. The
                # radius cancels in M_bol - M_H.
                m_bol = -2.5 * np.log10(4.0 * np.pi * _TEN_PC**2 * _SIGMA * t**4 / _L0)
                bolometric = m_bol - (mags[bands.index("twomass_h")] - _AB)
                lines.append(",".join([f"{t:.2f}", f"{g:g}", f"{z:g}", f"{bolometric:.4f}", *colors]))
    options.out.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
