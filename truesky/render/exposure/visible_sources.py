"""Select the catalogue rows that have light on a detector in a direct image, as sources to draw."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Bool, Float, Int
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from lake_schema.tables.strong_lenses import STRONG_LENSES
from truesky.fluxes import bulges, passbands
from truesky.fluxes.libraries import templates
from truesky.fluxes.passbands import Passband
from truesky.render.camera import astrometry
from truesky.render.camera.detectors import Detector
from truesky.render.camera.windows import Window
from truesky.render.channels import registry
from truesky.render.channels.aim import Aim, electron_rate
from truesky.render.dispersing.draw import DispersedSources
from truesky.render.drawing import outskirts, stamp_sizes, wings
from truesky.render.drawing.settings import Settings, settings_for
from truesky.render.effects.effect import Decision, decide
from truesky.render.effects.light import ground_ghosts
from truesky.render.effects.scene import NOTICEABLE, Lights, Scene
from truesky.render.exposure import bright_lights, scene_factory, standard_stars
from truesky.render.exposure.records import Rows, Variant
from truesky.render.psf import from_file, spikes, sub_bands
from truesky.render.psf.model import Psf, reduce_colours
from truesky.render.sources import (
    catalogue_rows,
    colours,
    disc_structure,
    galaxy_shapes,
    galaxy_stamps,
    lensed_arcs,
    nuclei,
    point_light,
    selection,
    solar_system,
    transients,
    varying_stars,
)
from truesky.render.sources.source_list import Sources

# Columns of the table `galaxies` that describe positions and light profiles; fluxes are in another table.
SHAPE_COLUMNS = ("id", "kind", "ra", "dec", *galaxy_shapes.COLUMNS)
GALAXY_COLUMNS = tuple(dict.fromkeys((*SHAPE_COLUMNS, galaxy_stamps.COLUMN, *colours.GALAXY_COLUMNS, *bulges.COLUMNS)))
STAR_COLUMNS = ("id", "ra", "dec", "pm_ra", "pm_dec", *colours.STAR_COLUMNS)
# Largest allowed number of expected electrons of a source. Light is summed in 64-bit integers, whose unit is coarser
# for brighter sources; for this number it is 1/16 electron.
_MAX_ELECTRONS = 1e17
# Galaxies larger than the largest stamp are drawn in a window where they have more than 1e-3 of the noise of a pixel,
# which is this multiple of the light that is noticeable on a detector. The smallest flux of supernovae and nuclei has
# the same factor.
_FAINT = 0.1
# Smallest total light with which a spectrum counts as noticeable: its electrons divided by the noise of a pixel
# (electrons rms). If all of this light is in one emission line, its signal-to-noise ratio is 0.7.
MIN_SPECTRUM_NOISE = 2.0


@dataclass(frozen=True, slots=True)
class Light:
    """Sources with light on a detector, and everything that is needed to draw them.

    Attributes
    ----------
    sources : Sources
        The n sources to draw.
    sizes : int array, shape (n,)
        Sides of the stamps (square images) on which the sources are drawn, pixels; 0 for spectra.
    neglected : float64 array, shape (n,)
        Size up to which samples of a source's Fourier transform may be neglected, as a fraction of its flux; 0 for
        spectra.
    psf : Psf or None
        PSF of the detector. None if the image has no light of the sky.
    scene : Scene
        Properties of the exposure on which effects depend, with bright sources on and around the detector.
    decisions : tuple of Decision
        For each effect that acts while sources are drawn, whether it is applied.
    dispersed : DispersedSources, optional
        Spectra of the sources, and spectral orders of the grism. None without a grism.
    spectrum_rows : int array, shape (n,)
        For spectra: index of each source's spectrum in the list of all galaxies followed by all stars in the catalogue
        rows; -1 for the Sun's spectrum. Empty without a grism.
    let_through : float64 array, shape (n,)
        For spectra: fraction of each source's light that is not vignetted by the grism. Empty without a grism.
    """

    sources: Sources
    sizes: Int
    neglected: Float
    psf: Psf | None
    scene: Scene
    decisions: tuple[Decision, ...] = ()
    dispersed: DispersedSources | None = None
    spectrum_rows: Int = field(default_factory=lambda: np.zeros(0, np.int64))
    let_through: Float = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, slots=True)
class CandidateSources:
    """Sources that may have light on a detector: first the galaxies, then the stars, then the gravitational arcs.

    Attributes
    ----------
    ids : int64 array, shape (n,)
        Identifiers.
    ra, dec : float array, shape (n,)
        Position in degrees.
    electrons : float array, shape (n,)
        Expected electrons.
    shape, picture : int64 array, shape (n,)
        Index in `form` (-1 for a source without a profile), and index in `pictures` (-1 for none).
    spectrum_rows : int64 array, shape (n,)
        Index of each source's spectrum in the list of all galaxies followed by all stars. An arc has that of its
        galaxy.
    form : Shapes
        Bulge and disc parameters of all galaxies, also of galaxies that are drawn as pictures.
    pictures : tuple of Picture
        Images that are drawn instead of profiles, of galaxies and arcs.
    """

    ids: Int
    ra: Float
    dec: Float
    electrons: Float
    shape: Int
    picture: Int
    spectrum_rows: Int
    form: galaxy_shapes.Shapes
    pictures: tuple[lensed_arcs.Picture, ...]


def list_candidates(rows: Rows, electrons: tuple[Float, Float]) -> CandidateSources:
    """Combine the galaxies, stars and arcs of catalogue rows into one list of sources that may be drawn.

    `electrons` are the expected electrons of the galaxies and of the stars. BadInput is raised if an identifier occurs
    twice, or if a number of electrons is NaN or not between 0 and 1e17.
    """
    catalogue, points = rows.galaxies, rows.stars
    form, n, stars = galaxy_shapes.shapes(catalogue), len(catalogue), len(points)
    arcs = _arcs(rows.lenses, catalogue, electrons[0], form)
    stamp, stamps = galaxy_stamps.assign_pictures(catalogue, _with_catalogue_bulges(form, rows), rows.stamps)
    ids = np.concatenate([catalogue["id"].to_numpy(), points["id"].to_numpy(), arcs.ids]).astype(np.int64)
    light = np.concatenate([*electrons, arcs.electrons])
    _check_sources(ids, light)
    return CandidateSources(
        ids,
        np.concatenate([catalogue["ra"].to_numpy(), points["ra"].to_numpy(), arcs.ra]),
        np.concatenate([catalogue["dec"].to_numpy(), points["dec"].to_numpy(), arcs.dec]),
        light,
        np.concatenate([np.where(stamp < 0, np.arange(n), -1), np.full(stars + len(arcs.ids), -1)]).astype(np.int64),
        np.concatenate([stamp, np.full(stars, -1), len(stamps) + np.arange(len(arcs.ids))]).astype(np.int64),
        # An arc is the image of a lensed galaxy and has the spectrum of this galaxy.
        np.concatenate([np.arange(n + stars), arcs.source]).astype(np.int64),
        form,
        (*stamps, *arcs.pictures),
    )


def visible_light(
    aim: Aim, rows: Rows, scene: Scene, seed: int, psf: Psf | None = None, noise: float | None = None
) -> Light:
    """Select all sources with light on a detector in a direct image, and choose the PSF and the stamp sizes.

    Parameters
    ----------
    aim : Aim
        Exposure and detector.
    rows : Rows
        Catalogue rows that may have light on the detector.
    scene : Scene
        Properties of the exposure before anything is drawn.
    seed : int
        Seed of the request, from which moving bodies are drawn.
    psf : Psf, optional
        PSF of the detector, if `exposure_psf` has computed it before.
    noise : float, optional
        Electrons rms per pixel, compared with which small light is neglected. By default the noise of a pixel in
        `scene`.

    Returns
    -------
    Light
        Sources, PSF and properties of the exposure. There are no sources and no PSF if the image type has no light of
        the sky.
    """
    if not aim.sees_sky:
        return Light(_no_sources(rows.galaxies), np.zeros(0, np.int64), np.zeros(0), None, scene)
    rows, column = rows_at_exposure(rows, aim, scene.mission), f"f_nu_{aim.exposure.band}"
    pairs = ((rows.galaxies, rows.galaxy_fluxes), (rows.stars, rows.star_fluxes))
    galaxies, stars = (
        row_fluxes(*pair, column) * electron_rate(aim.exposure) * scene.exposure_time_s for pair in pairs
    )
    settings, noise = settings_for(scene.accuracy), scene.pixel_noise if noise is None else noise
    psf = psf or exposure_psf(aim, scene, settings)
    if psf.planes is not None:
        psf = replace(psf, planes=replace(psf.planes, origin=(aim.drawn.column, aim.drawn.row)))
    sources, sizes = select_sources(rows, (galaxies, stars), aim, psf, noise, settings)
    moving_lights = Lights()
    if aim.channel.draws_moving_bodies:
        sources, sizes, moving_lights = _with_moving(
            (sources, sizes), aim, rows, scene.mission, psf, (noise, settings), seed
        )
    if aim.channel.has_scattered_light:
        catalogue_lights = bright_lights.catalogue_lights((rows.galaxies, galaxies), (rows.stars, stars), aim)
        scene = replace(scene, lights=catalogue_lights.concatenate(moving_lights))
    psf, decisions = _with_intra_pixel(aim, scene, psf, sources.electrons[touches_frame(sources, sizes, aim.drawn)])
    neglected = stamp_sizes.neglected_flux(sources.electrons, noise, settings)
    return Light(sources, sizes, neglected, psf, scene, decisions)


def rows_at_exposure(rows: Rows, aim: Aim, mission: MissionConfiguration) -> Rows:
    """Adapt catalogue rows to the band, the time and the calibration target of an exposure.

    Parameters
    ----------
    rows : Rows
        Catalogue rows.
    aim : Aim
        Exposure and detector.
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras).

    Returns
    -------
    Rows
        Rows with the bulge fractions of the exposure's band, with the positions and the fluxes of stars in the middle
        of the exposure, with the standard star of the exposure if it has one, and with the supernovae that shine then.

    Notes
    -----
    BadInput is raised by `with_standards` if the target of a calibration is not a standard star.
    """
    middle = aim.exposure.middle_mjd
    galaxies = bulges.with_fractions_in_band(rows.galaxies, aim.band, rows.galaxy_library or templates.galaxy_library())
    shares = np.asarray(rows.galaxies["bulge_fraction"].to_numpy(), float)
    bands = _bands_of_fluxes(rows.star_fluxes, aim)
    galaxy_fluxes = rows.galaxy_fluxes
    if rows.nuclei is not None:
        galaxy_fluxes = nuclei.quasar_fluxes(galaxy_fluxes, rows.nuclei.quasars, bands, middle)
    rows = replace(
        rows,
        galaxies=galaxies,
        galaxy_fluxes=galaxy_fluxes,
        stars=catalogue_rows.apply_proper_motion(rows.stars, middle),
        star_fluxes=varying_stars.fluxes_at(rows.stars, rows.star_fluxes, bands, middle),
        bulge_fractions=shares,
    )
    rows = standard_stars.with_standards(rows, aim, mission)
    return _with_changing_points(rows, aim, middle)


def _with_changing_points(rows: Rows, aim: Aim, mjd: float) -> Rows:
    """Add the supernovae and active nuclei that shine at a date to the stars, with their own spectra at the end."""
    points = [] if rows.transients is None else [transients.light_at(rows.transients, aim.band, mjd)]
    points += [] if rows.nuclei is None else [nuclei.light_at(rows.nuclei, aim.band, mjd)]
    for light in points:
        stars, fluxes = point_light.append_points(rows.stars, rows.star_fluxes, light, aim.exposure.band)
        spectra = light.spectra if rows.own_spectra is None else rows.own_spectra.followed_by(light.spectra)
        rows = replace(rows, stars=stars, star_fluxes=fluxes, own_spectra=spectra)
    return rows


def _bands_of_fluxes(fluxes: pa.Table, aim: Aim) -> dict[str, Passband]:
    """Return the passbands of the columns of a table of fluxes: the exposure's, and a built-in one if any."""
    names = [name.removeprefix("f_nu_") for name in fluxes.column_names if name.startswith("f_nu_")]
    return {name: aim.band if name == aim.exposure.band else passbands.load(name) for name in names}


