"""Compare the results of truesky for given values with an independent program or integral.

A function returns the error in the unit of its subject in quantities.py, or lets BadInput pass.
"""

import math
import tempfile
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path
from unittest import mock

import galsim
import numpy as np
import pyarrow as pa
from scipy import integrate
from scipy.special import ndtr

from lake_schema import sky, units
from lake_schema.mission.configuration import resolve
from lake_schema.tables.galaxies import DISK_SCALE_HEIGHT
from tests.extremes.test_stamps import source_of
from tests.truesky.render.fields import psf_of, small
from truesky.catalogue import given_sources
from truesky.catalogue.galaxies import lensing, morphology
from truesky.cosmology import FIDUCIAL, HUBBLE_DISTANCE
from truesky.fluxes import band_fluxes, high_redshift, passbands
from truesky.fluxes.libraries import from_files, templates
from truesky.fluxes.passbands import Passband
from truesky.fluxes.spectra import extinction, lines
from truesky.render.camera import astrometry
from truesky.render.drawing import stamp_sizes, stamps
from truesky.render.drawing.kernels import fourier
from truesky.render.effects.readout import adc, read_noise
from truesky.render.effects.scene import Scene
from truesky.render.psf import atmosphere, seeing
from truesky.render.sky import observatory
from truesky.request.schema import MAX_SHEAR

# Side of the stamps, pixels. The reference has all frequencies that are aliased to those of the stamp, up to
# 2 * ALIASES + 1 times the Nyquist frequency.
SIDE, ALIASES = 32, 4
FINE = galsim.GSParams(kvalue_accuracy=1e-7, xvalue_accuracy=1e-9, folding_threshold=1e-5, maxk_threshold=1e-6)
# Light below this share of the scale of a spectrum is less than single precision can hold.
DARK = 1e-33


# ------------------------------------------------------------------------------------------------ galaxy on a stamp


def is_near_caustic(kappa, shear):
    """Return True if truesky refuses the lensing, and None if rounding decides."""
    found = []
    for rounding in (-1e-6, 1e-6):
        determinant = (1.0 - kappa) ** 2 * (1.0 - shear**2) * (1.0 + rounding)
        found.append(
            determinant < lensing.settings().caustic or kappa >= 1.0 or abs(shear) * (1.0 + rounding) > MAX_SHEAR
        )
    return found[0] if found[0] == found[1] else None


@cache
def profile_of_index(index):
    return galsim.Sersic(index, half_light_radius=1.0, gsparams=FINE)


def galaxy_of(row):
    """Return the galsim profile in arcsec to the west and north, without functions of truesky."""
    fraction, parts = row["bulge_fraction"], []
    if fraction > 0.0:
        radius = row["bulge_half_light_radius"] * math.sqrt(row["bulge_axis_ratio"])
        bulge = profile_of_index(row["bulge_sersic_index"]).dilate(radius) if radius else galsim.DeltaFunction()
        parts.append(fraction * bulge.shear(q=row["bulge_axis_ratio"], beta=0.0 * galsim.degrees))
    if fraction < 1.0:
        radius, tilt = row["disk_half_light_radius"], row["inclination"] * galsim.degrees
        disc = galsim.InclinedExponential(
            tilt, half_light_radius=radius or 1.0, scale_h_over_r=DISK_SCALE_HEIGHT, gsparams=FINE
        )
        parts.append((1.0 - fraction) * (disc if radius else galsim.DeltaFunction()))
    turned = galsim.Sum(parts).rotate((90.0 + row["position_angle"]) * galsim.degrees)
    kappa, gamma1, gamma2 = (row[name] for name in ("kappa", "gamma1", "gamma2"))
    image = np.linalg.inv([[1.0 - kappa - gamma1, gamma2], [gamma2, 1.0 - kappa + gamma1]])
    return turned.transform(*image.ravel()).withFlux(1.0)


