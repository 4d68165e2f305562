"""The catalogue rows whose spectra lie on a detector, as sources to be spread out.

An order puts a source's light far from its undispersed image: what is read is told by where that must lie for some of
its light to be on the detector, a rectangle for each order.

visible_spectra   all that shines onto a detector
orders            by which a grism puts it there
beyond            how far beyond a detector sources lie whose light is on it
bands             whose fluxes tell which sources are drawn
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
from truesky.render.dispersing.draw import Dispersed, Order
from truesky.render.effects.scene import Scene
from truesky.render.exposure import visible_sources
from truesky.render.exposure.records import Rows
from truesky.render.exposure.visible_sources import LEAST_SPECTRUM, Light, Listed
from truesky.render.sky.diffuse_light import solar
from truesky.render.sources import selection, solar_system, spectra
from truesky.render.sources.source_list import Sources

# Pixels beside a detector from which a spectrum still sends light in: of any source, and of a bright one, e-.
_WING, _FAR_WING, _BRIGHT = 64.0, 256.0, 1e6
# Of the optics' scale across the field, which sources are looked for a little farther for.
_DISTORTION = 1.02
_HALPHA = "flux_halpha"


def visible_spectra(aim: Aim, rows: Rows, scene: Scene, seed: int) -> Light:
    """All sources whose light a grism puts onto a detector that sees the sky.

    aim    : the exposure and detector;  rows : catalogue rows that it may see
    scene  : before anything is drawn;  seed : of the request
    Errors : BadInput for a PSF of the user's
    """
    exposure, mission, band, dispersion = aim.exposure, scene.mission, aim.band, _of(aim)
    if exposure.psf:
        raise BadInput(f"exposure {exposure.exposure_id}: psf: spectra are drawn through the camera's own PSF alone")
    rows, settings = visible_sources.rows_of(rows, aim, mission), draw.settings_for(scene.accuracy)
    found = orders(aim, mission, seed)
    traced = tuple(order.trace for order in found)
    sources, which = _sources(aim, rows, scene, _rectangles(traced, aim.detector, band), seed)
    left = dispersion.vignetted(exposure, aim.detector, sources.column, sources.row, mission)
    sources = replace(sources, electrons=sources.electrons * left)
    sun = solar(band.wavelength / 10.0, mission)
    own = spectra.of_rows(which, rows.galaxies, rows.stars, band, sun, (rows.library, rows.stellar))
    nodes = images.nodes(traced[0].first, traced[0].last, settings.nodes)
    psf = dispersion.psf(aim.detector, nodes, mission, settings.positions)
    none = np.zeros(len(sources))
    dispersed = Dispersed(own, found, settings)
    return Light(
        sources, none.astype(np.int64), none, psf, scene, dispersed=dispersed, of=which, let_through=left
    )  # fmt: skip


def orders(aim: Aim, mission: MissionConfiguration, seed: int) -> tuple[Order, ...]:
    """Of the grism: what each detects of f_lambda on the scale of `sources.spectra`, A.

    aim : the exposure and detector;  mission : the exposure's;  seed : of the request
    """
    dispersion, band, exposure = _of(aim), aim.band, aim.exposure
    found = []
    for trace in dispersion.traces(exposure, aim.detector, mission, seed):
        light = dispersion.throughput(exposure, trace.order, band.wavelength, aim.detector, mission)
        found.append(Order(trace, int(band.wavelength[0]), band.response * band.wavelength * light))
    return tuple(found)


def beyond(
    exposure: ExposureRow, detector: Detector, mission: MissionConfiguration, band: Passband, seed: int
) -> float:
    """How far beyond a detector's circle sources lie whose light of some order is on it, arcsec; 0 without a grism.

    exposure, detector, mission, band : its row, the detector, the mission database and the passband
    seed : of the request
    """
    channel = registry.CHANNELS[exposure.channel]
    if channel.disperses is None or not channel.sees_sky(exposure.image_type):
        return 0.0
    boxes = _rectangles(channel.disperses.traces(exposure, detector, mission, seed), detector, band)
    return max(_radius(boxes, detector) - detector.half_diagonal, 0.0)


def bands(exposure: ExposureRow, known: Sequence[str]) -> list[str]:
    """An exposure's own, and that in which sources are chosen where its fluxes are known.

    exposure : its row;  known : columns of the table of fluxes
    """
    dispersion = registry.CHANNELS[exposure.channel].disperses
    more = [] if dispersion is None or f"f_nu_{dispersion.chosen_by}" not in known else [dispersion.chosen_by]
    return [exposure.band, *more]


def _of(aim: Aim) -> Dispersion:
    assert aim.channel.disperses is not None
    return aim.channel.disperses


def _rectangles(found: tuple[Trace, ...], detector: Detector, band: Passband) -> Float:
    """float64[orders, 4] pixels: left, right, low, high of undispersed images."""
    ends = float(band.wavelength[0]), float(band.wavelength[-1])
    return np.array([traces.source_rectangle(trace, detector.nx, detector.ny, ends) for trace in found])


def _radius(boxes: Float, detector: Detector) -> float:
    """arcsec from a detector's centre that holds the rectangles."""
    across = np.abs(boxes[:, :2] - (detector.nx - 1) / 2).max(axis=1)
    up = np.abs(boxes[:, 2:] - (detector.ny - 1) / 2).max(axis=1)
    return float(np.hypot(across + _FAR_WING, up + _FAR_WING).max()) * detector.pixel_scale * _DISTORTION