def exposure_psf(aim: Aim, scene: Scene, settings: Settings) -> Psf:
    """Return the PSF of a detector, from the user's file if the exposure names one, otherwise from the channel's model.

    Parameters
    ----------
    aim : Aim
        Exposure and detector.
    scene : Scene
        Properties of the exposure, with the mission database.
    settings : Settings
        Drawing settings, which contain the number of positions on the detector and of colours for the PSF.

    Returns
    -------
    Psf
        PSF of the detector. BadInput is raised if a user's file is invalid (`psf.from_file.read`).
    """
    if aim.exposure.psf:
        path = from_file.path_for_detector(aim.exposure.psf, aim.detector.name)
        psf = from_file.read(path, aim.detector, aim.band, aim.wcs)
    else:
        psf = aim.channel.psf(aim.exposure, aim.detector, aim.band, scene.mission, settings.positions)
    return reduce_colours(psf, settings.colours)


def _with_intra_pixel(aim: Aim, scene: Scene, psf: Psf, electrons: Float) -> tuple[Psf, tuple[Decision, ...]]:
    """Add the variation of response inside a pixel (largest at its centre) to the PSF, if this effect is noticeable.

    Returns the PSF and the decision whether the effect is applied. The brightest pixel is estimated from `electrons`,
    the expected electrons of the sources on the detector.
    """
    effect = aim.channel.transfer_effect
    if effect is None:
        return psf, ()
    peak = float(psf.surface[0]) * float(electrons.max(initial=0.0))
    scene = replace(scene, peak_electrons=peak)
    decisions = decide((effect,), scene)
    if decisions[0].applied and psf.intra_pixel is not None:
        (strength,) = effect.parameters(scene)
        psf = replace(psf, intra_pixel=strength)
    return psf, decisions


