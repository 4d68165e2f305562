"""Draw supernovae of a lake at several dates for docs/supernovae.md.

    python -m scripts.changing_sky_picture LAKE OUT.jpg

Each row shows one supernova: LSST images (r) at four dates, the difference of the first two, and the light curve.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import truesky

# Days after the peak at which images are drawn, side of an image (arcsec), and number of supernovae.
DAYS, SIDE, COUNT, BAND = (-30.0, 0.0, 25.0, 60.0), 12.0, 3, "lsst_r"
_QUERY = """
SELECT t.id, t.ra, t.dec, t.peak_mjd, t.z_obs, t.type FROM transients t JOIN galaxy_fluxes f ON f.id = t.host_id
WHERE t.z_obs BETWEEN 0.1 AND 0.5 AND f.f_nu_lsst_r > 8 AND sqrt(t.offset_east^2 + t.offset_north^2) > 0.6
AND abs(t.ra - $ra) < 0.1 AND abs(t.dec - $dec) < 0.08 AND t.type = $type ORDER BY t.mag_b LIMIT 1
"""


def main(lake_path: Path, out: Path) -> None:
    """Draw the figure."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(COUNT, 6, figsize=(13, 6.6), layout="constrained", width_ratios=[1] * 5 + [1.7])
    with truesky.open(lake_path) as lake:
        middle = lake.sql("SELECT avg(ra) AS ra, avg(dec) AS dec FROM transients").iloc[0]
        place = {"ra": float(middle["ra"]), "dec": float(middle["dec"])}
        for row, kind in zip(panels, (1, 2, 4), strict=True):
            source = lake.sql(_QUERY, **place, type=kind).iloc[0]
            dates = source["peak_mjd"] + (1.0 + source["z_obs"]) * np.array(DAYS)
            images = [lake.render(source["ra"], source["dec"], SIDE, BAND, date=float(day)).electrons for day in dates]
            top = np.percentile(images[1], 99.7)
            for panel, image, day in zip(row[:4], images, DAYS, strict=True):
                panel.imshow(np.arcsinh(image / top * 20.0), origin="lower", cmap="gray", vmax=np.arcsinh(25.0))
                panel.set_title(f"{day:+.0f} d", fontsize=9)
            row[4].imshow(images[1] - images[0], origin="lower", cmap="RdBu_r", vmin=-0.3 * top, vmax=0.3 * top)
            row[4].set_title("peak less first", fontsize=9)
            for panel in row[:5]:
                panel.set_xticks([])
                panel.set_yticks([])
            days = np.linspace(-40.0, 120.0, 161)
            for band, colour in (("lsst_g", "tab:blue"), (BAND, "black"), ("euclid_h", "tab:red")):
                curve = lake.light_curve(int(source["id"]), band, source["peak_mjd"] + (1.0 + source["z_obs"]) * days)
                row[5].plot(days, curve["mag"].replace(np.inf, np.nan), color=colour, label=band)
            row[5].invert_yaxis()
            row[5].legend(fontsize=7)
            row[5].set_ylabel("AB mag", fontsize=8)
            name = {1: "Ia", 2: "II-P", 4: "IIn"}[kind]
            row[0].set_ylabel(f"type {name}, z = {source['z_obs']:.2f}", fontsize=9)
    panels[-1, 5].set_xlabel("days in the rest frame", fontsize=8)
    figure.savefig(out, dpi=95, pil_kwargs={"quality": 88})


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