def transform_of(profile, x, y):
    """Return the Fourier transform of a profile in pixels that is sampled on a stamp, with the profile at (x, y)."""
    repeats = 2 * ALIASES + 1
    n = repeats * SIDE
    ends = -(n // 2), n - 1 - n // 2
    k = 2.0 * np.pi / SIDE * np.arange(ends[0], ends[1] + 1)
    values = profile.drawKImage(bounds=galsim.BoundsI(*ends, *ends), scale=2.0 * np.pi / SIDE).array
    values = values * np.exp(-1j * (k * x + k[:, None] * y))
    first = ends[0] % SIDE
    return np.roll(values.reshape(repeats, SIDE, repeats, SIDE).sum((0, 2)), (first, first), (0, 1))


def galaxy_on_a_stamp(values):
    angle = np.radians(2.0 * 33.0)
    shear = values["reduced_shear"] * (1.0 - values["kappa"])
    columns = {name: value for name, value in values.items() if name not in ("reduced_shear", "electrons")}
    columns |= {"gamma1": shear * np.cos(angle), "gamma2": shear * np.sin(angle), "ra": 10.0, "dec": 20.0, "mag": 20.0}
    found = given_sources.check_arrays(
        {name: np.array([value]) for name, value in columns.items()}, "galaxies", Path("galaxies"), FIDUCIAL, {}
    )
    row = {name: float(np.float32(found[name][0])) for name in columns if name not in ("ra", "dec", "mag")}
    row["inclination"] = float(np.float32(morphology.inclination(row.pop("disk_axis_ratio"), DISK_SCALE_HEIGHT)))
    electrons, psf = values["electrons"], psf_of("vis")
    source = source_of("vis", electrons, column=SIDE / 2 + 0.3, row=SIDE / 2 - 0.4, **row)
    # Nothing is taken off the stamp, so that it contains the aliased light of the whole galaxy.
    with mock.patch.object(stamp_sizes, "_OUTSIDE", 2.0):
        image = stamps.draw(source, np.array([SIDE]), psf, SIDE, SIDE)
    assert np.isfinite(image).all()
    in_pixels = galsim.JacobianWCS(*source.jacobian[0].ravel()).toImage(galaxy_of(row))
    parts = [in_pixels, psf.profile.dilate(1.0 / psf.pixel_scale).withGSParams(FINE), galsim.Pixel(1.0)]
    expected = transform_of(galsim.Convolve(parts, propagate_gsparams=False), source.column[0], source.row[0])
    # Each pixel is rounded to a multiple of the smallest unit.
    rounding = 0.5 * image.size / fourier.units_of(source.electrons)
    worst = np.abs(np.fft.fft2(image) - electrons * expected).max()
    return max(worst - rounding, 0.0) / electrons


# ------------------------------------------------------------------------------------------------ fluxes


@cache
def milky_way(wavelength):
    """Return A(lambda) / A(V) of dust_extinction for R_V = 3.1, which is constant below 1000 A."""
    import astropy.units as u
    from dust_extinction.parameter_averages import O94

    return float(O94(Rv=3.1)(1e4 / max(wavelength, 1000.0) / u.um))


def one_sample(wavelength):
    return Passband(
        "one", np.array([np.rint(wavelength) if np.isfinite(wavelength) else 1e9]), np.array([0.3]), "vacuum"
    )


def relative(got, expected, least):
    """Return the relative difference; fluxes below `least` count as equal."""
    assert np.isfinite(got)
    assert got >= 0.0
    return abs(got - expected) / max(expected, least)


def flux_of(row, wavelength, library):
    place = {"id": [1], "ra": [10.0], "dec": [20.0], "_healpix_29": [1]}
    table = pa.table(place | {name: [value] for name, value in row.items()})
    band = one_sample(wavelength)
    return float(band_fluxes.galaxy_fluxes(table, [band], library)["f_nu_one"][0].as_py()), band.wavelength[0]


def galaxy_in_one_sample(values):
    library, sed, law, z = templates.galaxy_library(), (3, 24), (2, 4), values["redshift"]
    row = {"kind": 0, "z_obs": z, "abs_mag_r01": -20.0, "gamma1": 0.0, "gamma2": 0.0}
    row |= {name: values[name] for name in ("a_v", "mag_r01", "kappa", "frac_1")}
    row |= {"frac_2": 1.0 - values["frac_1"]}
    for k in (1, 2):
        row |= {f"sed_{k}": sed[k - 1], f"ext_law_{k}": law[k - 1], f"ebv_{k}": values["ebv"]}
    got, wavelength = flux_of(row, values["wavelength"], library)
    reference = passbands.load("sdss_r01")
    rest, dust = library.wavelength, np.exp(-0.4 * np.log(10.0) * values["ebv"] * extinction.laws(library.wavelength))
    total = np.zeros_like(rest)
    for k in (1, 2):
        dimmed = library.flux[sed[k - 1]].astype(float) * dust[law[k - 1]]
        total += row[f"frac_{k}"] * dimmed / float(passbands.ab_flux(reference, rest, dimmed))
    observed = np.interp(reference.wavelength / (1.0 + z), rest, total)
    scale = 10.0 ** (-0.4 * (values["mag_r01"] - 23.9)) / float(observed @ passbands.weights(reference))
    scale *= wavelength**2 / units.LIGHT_ANGSTROM_S / (1.0 - values["kappa"]) ** 2
    expected = scale * np.interp(wavelength / (1.0 + z), rest, total)
    dimmed = expected * 10.0 ** (-0.4 * values["a_v"] * milky_way(wavelength))
    error = relative(got, dimmed, max(DARK * scale * total.max(), 1e-37))
    own = [np.interp(wavelength / (1.0 + z), rest, extinction.laws(rest)[k]) for k in law]
    magnitudes = values["ebv"] * max(own) + values["a_v"] * milky_way(wavelength)
    return error / max(1e-6, 2e-7 * magnitudes)


def distant_galaxy_in_one_sample(values):
    library, sed, z = high_redshift.high_redshift_library(), 7, values["redshift"]
    row = {"kind": 3, "z_obs": z, "kappa": 0.0, "gamma1": 0.0, "gamma2": 0.0, "sed_1": sed, "frac_1": 1.0}
    row |= {"frac_2": 0.0, "ebv_1": 0.0, "ebv_2": 0.0, "sed_2": 0, "a_v": values["a_v"], "mag_r01": values["mag_r01"]}
    row |= {"ext_law_1": 0, "ext_law_2": 0, "abs_mag_r01": -20.0}
    got, wavelength = flux_of(row, values["wavelength"], templates.galaxy_library())
    flux = library.flux[sed].astype(float)
    at = np.interp([wavelength / (1.0 + z), 1500.0], library.wavelength, flux)
    bright = 10.0 ** (-0.4 * (values["mag_r01"] - 23.9)) * (wavelength / (1500.0 * (1.0 + z))) ** 2
    expected = bright * at[0] / at[1] * 10.0 ** (-0.4 * values["a_v"] * milky_way(wavelength))
    return relative(got, expected, 1e-37)


def distance(values):
    z = values["redshift"]
    got = float(FIDUCIAL.luminosity_distance(z))
    rate = lambda x: 1.0 / math.sqrt(FIDUCIAL.omega_m * (1.0 + x) ** 3 + FIDUCIAL.omega_lambda)  # noqa: E731
    expected = (1.0 + z) * HUBBLE_DISTANCE * integrate.quad(rate, 0.0, z, epsabs=0.0, epsrel=1e-13)[0]
    back = float(FIDUCIAL.redshift(got / (1.0 + z)))
    return relative(got, expected, 1e-300) + 0.01 * relative(back, z, 1e-300)


def emission_line(values):
    sigma, z, flux = (np.array([values[name]]) for name in ("velocity_dispersion", "z_obs", "flux_halpha"))
    fluxes = np.zeros((1, len(lines.line_list())))
    fluxes[0, 0] = flux[0]
    found = lines.profiles(fluxes, z, sigma, "vacuum")
    if not flux[0] > 0.0:
        return float(len(found.row))
    centre = lines.line_list()[0].vacuum * (1.0 + z[0])
    edges = found.first[0] - 0.5 + np.arange(found.f_lambda.shape[1] + 1)
    expected = np.diff(ndtr((edges - centre) / (sigma[0] / units.LIGHT_KM_S * centre)))
    assert np.isfinite(found.f_lambda).all()
    return np.abs(found.f_lambda[0] / flux[0] - expected).max() + abs(found.f_lambda[0].sum() / flux[0] - 1.0)


def passband_from_a_file(values):
    centre, width, rows = values["wavelength"], values["width"], values["rows"]
    half = 0.5 * width
    at = centre + half * np.linspace(-1.0, 1.0, max(int(rows) // 2 * 2 + 1, 3))
    response = 1.0 - np.abs(np.linspace(-1.0, 1.0, len(at)))
    keep = slice(1, 2) if rows < 2 else slice(None)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "band.dat")
        path.write_text(
            "".join(f"{a!r} {r!r}\n" for a, r in zip(at[keep].tolist(), response[keep].tolist(), strict=True))
        )
        band = from_files.passband(path, "own", "air")
    flat = float(passbands.ab_flux(band, passbands.grid(), 1.0 / passbands.grid() ** 2))
    assert abs(flat * units.LIGHT_ANGSTROM_S - 1.0) < 1e-9
    triangle = lambda x, power: max(1.0 - abs(x - centre) / half, 0.0) * x**power  # noqa: E731
    first, last = centre - half, min(centre + half, passbands.GRID_LAST)
    one, other = (integrate.quad(triangle, first, last, (p,), points=[min(centre, last)])[0] for p in (1, -1))
    return abs(passbands.pivot_wavelength(band) - math.sqrt(one / other))


# ------------------------------------------------------------------------------------------------ positions


def offset(lon, lat, direction, distance):
    """Return the position (rad) at a distance and position angle from another one, by ERFA.

    astropy's offset_by is an arcsine, which loses half of the digits at the poles.
    """
    import erfa

    away, no_turn = np.sin(distance), np.identity(3)
    vector = np.stack([np.cos(distance), away * np.sin(direction), away * np.cos(direction)], -1)
    turn = erfa.rz(-lon, erfa.ry(lat, no_turn))
    return erfa.c2s(erfa.rxp(turn, vector))


def position_on_the_sky(values):
    from astropy.coordinates import angular_separation

    ra, dec, distance = (values[name] for name in ("right_ascension", "declination", "distance"))
    order, direction = int(values["order_of_cell"]), np.radians(values["direction"])
    cell = int(sky.cell_at([ra], [dec], order)[0])
    turned = np.radians(math.fmod(ra, 360.0))
    east, north = (np.radians(distance) * np.array([f(direction)]) for f in (np.sin, np.cos))
    moved = sky.offset_positions(np.array([ra]), np.array([dec]), east, north)
    lon, lat = offset(turned, np.radians(dec), direction, np.radians(distance))
    apart = angular_separation(np.radians(moved[0][0]), np.radians(moved[1][0]), lon, lat)
    found = float(sky.separation(ra, dec, *np.degrees([lon, lat])))
    expected = np.degrees(angular_separation(turned, np.radians(dec), lon, lat))
    assert 0.0 <= moved[0][0] < 360.0
    # A distance of many circles is rounded by more than the allowed error when it is written in radians.
    rounding = max(1.0, distance / 180.0)
    return max(np.degrees(apart) / rounding, abs(found - expected), distance_to_cell(ra, dec, order, cell))


def distance_to_cell(ra, dec, order, cell):
    """Return 0 if cdshealpix finds the same cell, else the distance (deg) to the border that it has in common."""
    import astropy.units as u
    from astropy.coordinates import Latitude, Longitude
    from cdshealpix import nested

    place = Longitude([math.fmod(ra, 360.0)] * u.deg), Latitude([dec] * u.deg)
    cells, dx, dy = nested.lonlat_to_healpix(*place, order, return_offsets=True)
    if int(cells[0]) == cell:
        return 0.0
    around = nested.neighbours(cells, order)
    return sky.cell_radius(order) * (1.0 if cell not in around else min(dx[0], 1 - dx[0], dy[0], 1 - dy[0]))


def pixel_of_a_detector(values):
    ra, dec = values["right_ascension"], values["declination"]
    # Only values within the limits are rounded: 0.6 columns would be one column.
    overrides = {f"vis.fpa.n{axis}": (np.rint(values[n]) if 1.0 <= values[n] <= 65536.0 else values[n], "pix")
                 for axis, n in (("x", "columns"), ("y", "rows"))}  # fmt: skip
    sky.check_positions(ra, dec)
    mission = resolve(overrides=overrides)
    nx, ny = (int(mission.value(f"vis.fpa.n{axis}", "pix")) for axis in "xy")
    detector = replace(small("vis", "3-4", 16), nx=nx, ny=ny, x=0.0, y=0.0, rotation=0.0, distortion_terms=())
    system = astrometry.wcs(detector, ra, dec, values["position_angle"])
    column, row = np.array([-0.5, nx - 0.5, nx / 2.0]), np.array([-0.5, ny - 0.5, 0.0])
    lon, lat = astrometry.sky_of_pixel(system, column, row)
    back = np.hypot(*(a - b for a, b in zip(astrometry.pixel_of_sky(system, lon, lat), (column, row), strict=True)))
    # From the middle, x of the focal plane points to the west for the position angle 0.
    x, y = column - (nx - 1) / 2, row - (ny - 1) / 2
    scale = np.radians(detector.pixel_scale / 3600.0)
    angle = np.radians(values["position_angle"]) + np.arctan2(-x, y)
    turned = np.radians(math.fmod(ra, 360.0)), np.radians(dec)
    expected = offset(*turned, angle, np.arctan(scale * np.hypot(x, y)))
    apart = sky.separation(lon, lat, *np.degrees(expected))
    # A right ascension of many turns has fewer digits.
    rounding = np.radians(np.spacing(abs(ra))) / scale
    return max(back.max(), np.radians(apart).max() / scale) - 2.0 * rounding


def airmass_of_young(altitude):
    """Return the airmass of Young 1994 at true altitudes in degrees."""
    c = math.sin(math.radians(altitude))
    above = 1.002432 * c**2 + 0.148386 * c + 0.0096467
    return above / (c**3 + 0.149864 * c**2 + 0.0102963 * c + 0.000303978)


def field_above_a_telescope(values):
    import erfa

    ra, dec, mjd, latitude = (values[name] for name in ("right_ascension", "declination", "mjd", "latitude"))
    sky.check_positions(ra, dec)
    mission = resolve(overrides={"ext.lsstcam.site.latitude": (latitude, "deg")})
    site = observatory.Site.from_mission("ext.lsstcam", mission)
    place = np.radians([site.longitude, site.latitude])
    with warnings.catch_warnings():
        # ERFA warns of dates before 1960 and far in the future, for which it has no leap seconds.
        warnings.simplefilter("ignore")
        _, zenith_distance, *_ = erfa.atco13(
            np.radians(math.fmod(ra, 360.0)), np.radians(dec), 0.0, 0.0, 0.0, 0.0, 2400000.5, mjd, 0.0, *place,
            site.height, 0.0, 0.0, 0.0, 0.0, 0.0, 0.55,
        )  # fmt: skip
    expected = 90.0 - np.degrees(zenith_distance)
    # 0.2 deg until 2035, and 0.6 deg for each century before or after 2000.
    allowed = max(0.2, 0.6 * abs(mjd - 51544.5) / 36525.0)
    found = float(site.altitude(ra, dec, mjd))
    airmass, zenith = observatory.airmass_and_zenith(ra, dec, mjd, site)
    assert 1.0 <= airmass <= observatory.HIGHEST_AIRMASS
    assert -180.0 <= zenith <= 180.0
    error = abs(found - expected) / allowed
    if observatory.airmass(found) <= observatory.HIGHEST_AIRMASS:
        # Kasten and Young give it within 1 % for these altitudes.
        error = max(error, abs(airmass / airmass_of_young(found) - 1.0) / 0.01)
    return error


def seeing_through_air(values):
    wide, outer, wavelength = (values[name] for name in ("seeing", "outer_scale", "wavelength"))
    mission = resolve(overrides={
        "ext.lsstcam.seeing": (wide, "arcsec"), "ext.lsstcam.psf.outer_scale": (outer, "m"),
    })  # fmt: skip
    detector = small("lsstcam", "R22_S11")
    seeing.check(mission.value("ext.lsstcam.seeing", "arcsec"), 1.0, detector, passbands.load("lsst_r"), mission)
    fried = atmosphere.fried_length(wide, wavelength, outer)
    theirs = galsim.VonKarman(lam=wavelength / 10.0, r0=fried, L0=outer)
    middle, half = (theirs.xValue(r, 0.0) for r in (0.0, 0.5 * wide))
    slope = (theirs.xValue(0.501 * wide, 0.0) - theirs.xValue(0.499 * wide, 0.0)) / (0.002 * middle)
    return abs((half / middle - 0.5) / slope) / (2e-5 if fried < 0.03 * outer else 1e-3)


# ------------------------------------------------------------------------------------------------ readout


def detector_that_is_read_out(values):
    names = {"exposure_time": "s", "gain": "electron / adu", "read_noise": "electron", "bias": "adu",
             "dark_current": "electron / (s pix)", "adc_max": "adu"}  # fmt: skip
    overrides = {f"vis.{name}": (values[name], unit) for name, unit in names.items()}
    mission = resolve(overrides=overrides | {"vis.detector_temperature": (150.0, "K"),
                                             "vis.dark_reference_temperature": (150.0, "K")})  # fmt: skip
    scene = Scene(mission, "vis", mission.value("vis.exposure_time", "s"), 0.25, 1e4)
    kept = np.full((64, 64), scene.dark_electrons + scene.sky_electrons)
    noisy = read_noise.apply(kept, *read_noise.EFFECT.parameters(scene), np.random.default_rng(1))
    numbers = adc.to_file_type(adc.apply(noisy, *adc.EFFECT.parameters(scene)), scene)
    assert numbers.dtype == np.uint16
    electrons = values["exposure_time"] * (values["dark_current"] + scene.sky_rate)
    edges = values["gain"] * (np.arange(values["adc_max"] // 1.0) + 0.5 - values["bias"]) - electrons
    # A number is at least n if the electrons reach the edge below n.
    reaches = ndtr(-edges / values["read_noise"]) if values["read_noise"] else (edges <= 0.0).astype(float)
    numbers_above = np.arange(1.0, len(reaches) + 1.0)
    mean = reaches.sum()
    variance = max(((2.0 * numbers_above - 1.0) * reaches).sum() - mean**2, 0.0)
    # Edges that the electrons meet exactly may be rounded to either side.
    return abs(numbers.mean(dtype=float) - mean) / (np.sqrt(variance / numbers.size) + 1e-4 + 1e-9 * mean)


COMPARISONS = {
    "galaxy on a stamp": galaxy_on_a_stamp,
    "galaxy in a passband of one sample": galaxy_in_one_sample,
    "galaxy of high redshift in a passband of one sample": distant_galaxy_in_one_sample,
    "distance": distance,
    "emission line": emission_line,
    "passband from a file": passband_from_a_file,
    "position on the sky": position_on_the_sky,
    "pixel of a detector": pixel_of_a_detector,
    "field above a telescope": field_above_a_telescope,
    "seeing through turbulent air": seeing_through_air,
    "detector that is read out": detector_that_is_read_out,
}
