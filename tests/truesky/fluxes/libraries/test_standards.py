"""Compare lines of the planetary nebula, used for wavelength calibration, with atomic physics and published lines."""

import csv

import numpy as np
import pytest

from truesky.fluxes import passbands
from truesky.fluxes.libraries import standards

# cm^-1, of hydrogen (CODATA 2018, reduced mass).
RYDBERG = 109677.5834
SERIES = {
    "Hbeta": (2, 4), "Hgamma": (2, 5), "Hdelta": (2, 6), "Halpha": (2, 3), "Paalpha": (3, 4), "Pabeta": (3, 5),
    "Pagamma": (3, 6), "Padelta": (3, 7), "Paepsilon": (3, 8), "Brgamma": (4, 7), "Br10": (4, 10), "Br11": (4, 11),
    "Br12": (4, 12),
}  # fmt: skip
# In air, A (NIST, Atomic Spectra Database).
AIR = (
    4685.70, 4958.91, 5006.84, 5875.62, 6548.05, 6583.45, 7135.79, 9068.6, 9530.6, 10123.6, 10830.3, 12566.8, 16435.5,
    17002.4, 20581.3,
)  # fmt: skip


def lines():
    with standards.NEBULA.open(newline="", encoding="utf-8") as file:
        return [(row["name"], float(row["wavelength"]), float(row["flux"])) for row in csv.DictReader(file)]


def vacuum(air):
    """Convert wavelengths by Morton 2000, ApJS 130, 403, eq. 8, iterated; the code uses another formula."""
    found = air
    for _ in range(5):
        s2 = (1e4 / found) ** 2
        found = air * (1.0 + 8.34254e-5 + 2.406147e-2 / (130.0 - s2) + 1.5998e-4 / (38.9 - s2))
    return found


def test_lines_of_hydrogen_are_where_rydberg_has_them():
    found = {name: wavelength for name, wavelength, _ in lines() if name in SERIES}
    assert found.keys() == SERIES.keys()
    for name, (low, high) in SERIES.items():
        expected = 1e8 / (RYDBERG * (1.0 / low**2 - 1.0 / high**2))
        assert found[name] == pytest.approx(expected, rel=1.5e-5), name


def test_other_lines_are_in_vacuum_and_as_published():
    found = np.array([wavelength for name, wavelength, _ in lines() if name not in SERIES])
    for air in AIR:
        nearest = found[np.abs(found - air).argmin()]
        assert nearest == pytest.approx(vacuum(air), abs=0.2 + 3e-5 * air), air


@pytest.mark.parametrize(("name", "least"), [("nisp_red", 7), ("nisp_blue", 6)])
def test_each_grism_sees_lines_all_over_its_band(name, least):
    """There are more lines than the degree of the dispersion polynomial, with the contrast of the published ratios."""
    band = passbands.load(name)
    seen = band.wavelength[band.response > 0.5 * band.response.max()]
    own = [wavelength for _, wavelength, _ in lines() if seen[0] <= wavelength <= seen[-1]]
    assert len(own) >= least
    # No half of the band is without a line.
    assert max(np.diff([seen[0], *own, seen[-1]])) < 0.55 * (seen[-1] - seen[0])


def test_ratios_are_those_of_case_b():
    """Ratios are from Storey & Hummer 1995 at 10^4 K and 10^4 cm^-3, relative to H beta."""
    flux = {name: value for name, _, value in lines() if name in SERIES}
    for name, ratio in {"Paalpha": 0.332, "Pabeta": 0.162, "Pagamma": 0.0901, "Brgamma": 0.0275}.items():
        assert flux[name] / flux["Hbeta"] == pytest.approx(ratio, rel=0.05)
    assert np.all(np.diff([flux[name] for name in ("Paalpha", "Pabeta", "Pagamma", "Padelta", "Paepsilon")]) < 0.0)