def _no_sources(galaxies: pa.Table) -> Sources:
    empty, empty_int = np.zeros(0), np.zeros(0, np.int64)
    return Sources(
        empty_int, empty, empty, np.zeros((0, 2, 2)), empty, empty_int, galaxy_shapes.shapes(galaxies.slice(0, 0))
    )


@dataclass(frozen=True, slots=True)
class FluxLimits:
    """Fluxes (microjansky) above which sources outside a detector are read from the catalogue; infinite to read none.

    Attributes
    ----------
    min_flux : float
        Flux of the faintest source that is read from beyond the margin around the detector in which all sources are
        read. A fainter source would add less than the fraction `settings.Settings.edge` of the noise to a pixel. For
        spectra: flux of the faintest noticeable spectrum.
    spikes : float
        Flux of the faintest star whose diffraction spikes or ghosts are noticeable on the detector if it is more than
        2048 pixels away (`stamp_sizes.reach`).
    min_point_flux : float
        Flux below which supernovae and active nuclei on and near the detector are left out. All light of such a source
        is less than a tenth of what may be neglected in a pixel (`settings.Settings.edge`). The factor keeps the light
        small that a stack of many exposures lacks.
    far_galaxy : float
        Flux of the faintest galaxy whose outskirts are noticeable on the detector if it is more than 2048 pixels away.
    """

    min_flux: float = np.inf
    spikes: float = np.inf
    min_point_flux: float = np.inf
    far_galaxy: float = np.inf


