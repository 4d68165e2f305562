"""Light of the twilight sky: sunlight that the upper air scatters while the Sun is 8 to 20 deg below the horizon.

The ratio of twilight to the dark zenith was measured with an all-sky camera at Cerro Pachon. It falls exponentially
with the depth of the Sun, grows with airmass, and is larger towards the Sun.

References
----------
Yoachim et al. 2016, Proc. SPIE 9910, 99101A; coefficients of the package rubin_sim (Rubin Observatory)
"""

from __future__ import annotations

import numpy as np

from truesky.fluxes import passbands
from truesky.fluxes.passbands import Passband

# Coefficients by wavelength (angstrom, effective wavelengths of the filters): ratio to the dark zenith for a Sun at
# -12 deg, slope (dex per radian of the Sun's altitude), growth with airmass (dex per airmass), and additional growth
# towards the Sun (dex per airmass). In u the ratio is an assumption of the authors; in z and y they adopt published
# values of the I band.
_COEFFICIENTS = np.array(
    [
        (3670.0, 16.0, 22.9622121, 0.285862729, 0.299902574),
        (4500.0, 7.56765633, 22.9798055, 0.286879956, 0.301162143),
        (5300.0, 2.38561156, 22.9310648, 0.297733083, 0.316403197),
        (6000.0, 1.75498017, 22.2011802, 0.298619033, 0.328880254),
        (8700.0, 2.29, 24.08, 0.3, 0.3),
        (9700.0, 2.0, 24.08, 0.3, 0.3),
    ]
)
# Altitudes of the Sun (deg) between which twilight is simulated. The measurements end at -11 deg. Below the lower limit
# twilight is less than 1 % of the dark sky in all bands but u.
LIMITS = (-20.0, -8.0)
# Altitude of the Sun (deg) to which the ratios of `_COEFFICIENTS` belong.
_REFERENCE = -12.0


def ratio(band: Passband, sun_altitude: float, from_sun: float, airmass: float) -> float:
    """Return the light of twilight in a direction, relative to the dark sky at the zenith.

    Parameters
    ----------
    band : Passband
        Response of the band; its pivot wavelength selects the coefficients.
    sun_altitude : float
        Altitude of the Sun in degrees.
    from_sun : float
        Azimuth of the direction minus that of the Sun, deg.
    airmass : float
        Airmass in this direction.

    Returns
    -------
    float
        Ratio, with an error of a factor of two. It is 0 if the Sun is outside `LIMITS`: below there is no twilight, and
        daylight is not simulated.
    """
    if not LIMITS[0] <= sun_altitude <= LIMITS[1]:
        return 0.0
    wavelength = passbands.pivot_wavelength(band)
    logarithm, *rest = (
        float(np.interp(wavelength, _COEFFICIENTS[:, 0], column))
        for column in (np.log10(_COEFFICIENTS[:, 1]), *_COEFFICIENTS[:, 2:].T)
    )
    slope, growth, towards = rest
    exponent = logarithm + slope * np.radians(sun_altitude - _REFERENCE) + growth * (airmass - 1.0)
    return float(10.0 ** (exponent + towards * max(np.cos(np.radians(from_sun)), 0.0) * (airmass - 1.0)))
