"""Draw the light curves of all types of supernovae for docs/supernovae.md.

python -m scripts.supernova_picture docs/supernovae.jpg
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from truesky.cosmology import FIDUCIAL
from truesky.fluxes import passbands
from truesky.variability import supernova_light, supernova_templates
from truesky.variability.supernova_light import Supernovae
from truesky.variability.supernova_templates import KINDS

BANDS = {"lsst_g": "tab:blue", "lsst_r": "tab:green", "lsst_i": "tab:orange", "euclid_j": "tab:red"}
# Redshift of the supernovae, and absolute AB magnitude in B at the peak of each type.
Z, PEAKS = 0.15, {"Ia": -19.2, "II-P": -16.8, "II-L": -18.1, "IIn": -18.6, "IIb": -17.1, "Ib": -17.5, "Ic": -17.7}


def main(path: Path) -> None:
    """Draw one panel per type."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    templates, days = supernova_templates.templates(), np.arange(-25.0, 230.0)
    distance = float(FIDUCIAL.distance_modulus(Z)) - 5.0 * np.log10(FIDUCIAL.h)
    figure, panels = plt.subplots(2, 4, figsize=(12, 5.6), sharex=True, sharey=True, layout="constrained")
    for panel, (name, code) in zip(panels.ravel(), KINDS.items(), strict=False):
        supernova = Supernovae(
            np.array([code]), *(np.array([value]) for value in (Z, 0.0, PEAKS[name] + distance, 1.0, 0.0, 1.0, 0.0))
        )
        for band, colour in BANDS.items():
            flux = supernova_light.fluxes(supernova, passbands.load(band), days[None], templates)[0]
            shines = flux > 0.0
            panel.plot(days[shines], 23.9 - 2.5 * np.log10(flux[shines]), color=colour, label=band)
        panel.set_title(f"type {name}", fontsize=10)
    panels[0, 0].set_ylim(28.5, 19.0)
    panels[0, 0].legend(fontsize=8, loc="upper right")
    panels[1, 3].axis("off")
    figure.supxlabel(f"days after the peak in the rest-frame B, as observed at z = {Z:g}", fontsize=10)
    figure.supylabel("AB magnitude", fontsize=10)
    figure.savefig(path, dpi=100, pil_kwargs={"quality": 88})


if __name__ == "__main__":
    main(Path(sys.argv[1]))