def flux_limits(exposure: ExposureRow, detector: Detector, band: Passband, variant: Variant) -> FluxLimits:
    """Return the fluxes above which sources outside a detector, and supernovae on it, are read from the catalogue.

    Parameters
    ----------
    exposure : ExposureRow
        Row of the table `exposures`.
    detector : Detector
        Detector of the camera of this exposure.
    band : Passband
        Passband of the exposure.
    variant : Variant
        Mission database and accuracy; the effects that the request switches on or off are ignored.

    Returns
    -------
    FluxLimits
        The limits. All are infinite if sources have no light: in dark images and in exposures of 0 s.
    """
    time, channel = exposure.exposure_time_s, registry.CHANNELS[exposure.channel]
    if time == 0.0 or not channel.sees_sky(exposure.image_type):
        return FluxLimits()
    scene = replace(scene_factory.from_exposure(exposure, detector, variant.mission, variant.accuracy), band=band)
    noise, electrons = scene.pixel_noise, electron_rate(exposure) * time
    spikes_ = _spike_electrons(exposure, detector, band, variant.mission, noise) / electrons
    if channel.on_ground:
        spikes_ = min(spikes_, ground_ghosts.min_noticeable_electrons(scene) / electrons)
    settings = settings_for(variant.accuracy)
    min_point_flux = _FAINT * settings.edge * noise / electrons
    if channel.dispersion is not None:
        return FluxLimits(MIN_SPECTRUM_NOISE * noise / electrons, spikes_, min_point_flux)
    margin, scale = variant.mission.value("survey.selection_margin", "arcsec"), detector.pixel_scale
    return FluxLimits(
        stamp_sizes.min_noticeable_electrons(margin, scale, noise, settings) / electrons,
        spikes_,
        min_point_flux,
        outskirts.min_noticeable_electrons(stamp_sizes.reach(scale), scale, noise) / electrons,
    )