def _sources(aim: Aim, rows: Rows, scene: Scene, boxes: Float, seed: int) -> tuple[Sources, Int]:
    """(sources in the rectangles, ascending id, those that move behind; whose spectrum each has)."""
    detector, system, column = aim.detector, aim.wcs, f"f_nu_{aim.exposure.band}"
    pairs = ((rows.galaxies, rows.galaxy_fluxes), (rows.stars, rows.star_fluxes))
    factor = electron_rate(aim.exposure) * scene.exposure_time_s
    galaxies, stars = (visible_sources.fluxes_of(*pair, column) * factor for pair in pairs)
    every = visible_sources.listed(rows, (galaxies, stars))
    reach = _radius(boxes, detector) / 3600.0
    centre = astrometry.centre(detector, system)
    seen = selection.near(every.ra, every.dec, centre, reach) & _selected(every, rows, aim, scene)
    kept = np.flatnonzero(seen)[np.argsort(every.ids[seen], kind="stable")]
    x, y = astrometry.pixel_of_sky(system, every.ra[kept], every.dec[kept])
    here = _inside(x, y, every.electrons[kept], np.zeros(len(kept)), boxes)
    kept, x, y = kept[here], x[here], y[here]
    found = Sources(
        every.ids[kept], x, y, astrometry.jacobian(system, x, y), every.electrons[kept], every.shape[kept], every.form,
        None, every.picture[kept], every.pictures,
    )  # fmt: skip
    which = every.of[kept]
    if not aim.channel.moving:
        return found, which
    bodies = solar_system.sources(aim, scene.mission, seed, reach, found.shapes, rows.bodies)
    shining = bodies.electrons > LEAST_SPECTRUM * scene.pixel_noise
    here = shining & _inside(bodies.column, bodies.row, bodies.electrons, bodies.length, boxes)
    if not here.any():
        return found, which
    moving = replace(bodies.take(here), photons=None)
    return replace(found.with_moving(moving), photons=None), np.append(which, np.full(len(moving), -1))


def _selected(every: Listed, rows: Rows, aim: Aim, scene: Scene) -> Bool:
    """[n] What may be noticed; or what Serrano et al. 2024 drew, where the mission says so.

    Error : where the fluxes in the band that these were chosen in are not known, those in the exposure's own band tell
    """
    if scene.value("spectra.selection", "") < 0.5:
        return np.asarray(every.electrons > LEAST_SPECTRUM * scene.pixel_noise)
    tables = rows.galaxy_fluxes, rows.star_fluxes
    column = f"f_nu_{_of(aim).chosen_by}"
    if not all(column in table.column_names for table in tables):
        column = f"f_nu_{aim.exposure.band}"
    own = f"f_nu_{aim.exposure.band}"
    f_nu, seen = (np.concatenate([table[name].to_numpy() for table in tables]) for name in (column, own))
    # A standard star has no fluxes but in the exposure's band.
    f_nu = np.where(np.isnan(f_nu), seen, f_nu)
    bright = f_nu >= 10.0 ** (0.4 * (units.AB_UJY - scene.value("spectra.faintest", "mag")))
    if _HALPHA in rows.galaxies.column_names:
        bright[: len(rows.galaxies)] |= _line_seen(rows) >= scene.value("spectra.faintest_line", "erg / (s cm2)")
    return np.asarray(bright[every.of] & (every.electrons > 0.0))


def _line_seen(rows: Rows) -> Float:
    """[galaxies] erg s-1 cm-2 of H alpha as it is observed: magnified, behind the Milky Way's dust; 0 of no line."""
    flux = np.nan_to_num(rows.galaxies[_HALPHA].to_numpy(zero_copy_only=False).astype(float))
    (some,) = np.nonzero(flux > 0.0)
    shining = rows.galaxies.take(some)
    flux[some] *= checked.magnification_of(shining)
    if {"z_obs", "a_v"} <= set(shining.column_names):
        vacuum = next(line.vacuum for line in lines.line_list() if line.column == _HALPHA)
        at = lines.observed_wavelength(np.full(len(some), vacuum), checked.column(shining, "z_obs"), "vacuum")
        flux[some] *= extinction.transmitted(extinction.milky_way(at), checked.column(shining, "a_v"))
    return np.asarray(flux)


def _inside(x: Float, y: Float, electrons: Float, length: Float, boxes: Float) -> Bool:
    """[n] Undispersed images of which some order sends light onto the detector."""
    wing = np.where(electrons > _BRIGHT, _FAR_WING, _WING) + length / 2
    found = np.zeros(len(x), bool)
    for left, right, low, high in boxes:
        found |= (x > left - wing) & (x < right + wing) & (y > low - wing) & (y < high + wing)
    return found
