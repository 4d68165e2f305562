"""Print the content of an exported set as read by the package skyCatalogs, as JSON.

Run this script with a Python that has skyCatalogs, in the folder of the set:

    python open_skycatalogs.py RA DEC RADIUS_ARCSEC DRAWN_ID ...
"""

import json
import sys

import galsim
import numpy as np
from skycatalogs.objects.base_object import load_lsst_bandpasses
from skycatalogs.skyCatalogs import open_catalog
from skycatalogs.utils.shapes import Disk

SCALE, SIZE, BAND = 0.05, 301, "y"


def drawn(thing, band):
    """Draw an image of one second through 1 cm2; return the flux, and the angle of the major axis from x in deg."""
    spectra = thing.get_observer_sed_components()
    image = galsim.ImageD(SIZE, SIZE, scale=SCALE)
    for name, profile in thing.get_gsobject_components().items():
        part = (profile * spectra[name]).drawImage(band, nx=SIZE, ny=SIZE, scale=SCALE, method="no_pixel")
        image.array[:] += part.array
    y, x = (np.mgrid[:SIZE, :SIZE] - SIZE // 2) * SCALE
    weight = image.array * (np.hypot(x, y) < 3.0)
    xx, yy, xy = ((weight * q).sum() for q in (x * x, y * y, x * y))
    return {"flux": float(image.array.sum()), "angle": float(np.degrees(0.5 * np.arctan2(2 * xy, xx - yy)) % 180.0)}


def main():
    ra, dec, radius = map(float, sys.argv[1:4])
    catalogue = open_catalog("skyCatalog.yaml", loglevel="ERROR")
    bands = load_lsst_bandpasses()
    found = []
    for thing in catalogue.get_objects_by_region(Disk(ra, dec, radius)):
        fluxes = thing.get_fluxes(bands.values())
        about = {
            "id": int(thing.id),
            "type": thing.object_type,
            "ra": float(thing.ra),
            "dec": float(thing.dec),
            "profiles": sorted(thing.get_gsobject_components()),
            "spectra": sorted(thing.get_observer_sed_components()),
            "computed": dict(zip(bands, map(float, fluxes), strict=True)),
            "listed": {name: float(thing.get_LSST_flux(name)) for name in bands},
        }
        if thing.id in sys.argv[4:]:
            about["drawn"] = drawn(thing, bands[BAND])
        found.append(about)
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main()