def _spike_electrons(
    exposure: ExposureRow, detector: Detector, band: Passband, mission: MissionConfiguration, noise: float
) -> float:
    """Return the electrons of the faintest star whose diffraction spikes are noticeable from far outside a detector.

    Far means more than 2048 pixels (`stamp_sizes.reach`), up to which all sources are considered. `noise` is that of a
    pixel, electrons rms. The result is infinite if the PSF has no spikes.
    """
    pupil_of = registry.CHANNELS[exposure.channel].diffraction_edges
    if pupil_of is None or exposure.psf:
        return np.inf
    pupil = pupil_of(detector, band, mission)
    if pupil is None:
        return np.inf
    (reach,) = spikes.reach(pupil, np.ones(1), NOTICEABLE * noise)
    return float((stamp_sizes.reach(1.0) / reach) ** 2)


def select_sources(
    rows: Rows, electrons: tuple[Float, Float], aim: Aim, psf: Psf, noise: float, settings: Settings
) -> tuple[Sources, Int]:
    """Select all sources at rest with noticeable light on a detector, and choose the sizes of their stamps.

    A stamp is the square image on which a source is drawn. Light that is drawn outside the stamp, such as diffraction
    spikes, also counts.

    Parameters
    ----------
    rows : Rows
        Catalogue rows that may have light on the detector.
    electrons : (float array, float array)
        Expected electrons of the galaxies and of the stars.
    aim : Aim
        Exposure and detector.
    psf : Psf
        PSF of the detector.
    noise : float
        Noise of a pixel, electrons rms.
    settings : Settings
        Limits for neglected light, which depend on the accuracy.

    Returns
    -------
    sources : Sources
        Sources by ascending identifier, without those of 0 electrons.
    sizes : int array, shape (n,)
        Sides of the stamps, pixels.
    """
    detector, drawn, candidates = aim.detector, aim.drawn, list_candidates(rows, electrons)
    light, shape, picture, form = candidates.electrons, candidates.shape, candidates.picture, candidates.form
    extra_reach = np.where((shape < 0) & (picture < 0), _spike_reach(light, detector, psf, noise), 0.0)
    extra_reach[: len(form)] = _outskirt_reach(light[: len(form)], form, detector, noise)
    stamp_reach, place = stamp_sizes.reach(detector.pixel_scale), (candidates.ra, candidates.dec)
    reach = detector.half_diagonal + np.maximum(extra_reach, stamp_reach)
    is_near = selection.within_radius(*place, astrometry.centre(detector, aim.wcs), reach / 3600.0) & (light > 0)
    if aim.window is not None:
        window_reach = (aim.half_diagonal + stamp_reach) / 3600.0
        is_near &= selection.within_radius(*place, aim.centre, window_reach) | (extra_reach > 0.0)
    indices = np.flatnonzero(is_near)[np.argsort(candidates.ids[is_near], kind="stable")]
    column, row = astrometry.pixel_of_sky(aim.wcs, candidates.ra[indices], candidates.dec[indices])
    picture_sides = (
        np.array([0.0, *(arc_picture.diagonal for arc_picture in candidates.pictures)])[picture[indices] + 1]
        / detector.pixel_scale
    )
    sizes = stamp_sizes.stamp_sizes(light[indices], shape[indices], form, psf, noise, settings, picture_sides)
    structure = np.append(disc_structure.sides(_with_catalogue_bulges(form, rows), rows.discs), 0.0)[shape[indices]]
    sizes = stamp_sizes.smallest_allowed_sizes(sizes, structure / detector.pixel_scale)
    sources = Sources(
        candidates.ids[indices],
        column,
        row,
        np.zeros((len(indices), 2, 2)),
        light[indices],
        shape[indices],
        form,
        None,
        picture[indices],
        candidates.pictures,
    )
    on_frame = stamp_sizes.touching_frame(sources, sizes, psf, noise, detector.nx, detector.ny)
    sources = replace(sources, column=column - drawn.column, row=row - drawn.row)
    if aim.window is not None:
        on_frame &= _reaches_window(sources, sizes, psf, noise, drawn)
    indices, sources = indices[on_frame], sources.take(on_frame)
    is_chromatic = psf.planes is not None and len(psf.planes.wavelength) > 1
    photons = _photon_fractions(candidates.spectrum_rows[indices], rows, aim.band) if is_chromatic else None
    jacobian = astrometry.jacobian(aim.wcs, column[on_frame], row[on_frame])
    sources = replace(sources, jacobian=jacobian, photons=photons)
    return disc_structure.add_structure(sources, _with_catalogue_bulges(form, rows), rows.discs), sizes[on_frame]


