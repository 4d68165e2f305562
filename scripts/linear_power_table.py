"""Write the shipped table of the linear power spectrum of the fiducial cosmology, which CAMB computes.

    python -m scripts.linear_power_table > truesky/catalogue/linear_power.toml

The package CAMB must be installed: pip install 'truesky[camb]'.
"""

from __future__ import annotations

from importlib.metadata import version

from truesky.catalogue.matter import boltzmann
from truesky.cosmology import FIDUCIAL

_HEAD = """# Linear power spectrum of matter at z = 0 of the fiducial cosmology (FIDUCIAL in truesky/cosmology.py).
# Written by scripts/linear_power_table.py; do not edit.

[camb]
source = "CAMB {version} (Lewis, Challinor & Lasenby 2000, ApJ 538, 473), scaled to sigma_8 = {sigma_8}"
# P(k) in (Mpc/h)^3 at {nodes} wave numbers from {first:g} to {last:g} h/Mpc, uniform in ln k.
power = ["""
# Number of values in a line of the file.
_COLUMNS = 8


def text() -> str:
    """Return the text of the file linear_power.toml."""
    first, last = boltzmann.K_RANGE
    head = _HEAD.format(
        version=version("camb"), sigma_8=FIDUCIAL.sigma_8, nodes=boltzmann.K_NODES, first=first, last=last
    )
    values = [f"{value:.8e}" for value in boltzmann.compute(FIDUCIAL)["power"]]
    rows = [", ".join(values[i : i + _COLUMNS]) for i in range(0, len(values), _COLUMNS)]
    return "\n".join([head, *(f"    {row}," for row in rows), "]"]) + "\n"


if __name__ == "__main__":
    print(text(), end="")
