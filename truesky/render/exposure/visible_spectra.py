"""Select the catalogue sources whose slitless spectra have light on a detector.

A spectral order of a grism displaces the light of a source far from its undispersed image. Sources are therefore
selected by the undispersed positions from which an order sends light onto the detector: a rectangle for each order.
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

# Distance of a spectrum from the detector, pixels, up to which the PSF wings of any source may have light on the
# detector.
_WING = 64.0
# Distance of a spectrum from the detector, pixels, up to which the PSF wings of bright sources may have light on the
# detector.
_FAR_WING = 256.0
# Sources with more expected electrons than this are bright: their wings are considered up to _FAR_WING.
_BRIGHT = 1e6
# Factor by which the radius on the sky is increased in which sources are searched, since the plate scale varies over
# the field.
_DISTORTION = 1.02
# Column of galaxies with the flux of the H alpha line.
_HALPHA = "flux_halpha"


def visible_spectra(aim: Aim, rows: Rows, scene: Scene, seed: int) -> Light:
    """Select all sources whose dispersed light falls onto a detector, with the data for drawing their spectra.

    Parameters
    ----------
    aim : Aim
        Exposure, taken through a grism, and detector.
    rows : Rows
        Catalogue rows that may have light on the detector.
    scene : Scene
        Properties of the exposure before anything is drawn.
    seed : int
        Seed of the request, from which moving bodies and the position error of the grism wheel are drawn.

    Returns
    -------
    Light
        Sources with their spectra and the orders of the grism; `sizes` and `neglected` are 0.

    Raises
    ------
    BadInput
        If the exposure has a PSF from a user's file, which is not supported for spectra.
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
        spectrum_rows,
        rows.galaxies,
        rows.stars,
        band,
        sun,
        (rows.galaxy_library, rows.stellar_library),
        rows.own_spectra,
    )
    nodes = images.nodes(order_traces[0].first, order_traces[0].last, settings.nodes)
    psf = dispersion.psf(aim.detector, nodes, mission, settings.positions)
    zeros = np.zeros(len(sources))
    dispersed = DispersedSources(source_spectra, grism_orders, settings, band.response * band.wavelength)
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
    """Create the spectral orders of a grism, with their traces and their responses to f_lambda.

    Parameters
    ----------
    aim : Aim
        Exposure, taken through a grism, and detector.
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras) of the exposure.
    seed : int
        Seed of the request, from which the position error of the grism wheel is drawn.

    Returns
    -------
    tuple of Order
        Orders. Each response is proportional to the detected electrons per f_lambda, at the wavelengths of the
        passband.
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
    """Return the distance from a detector up to which sources have dispersed light on it.

    Parameters
    ----------
    exposure : ExposureRow
        Row of the table `exposures`.
    detector : Detector
        The detector.
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras).
    band : Passband
        Passband of the exposure.
    seed : int
        Seed of the request, from which the position error of the grism wheel is drawn.

    Returns
    -------
    float
        Distance beyond the circle through the corners of the detector, arcsec; 0 without a grism or without light of
        the sky.
    """
    channel = registry.CHANNELS[exposure.channel]
    if channel.dispersion is None or not channel.sees_sky(exposure.image_type):
        return 0.0
    boxes = _rectangles(channel.dispersion.traces(exposure, detector, mission, seed), detector, band)
    return max(_radius(boxes, detector) - detector.half_diagonal, 0.0)


def flux_bands(exposure: ExposureRow, columns: Sequence[str]) -> list[str]:
    """Return the bands in which fluxes of sources are needed: the exposure's band, and possibly a selection band.

    Some channels (instrument modes) with a grism select sources by their flux in another band, the selection band. It
    is included if the flux of this band is one of `columns`, the columns of the flux table.
    """
    dispersion = registry.CHANNELS[exposure.channel].dispersion
    selection_band = (
        [] if dispersion is None or f"f_nu_{dispersion.selection_band}" not in columns else [dispersion.selection_band]
    )
    return [exposure.band, *selection_band]


def _dispersion_of(aim: Aim) -> Dispersion:
    assert aim.channel.dispersion is not None
    return aim.channel.dispersion


def _rectangles(order_traces: tuple[Trace, ...], detector: Detector, band: Passband) -> Float:
    """Return, for each order, the rectangle of undispersed positions from which light falls onto the detector.

    The result [orders, 4] contains the smallest and largest column and the smallest and largest row, pixels.
    """
    ends = float(band.wavelength[0]), float(band.wavelength[-1])
    return np.array([traces.source_rectangle(trace, detector.nx, detector.ny, ends) for trace in order_traces])


def _radius(boxes: Float, detector: Detector) -> float:
    """Return the radius, arcsec, of a circle around the detector's centre that contains rectangles with a margin.

    `boxes` has one rectangle per spectral order: smallest and largest column, smallest and largest row, pixels. The
    margin of 256 pixels contains the PSF wings of bright sources.
    """
    across = np.abs(boxes[:, :2] - (detector.nx - 1) / 2).max(axis=1)
    up = np.abs(boxes[:, 2:] - (detector.ny - 1) / 2).max(axis=1)
    return float(np.hypot(across + _FAR_WING, up + _FAR_WING).max()) * detector.pixel_scale * _DISTORTION


def _select_sources(aim: Aim, rows: Rows, scene: Scene, boxes: Float, seed: int) -> tuple[Sources, Int]:
    """Return the sources whose dispersed light falls onto the detector, and the index of each source's spectrum.

    `boxes` are the rectangles from `_rectangles` in which their undispersed positions lie. Sources are sorted by
    identifier, moving bodies at the end. The index refers to the list of all galaxies followed by all stars in `rows`;
    it is -1 for a moving body.
    """
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
    """Return the mask of the candidates that are drawn: sources with noticeable light, or sources above flux limits.

    The mission database decides which of the two criteria is used. The flux limits (Serrano et al. 2024) apply to
    fluxes in the selection band of the channel, or in the band of the exposure if the flux tables lack the selection
    band.
    """
    if scene.value("spectra.selection", "") < 0.5:
        return np.asarray(candidates.electrons > MIN_SPECTRUM_NOISE * scene.pixel_noise)
    tables = rows.galaxy_fluxes, rows.star_fluxes
    column = f"f_nu_{_dispersion_of(aim).selection_band}"
    if not all(column in table.column_names for table in tables):
        column = f"f_nu_{aim.exposure.band}"
    band_column = f"f_nu_{aim.exposure.band}"
    f_nu, band_f_nu = (np.concatenate([table[name].to_numpy() for table in tables]) for name in (column, band_column))
    # A standard star that was added for a calibration has a flux in the band of the exposure only.
    f_nu = np.where(np.isnan(f_nu), band_f_nu, f_nu)
    bright = f_nu >= 10.0 ** (0.4 * (units.AB_UJY - scene.value("spectra.faintest", "mag")))
    if _HALPHA in rows.galaxies.column_names:
        bright[: len(rows.galaxies)] |= _halpha_flux(rows) >= scene.value("spectra.faintest_line", "erg / (s cm2)")
    return np.asarray(bright[candidates.spectrum_rows] & (candidates.electrons > 0.0))


def _halpha_flux(rows: Rows) -> Float:
    """Return the observed H alpha flux of each galaxy, erg s-1 cm-2, with magnification and extinction by the Galaxy.

    The flux is 0 for galaxies without the line. Extinction is included only if the rows have the columns `z_obs` and
    `a_v`.
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
    """Return the mask of the undispersed positions (x, y) from which some order sends light onto the detector.

    `boxes` has the rectangle of these positions for each order: smallest and largest column, smallest and largest row,
    pixels. `length` are the lengths of the trails of moving sources, pixels. The rectangles are enlarged for the PSF
    wings: by 64 pixels, or by 256 pixels for sources with more than 1e6 `electrons`.
    """
    wing = np.where(electrons > _BRIGHT, _FAR_WING, _WING) + length / 2
    is_inside = np.zeros(len(x), bool)
    for x_min, x_max, y_min, y_max in boxes:
        is_inside |= (x > x_min - wing) & (x < x_max + wing) & (y > y_min - wing) & (y < y_max + wing)
    return is_inside