def _reaches_window(sources: Sources, sizes: Int, psf: Psf, noise: float, window: Window) -> Bool:
    """Return the mask [n] of the sources that may have light in a window, also light far below the `noise` of a pixel.

    The image of the whole detector contains such light if it is noticeable elsewhere on the detector. Galaxies larger
    than the largest stamp are left out where they have less than 1e-3 of the noise, because their outskirts take as
    long as all other sources of a small window.
    """
    sides = wings.region_side(np.maximum(sizes, psf.side).astype(float))
    return np.asarray(
        selection.overlaps_frame(sources.column, sources.row, sides, window.nx, window.ny)
        | stamp_sizes.has_far_light(sources.electrons, sizes, sources.shape, sources.picture, psf)
        | stamp_sizes.touching_frame(sources, sizes, psf, _FAINT * noise, window.nx, window.ny)
    )


def _with_catalogue_bulges(form: galaxy_shapes.Shapes, rows: Rows) -> galaxy_shapes.Shapes:
    """Return the shapes with the bulge fractions of the catalogue instead of the fractions in the exposure's band.

    Spiral arms and knots depend on the bulge fraction, and must be the same in all bands.
    """
    return form if rows.bulge_fractions is None else replace(form, bulge_fraction=rows.bulge_fractions)


def _spike_reach(electrons: Float, detector: Detector, psf: Psf, noise: float) -> Float:
    """Return the distance up to which diffraction spikes of each point source are noticeable, arcsec.

    `noise` is that of a pixel in electrons. All distances are 0 for a PSF without spikes.
    """
    if psf.edges is None:
        return np.zeros(len(electrons))
    return spikes.reach(psf.edges, electrons, NOTICEABLE * noise) * detector.pixel_scale


def _outskirt_reach(electrons: Float, form: galaxy_shapes.Shapes, detector: Detector, noise: float) -> Float:
    """Return the distance up to which each galaxy is noticeable, arcsec; 0 if it is less than 2048 pixels.

    Up to 2048 pixels (`stamp_sizes.reach`), all sources are considered anyway. `electrons` and `form` describe the
    galaxies. `noise` is that of a pixel in electrons rms.
    """
    out, min_reach = np.zeros(len(electrons)), stamp_sizes.reach(detector.pixel_scale)
    bright = np.flatnonzero(electrons > outskirts.min_noticeable_electrons(min_reach, detector.pixel_scale, noise))
    out[bright] = outskirts.reach(electrons[bright], form.take(bright), detector.pixel_scale, noise, min_reach)
    return out


def _arcs(
    lenses: pa.Table | None, galaxies: pa.Table, electrons: Float, form: galaxy_shapes.Shapes
) -> lensed_arcs.Arcs:
    """Return the gravitational arcs of strong lenses; `electrons` and `form` describe the galaxies.

    The light of an arc is computed from the light that the lensed galaxy would have without magnification.
    """
    rows = STRONG_LENSES.empty().select(lensed_arcs.ARC_COLUMNS) if lenses is None else lenses
    return lensed_arcs.arcs(rows, galaxies["id"].to_numpy(), electrons / form.magnification)


