"""Select the catalogue rows whose spectra have light on a detector, as sources to disperse.

An order displaces a source's light far from its undispersed image. Rows are therefore selected by the undispersed
positions from which an order sends light onto the detector: a rectangle for each order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lake_schema import units
from lake_schema.arrays import Bool, Float, Int
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes import sources as checked
from truesky.fluxes.passbands import Passband
from truesky.fluxes.spectra import extinction, lines
from truesky.render.camera import astrometry, traces
from truesky.render.camera.detectors import Detector
from truesky.render.camera.traces import Trace
from truesky.render.channels import registry
from truesky.render.channels.aim import Aim, electron_rate
from truesky.render.channels.channel import Dispersion
from truesky.render.dispersing import draw, images
from truesky.render.dispersing.draw import DispersedSources, Order
from truesky.render.effects.scene import Scene
from truesky.render.exposure import visible_sources
from truesky.render.exposure.records import Rows
from truesky.render.exposure.visible_sources import MIN_SPECTRUM_NOISE, CandidateSources, Light
from truesky.render.sky.diffuse_light import solar_irradiance
from truesky.render.sources import selection, solar_system, spectra
from truesky.render.sources.source_list import Sources

# Distances in pixels from which the wing of a spectrum has light on the detector: for any source, and for sources with
# more than _BRIGHT electrons.
_WING, _FAR_WING, _BRIGHT = 64.0, 256.0, 1e6
# Factor on distances for variations of the plate scale over the field.
_DISTORTION = 1.02
_HALPHA = "flux_halpha"


def visible_spectra(aim: Aim, rows: Rows, scene: Scene, seed: int) -> Light:
    """Select all sources whose dispersed light is on a detector.

    Parameters
    ----------
    aim : Aim
        Exposure and detector.
    rows : Rows
        Catalogue rows that may have light on the detector.
    scene : Scene
        Scene before anything is drawn.
    seed : int
        Seed of the request.

    Returns
    -------
    Light
        Sources with their dispersion.

    Raises
    ------
    BadInput
        If the exposure has a PSF file.
    """
    exposure, mission, band, dispersion = aim.exposure, scene.mission, aim.band, _dispersion_of(aim)
    if exposure.psf:
        raise BadInput(f"exposure {exposure.exposure_id}: psf: spectra do not support PSF files, got {exposure.psf}")
    rows, settings = visible_sources.rows_at_exposure(rows, aim, mission), draw.settings_for(scene.accuracy)
    grism_orders = make_orders(aim, mission, seed)
    order_traces = tuple(order.trace for order in grism_orders)
    sources, spectrum_rows = _select_sources(aim, rows, scene, _rectangles(order_traces, aim.detector, band), seed)
    let_through = dispersion.vignetting(exposure, aim.detector, sources.column, sources.row, mission)
    sources = replace(sources, electrons=sources.electrons * let_through)
    sun = solar_irradiance(band.wavelength / 10.0, mission)
    source_spectra = spectra.spectrum_function(
        spectrum_rows, rows.galaxies, rows.stars, band, sun, (rows.galaxy_library, rows.stellar_library)
    )
    nodes = images.nodes(order_traces[0].first, order_traces[0].last, settings.nodes)
    psf = dispersion.psf(aim.detector, nodes, mission, settings.positions)
    zeros = np.zeros(len(sources))
    dispersed = DispersedSources(source_spectra, grism_orders, settings)
    return Light(
        sources,
        zeros.astype(np.int64),
        zeros,
        psf,
        scene,
        dispersed=dispersed,
        spectrum_rows=spectrum_rows,
        let_through=let_through,
    )


def make_orders(aim: Aim, mission: MissionConfiguration, seed: int) -> tuple[Order, ...]:
    """Create the orders of a grism, with their responses to f_lambda at the wavelengths of `sources.spectra`.

    Parameters
    ----------
    aim : Aim
        Exposure and detector.
    mission : MissionConfiguration
        Mission database of the exposure.
    seed : int
        Seed of the request.

    Returns
    -------
    tuple of Order
        Orders with their traces.
    """
    dispersion, band, exposure = _dispersion_of(aim), aim.band, aim.exposure
    grism_orders = []
    for trace in dispersion.traces(exposure, aim.detector, mission, seed):
        light = dispersion.throughput(exposure, trace.order, band.wavelength, aim.detector, mission)
        grism_orders.append(Order(trace, int(band.wavelength[0]), band.response * band.wavelength * light))
    return tuple(grism_orders)


def margin_arcsec(
    exposure: ExposureRow, detector: Detector, mission: MissionConfiguration, band: Passband, seed: int
) -> float:
    """Distance beyond a detector's circle up to which sources have dispersed light on it.

    Parameters
    ----------
    exposure : ExposureRow
        Row of the exposure.
    detector : Detector
        Detector.
    mission : MissionConfiguration
        Mission database.
    band : Passband
        Passband of the exposure.
    seed : int
        Seed of the request.

    Returns
    -------
    float
        Distance in arcsec, 0 without a grism.
    """
    channel = registry.CHANNELS[exposure.channel]
    if channel.dispersion is None or not channel.sees_sky(exposure.image_type):
        return 0.0
    boxes = _rectangles(channel.dispersion.traces(exposure, detector, mission, seed), detector, band)
    return max(_radius(boxes, detector) - detector.half_diagonal, 0.0)


def flux_bands(exposure: ExposureRow, columns: Sequence[str]) -> list[str]:
    """Return the exposure's band, and the selection band of sources if the flux table has a column for it."""
    dispersion = registry.CHANNELS[exposure.channel].dispersion
    selection_band = (
        [] if dispersion is None or f"f_nu_{dispersion.selection_band}" not in columns else [dispersion.selection_band]
    )
    return [exposure.band, *selection_band]


