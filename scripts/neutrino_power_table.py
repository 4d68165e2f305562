"""Print the linear power spectrum of cold matter with massive neutrinos from CAMB, which tests use in place of CAMB.

    python -m scripts.neutrino_power_table > tests/truesky/catalogue/neutrino_power.csv

The cosmology is the fiducial one with `m_nu` = 0.06 eV. The package CAMB must be installed: pip install
'truesky[camb]'.
"""

from __future__ import annotations

from dataclasses import replace

from truesky.catalogue.matter import boltzmann
from truesky.cosmology import FIDUCIAL

M_NU = 0.06


def text() -> str:
    """Return the text of the file: the wave numbers of a table (h/Mpc), and P(k) in (Mpc/h)^3 at z = 0."""
    power = boltzmann.compute(replace(FIDUCIAL, m_nu=M_NU))["power"]
    rows = (f"{k:.6g},{value:.8e}" for k, value in zip(boltzmann.wave_numbers(), power, strict=True))
    return "\n".join(["k,power", *rows]) + "\n"


if __name__ == "__main__":
    print(text(), end="")