def _with_moving(
    fixed: tuple[Sources, Int],
    aim: Aim,
    rows: Rows,
    mission: MissionConfiguration,
    psf: Psf,
    noise_and_settings: tuple[float, Settings],
    seed: int,
) -> tuple[Sources, Int, Lights]:
    """Add the bodies of the Solar System to the sources at rest `fixed` (sources, sizes of stamps).

    `noise_and_settings` are the noise of a pixel, electrons rms, and the limits for neglected light.

    Returns the sources, with moving bodies at the end, since they have the largest identifiers; the sizes of their
    stamps in pixels; and bright bodies on and around the detector, which cause scattered light.
    """
    (sources, sizes), drawn, (noise, settings) = fixed, aim.drawn, noise_and_settings
    reach = (aim.half_diagonal + stamp_sizes.reach(aim.detector.pixel_scale)) / 3600.0
    bodies = solar_system.trailed_sources(aim, mission, seed, reach, sources.shapes, rows.bodies)
    bodies = replace(bodies, column=bodies.column - drawn.column, row=bodies.row - drawn.row)
    length = stamp_sizes.piece_length(bodies.trail_length)
    body_sizes = stamp_sizes.stamp_sizes(bodies.electrons, bodies.shape, bodies.shapes, psf, noise, settings, length)
    body_reach = stamp_sizes.visible_sides(
        bodies.electrons, body_sizes, bodies.shape, None, psf, noise, bodies.trail_length
    )
    on_detector = selection.overlaps_frame(bodies.column, bodies.row, body_reach, drawn.nx, drawn.ny) & (
        bodies.electrons > 0
    )
    if not on_detector.any():
        return sources, sizes, bright_lights.trail_lights(bodies)
    return (
        sources.with_moving(bodies.take(on_detector)),
        np.concatenate([sizes, body_sizes[on_detector]]),
        bright_lights.trail_lights(bodies),
    )


def touches_frame(sources: Sources, sizes: Int, drawn: Window) -> Bool:
    """Find the sources whose stamps (square images around the sources) overlap the drawn pixels of a detector.

    Parameters
    ----------
    sources : Sources
        The n sources.
    sizes : int array, shape (n,)
        Sides of the stamps, pixels. They are enlarged by the displacement of moving sources.
    drawn : Window
        Pixels of the detector that are drawn, in which the positions of the sources are counted.

    Returns
    -------
    bool array, shape (n,)
        True for sources whose stamps overlap these pixels.
    """
    return selection.overlaps_frame(sources.column, sources.row, sizes + sources.trail_length, drawn.nx, drawn.ny)


def _photon_fractions(spectrum_rows: Int, rows: Rows, band: Passband) -> Float:
    """Return the fraction of the photons of n sources in each sub-band of a passband [n, sub-bands].

    `spectrum_rows`, shape (n,), are indices in the list of all galaxies followed by all stars in `rows`.
    """
    of_galaxy = spectrum_rows < len(rows.galaxies)
    out = np.empty((len(spectrum_rows), sub_bands.N_SUB_BANDS))
    out[of_galaxy] = colours.galaxies(rows.galaxies.take(spectrum_rows[of_galaxy]), band, rows.galaxy_library)
    star = spectrum_rows[~of_galaxy] - len(rows.galaxies)
    out[~of_galaxy] = colours.stars(rows.stars.take(star), band, rows.stellar_library)
    if rows.own_spectra is not None:
        spectrum = star - (len(rows.stars) - rows.own_spectra.count)
        has_own_spectrum = np.flatnonzero(~of_galaxy)[spectrum >= 0]
        out[has_own_spectrum] = colours.spectrum_fractions(band, rows.own_spectra.compute(spectrum[spectrum >= 0]))
    return out


def _check_sources(ids: Int, electrons: Float) -> None:
    unique, counts = np.unique(ids, return_counts=True)
    if len(unique) != len(ids):
        raise BadInput(f"source {unique[np.argmax(counts > 1)]} occurs more than once, identifiers must be unique")
    bad = ~((electrons >= 0) & (electrons <= _MAX_ELECTRONS))
    if bad.any():
        raise BadInput(f"source {ids[np.argmax(bad)]}: electrons must be 0 to 1e17, got {electrons[np.argmax(bad)]}")


def row_fluxes(rows: pa.Table, fluxes: pa.Table, column: str) -> Float:
    """Return the fluxes of catalogue rows in one band.

    Parameters
    ----------
    rows : Table
        Catalogue rows.
    fluxes : Table
        Table with the fluxes of the same rows, in the same order.
    column : str
        Name of the column with the fluxes, such as "f_nu_euclid_y".

    Returns
    -------
    float64 array, shape (n,)
        f_nu in microjansky.

    Raises
    ------
    BadInput
        If the flux table does not have the column, or if its identifiers differ from the catalogue's.
    """
    if column not in fluxes.column_names:
        raise BadInput(f"the flux table has no column {column}; it has {', '.join(fluxes.column_names)}")
    if len(rows) != len(fluxes) or not np.array_equal(rows["id"].to_numpy(), fluxes["id"].to_numpy()):
        raise BadInput("the flux table must have the same rows as its catalogue, in the same order")
    return np.asarray(fluxes[column].to_numpy(), float)