def _dispersion_of(aim: Aim) -> Dispersion:
    assert aim.channel.dispersion is not None
    return aim.channel.dispersion


def _rectangles(order_traces: tuple[Trace, ...], detector: Detector, band: Passband) -> Float:
    """Return the rectangles of undispersed positions in pixels, float64[orders, 4]: left, right, low, high."""
    ends = float(band.wavelength[0]), float(band.wavelength[-1])
    return np.array([traces.source_rectangle(trace, detector.nx, detector.ny, ends) for trace in order_traces])


def _radius(boxes: Float, detector: Detector) -> float:
    """Return the radius in arcsec of a circle around the detector's centre that contains the rectangles."""
    across = np.abs(boxes[:, :2] - (detector.nx - 1) / 2).max(axis=1)
    up = np.abs(boxes[:, 2:] - (detector.ny - 1) / 2).max(axis=1)
    return float(np.hypot(across + _FAR_WING, up + _FAR_WING).max()) * detector.pixel_scale * _DISTORTION


def _select_sources(aim: Aim, rows: Rows, scene: Scene, boxes: Float, seed: int) -> tuple[Sources, Int]:
    """Return sources in the rectangles and the rows of their spectra: ascending identifier, then moving bodies."""
    detector, wcs, column = aim.detector, aim.wcs, f"f_nu_{aim.exposure.band}"
    pairs = ((rows.galaxies, rows.galaxy_fluxes), (rows.stars, rows.star_fluxes))
    factor = electron_rate(aim.exposure) * scene.exposure_time_s
    galaxies, stars = (visible_sources.row_fluxes(*pair, column) * factor for pair in pairs)
    candidates = visible_sources.list_candidates(rows, (galaxies, stars))
    reach = _radius(boxes, detector) / 3600.0
    centre = astrometry.centre(detector, wcs)
    is_near = selection.within_radius(candidates.ra, candidates.dec, centre, reach) & _is_selected(
        candidates, rows, aim, scene
    )
    indices = np.flatnonzero(is_near)[np.argsort(candidates.ids[is_near], kind="stable")]
    x, y = astrometry.pixel_of_sky(wcs, candidates.ra[indices], candidates.dec[indices])
    is_inside = _is_inside(x, y, candidates.electrons[indices], np.zeros(len(indices)), boxes)
    indices, x, y = indices[is_inside], x[is_inside], y[is_inside]
    sources = Sources(
        candidates.ids[indices],
        x,
        y,
        astrometry.jacobian(wcs, x, y),
        candidates.electrons[indices],
        candidates.shape[indices],
        candidates.form,
        None,
        candidates.picture[indices],
        candidates.pictures,
    )
    spectrum_rows = candidates.spectrum_rows[indices]
    if not aim.channel.draws_moving_bodies:
        return sources, spectrum_rows
    bodies = solar_system.trailed_sources(aim, scene.mission, seed, reach, sources.shapes, rows.bodies)
    shining = bodies.electrons > MIN_SPECTRUM_NOISE * scene.pixel_noise
    is_inside = shining & _is_inside(bodies.column, bodies.row, bodies.electrons, bodies.trail_length, boxes)
    if not is_inside.any():
        return sources, spectrum_rows
    moving = replace(bodies.take(is_inside), photons=None)
    return replace(sources.with_moving(moving), photons=None), np.append(spectrum_rows, np.full(len(moving), -1))


def _is_selected(candidates: CandidateSources, rows: Rows, aim: Aim, scene: Scene) -> Bool:
    """Return a mask of noticeable sources, or the selection of Serrano et al. 2024 if the mission database requests it.

    If fluxes in the band of that selection are missing, fluxes in the exposure's band are used.
    """
    if scene.value("spectra.selection", "") < 0.5:
        return np.asarray(candidates.electrons > MIN_SPECTRUM_NOISE * scene.pixel_noise)
    tables = rows.galaxy_fluxes, rows.star_fluxes
    column = f"f_nu_{_dispersion_of(aim).selection_band}"
    if not all(column in table.column_names for table in tables):
        column = f"f_nu_{aim.exposure.band}"
    band_column = f"f_nu_{aim.exposure.band}"
    f_nu, band_f_nu = (np.concatenate([table[name].to_numpy() for table in tables]) for name in (column, band_column))
    # A standard star has fluxes only in the exposure's band.
    f_nu = np.where(np.isnan(f_nu), band_f_nu, f_nu)
    bright = f_nu >= 10.0 ** (0.4 * (units.AB_UJY - scene.value("spectra.faintest", "mag")))
    if _HALPHA in rows.galaxies.column_names:
        bright[: len(rows.galaxies)] |= _halpha_flux(rows) >= scene.value("spectra.faintest_line", "erg / (s cm2)")
    return np.asarray(bright[candidates.spectrum_rows] & (candidates.electrons > 0.0))


def _halpha_flux(rows: Rows) -> Float:
    """Return the observed H alpha flux per galaxy in erg s-1 cm-2, with magnification and Galactic dust.

    The flux is 0 for galaxies without the line.
    """
    flux = np.nan_to_num(rows.galaxies[_HALPHA].to_numpy(zero_copy_only=False).astype(float))
    (with_line,) = np.nonzero(flux > 0.0)
    shining = rows.galaxies.take(with_line)
    flux[with_line] *= checked.table_magnification(shining)
    if {"z_obs", "a_v"} <= set(shining.column_names):
        vacuum = next(line.vacuum for line in lines.line_list() if line.column == _HALPHA)
        observed = lines.observed_wavelength(
            np.full(len(with_line), vacuum), checked.column(shining, "z_obs"), "vacuum"
        )
        flux[with_line] *= extinction.transmission(extinction.milky_way(observed), checked.column(shining, "a_v"))
    return np.asarray(flux)


def _is_inside(x: Float, y: Float, electrons: Float, length: Float, boxes: Float) -> Bool:
    """Return a mask of undispersed positions from which some order sends light onto the detector."""
    wing = np.where(electrons > _BRIGHT, _FAR_WING, _WING) + length / 2
    is_inside = np.zeros(len(x), bool)
    for x_min, x_max, y_min, y_max in boxes:
        is_inside |= (x > x_min - wing) & (x < x_max + wing) & (y > y_min - wing) & (y < y_max + wing)
    return is_inside
