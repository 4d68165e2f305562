"""The catalogue rows that shine onto a detector, as sources to be drawn.

flux_limits     fluxes above which sources outside the detector are read
sources_of      the rows that shine onto the detector, as what is drawn
Listed, listed  all rows, as what may be drawn
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Bool, Float, Int
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from lake_schema.tables.strong_lenses import STRONG_LENSES
from truesky.fluxes import bulges
from truesky.fluxes.libraries import templates
from truesky.fluxes.passbands import Passband
from truesky.render.camera import astrometry
from truesky.render.camera.detectors import Detector
from truesky.render.channels import registry
from truesky.render.channels.aim import Aim, electron_rate
from truesky.render.dispersing.draw import DispersedSources
from truesky.render.drawing import outskirts, stamp_sizes
from truesky.render.drawing.settings import Settings, settings_for
from truesky.render.effects.effect import Decision, decide
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
    selection,
    solar_system,
)
from truesky.render.sources.source_list import Sources

# What is read of the catalogues; fluxes are read besides.
SHAPE_COLUMNS = ("id", "kind", "ra", "dec", *galaxy_shapes.COLUMNS)
GALAXY_COLUMNS = tuple(dict.fromkeys((*SHAPE_COLUMNS, galaxy_stamps.COLUMN, *colours.GALAXY_COLUMNS, *bulges.COLUMNS)))
STAR_COLUMNS = ("id", "ra", "dec", "pm_ra", "pm_dec", *colours.STAR_COLUMNS)
# Of a source: more would leave the frame's integers to a tenth of an electron (fourier.units_of).
_MAX_ELECTRONS = 1e17
# Light of a spectrum that may be noticed, of a pixel's noise: all in one line it has a signal-to-noise ratio of 0.7.
MIN_SPECTRUM_NOISE = 2.0


@dataclass(frozen=True, slots=True)
class Light:
    """What shines onto a detector.

    sources, sizes : and int[n] sides of their stamps
    neglected : float64[n] Fourier samples that may be left out
    psf       : None in the dark
    scene     : with bright sources on and about the detector
    decisions : of effects that act while sources are drawn
    dispersed : what a grism makes of the sources; None: there is none
    of        : int[n] whose spectrum each has: the row, counted from the galaxies on to the stars; -1 = the Sun's
    let_through : float64[n] part of its light that the grism lets through
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
    """Galaxies, stars and arcs, [n] each; form : of all galaxies, those that are drawn as pictures among them.

    electrons : expected;  shape, picture : as of Sources
    of        : whose spectrum each has, counted from the galaxies on to the stars
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
    """All rows, as what may be drawn; electrons : expected of each of the galaxies, and of the stars.

    Errors : BadInput where a source is given twice, or shines too brightly
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
        # Arcs have the colour of what they are an image of.
        np.concatenate([np.arange(n + stars), arcs.source]).astype(np.int64),
        form,
        (*stamps, *arcs.pictures),
    )


def visible_light(aim: Aim, rows: Rows, scene: Scene, seed: int) -> Light:
    """All that shines onto a detector, or nothing where it does not see the sky.

    aim   : the exposure and detector;  rows : catalogue rows that it may see
    scene : before anything is drawn;  seed : of the request
    """
    if not aim.sees_sky:
        return Light(_no_sources(rows.galaxies), np.zeros(0, np.int64), np.zeros(0), None, scene)
    rows, column = rows_at_exposure(rows, aim, scene.mission), f"f_nu_{aim.exposure.band}"
    pairs = ((rows.galaxies, rows.galaxy_fluxes), (rows.stars, rows.star_fluxes))
    galaxies, stars = (
        row_fluxes(*pair, column) * electron_rate(aim.exposure) * scene.exposure_time_s for pair in pairs
    )
    settings, noise = settings_for(scene.accuracy), scene.pixel_noise
    psf = exposure_psf(aim, scene, settings)
    sources, sizes = select_sources(rows, (galaxies, stars), aim, psf, noise, settings)
    moving_lights = Lights()
    if aim.channel.draws_moving_bodies:
        sources, sizes, moving_lights = _with_moving((sources, sizes), aim, rows, scene, psf, settings, seed)
    if aim.channel.has_scattered_light:
        catalogue_lights = bright_lights.catalogue_lights((rows.galaxies, galaxies), (rows.stars, stars), aim.wcs)
        scene = replace(scene, lights=catalogue_lights.concatenate(moving_lights))
    psf, decisions = _with_intra_pixel(
        aim, scene, psf, sources.electrons[touches_detector(sources, sizes, aim.detector)]
    )
    neglected = stamp_sizes.neglected_flux(sources.electrons, noise, settings)
    return Light(sources, sizes, neglected, psf, scene, decisions)


def rows_at_exposure(rows: Rows, aim: Aim, mission: MissionConfiguration) -> Rows:
    """Rows as an exposure sees them.

    Bulges have their share of the light in its band, stars are where they are in its middle, and the standard star's
    is there if it is of one.

    rows : of the catalogues;  aim : the exposure and detector;  mission : the mission database
    Errors : BadInput for a target that is no standard star
    """
    middle = aim.exposure.mjd + 0.5 * aim.exposure.exposure_time_s / 86400.0
    galaxies = bulges.with_fractions_in_band(rows.galaxies, aim.band, rows.galaxy_library or templates.galaxy_library())
    shares = np.asarray(rows.galaxies["bulge_fraction"].to_numpy(), float)
    rows = replace(
        rows, galaxies=galaxies, stars=catalogue_rows.apply_proper_motion(rows.stars, middle), bulge_fractions=shares
    )
    return standard_stars.with_standards(rows, aim, mission)


def exposure_psf(aim: Aim, scene: Scene, settings: Settings) -> Psf:
    """The exposure's own, or its channel's; of as many places and colours as the settings say."""
    if aim.exposure.psf:
        psf = from_file.read(from_file.path_for_detector(aim.exposure.psf, aim.detector.name), aim.detector, aim.band)
    else:
        psf = aim.channel.psf(aim.exposure, aim.detector, aim.band, scene.mission, settings.positions)
    return reduce_colours(psf, settings.colours)


def _with_intra_pixel(aim: Aim, scene: Scene, psf: Psf, electrons: Float) -> tuple[Psf, tuple[Decision, ...]]:
    """(PSF with the effect that acts while sources are drawn, decision); electrons : of what is on the frame."""
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
    """Fluxes above which a source outside the detector is read from the catalogue, microjansky; infinite: none is.

    Attributes
    ----------
    least : float
        Faintest source that reaches the detector from beyond its selection margin. Each fainter source leaves out less
        than the settings' `edge` of a pixel's noise.
    spikes : float
        Faintest star whose spikes are noticed from farther out.
    far_galaxy : float
        Faintest galaxy that is noticed from farther out.
    """

    min_flux: float = np.inf
    spikes: float = np.inf
    far_galaxy: float = np.inf


def flux_limits(exposure: ExposureRow, detector: Detector, band: Passband, variant: Variant) -> FluxLimits:
    """Fluxes above which sources outside a detector are read.

    Parameters
    ----------
    exposure : ExposureRow
        Exposure.
    detector : Detector
        Detector of its camera.
    band : Passband
        Passband of the exposure.
    variant : Variant
        Mission and accuracy.

    Returns
    -------
    FluxLimits
        The limits. All are infinite if no source is seen: in the dark, or in an exposure of 0 s.
    """
    time, channel = exposure.exposure_time_s, registry.CHANNELS[exposure.channel]
    if time == 0.0 or not channel.sees_sky(exposure.image_type):
        return FluxLimits()
    noise = scene_factory.from_exposure(exposure, detector, variant.mission, variant.accuracy).pixel_noise
    electrons = electron_rate(exposure) * time
    spikes_ = _spike_electrons(exposure, detector, band, variant.mission, noise) / electrons
    if channel.dispersion is not None:
        return FluxLimits(MIN_SPECTRUM_NOISE * noise / electrons, spikes_)
    margin, scale = variant.mission.value("survey.selection_margin", "arcsec"), detector.pixel_scale
    return FluxLimits(
        stamp_sizes.min_noticeable_electrons(margin, scale, noise, settings_for(variant.accuracy)) / electrons,
        spikes_,
        outskirts.min_noticeable_electrons(stamp_sizes.reach(scale), scale, noise) / electrons,
    )


def _spike_electrons(
    exposure: ExposureRow, detector: Detector, band: Passband, mission: MissionConfiguration, noise: float
) -> float:
    """Electrons of the faintest star whose spikes are noticed from beyond the reach of stamps; or infinite."""
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
    """Everything that shines onto the detector, with its stamp or beyond it, ascending id, and the stamps' sides.

    electrons : expected of each of the galaxies, and of the stars;  noise : of a pixel, e-
    rows : catalogue rows that the detector may see;  aim : the exposure and detector
    psf  : of the detector;  settings : of the accuracy
    """
    detector, wcs, candidates = aim.detector, aim.wcs, list_candidates(rows, electrons)
    light, shape, picture, form = candidates.electrons, candidates.shape, candidates.picture, candidates.form
    extra_reach = np.where((shape < 0) & (picture < 0), _spike_reach(light, detector, psf, noise), 0.0)
    extra_reach[: len(form)] = _outskirt_reach(light[: len(form)], form, detector, noise)
    reach = detector.half_diagonal + np.maximum(extra_reach, stamp_sizes.reach(detector.pixel_scale))
    is_near = selection.within_radius(
        candidates.ra, candidates.dec, astrometry.centre(detector, wcs), reach / 3600.0
    ) & (light > 0)
    indices = np.flatnonzero(is_near)[np.argsort(candidates.ids[is_near], kind="stable")]
    column, row = astrometry.pixel_of_sky(wcs, candidates.ra[indices], candidates.dec[indices])
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
    indices, sources = indices[on_frame], sources.take(on_frame)
    is_chromatic = psf.planes is not None and len(psf.planes.wavelength) > 1
    photons = _photon_fractions(candidates.spectrum_rows[indices], rows, aim.band) if is_chromatic else None
    jacobian = astrometry.jacobian(wcs, sources.column, sources.row)
    sources = replace(sources, jacobian=jacobian, photons=photons)
    return disc_structure.add_structure(sources, _with_catalogue_bulges(form, rows), rows.discs), sizes[on_frame]


def _with_catalogue_bulges(form: galaxy_shapes.Shapes, rows: Rows) -> galaxy_shapes.Shapes:
    """Galaxies with what they have of bulges in the catalogue: what they look like is not another thing in a band."""
    return form if rows.bulge_fractions is None else replace(form, bulge_fraction=rows.bulge_fractions)


def _spike_reach(electrons: Float, detector: Detector, psf: Psf, noise: float) -> Float:
    """[n] arcsec as far as which points' spikes are noticed."""
    if psf.edges is None:
        return np.zeros(len(electrons))
    return spikes.reach(psf.edges, electrons, NOTICEABLE * noise) * detector.pixel_scale


def _outskirt_reach(electrons: Float, form: galaxy_shapes.Shapes, detector: Detector, noise: float) -> Float:
    """[n] arcsec as far as which galaxies are noticed that may be from beyond what else is read, 0 of others."""
    out, min_reach = np.zeros(len(electrons)), stamp_sizes.reach(detector.pixel_scale)
    bright = np.flatnonzero(electrons > outskirts.min_noticeable_electrons(min_reach, detector.pixel_scale, noise))
    out[bright] = outskirts.reach(electrons[bright], form.take(bright), detector.pixel_scale, noise, min_reach)
    return out


def _arcs(
    lenses: pa.Table | None, galaxies: pa.Table, electrons: Float, form: galaxy_shapes.Shapes
) -> lensed_arcs.Arcs:
    """Those of strong lenses: their pictures magnify what the galaxy shines by itself."""
    rows = STRONG_LENSES.empty().select(lensed_arcs.ARC_COLUMNS) if lenses is None else lenses
    return lensed_arcs.arcs(rows, galaxies["id"].to_numpy(), electrons / form.magnification)


def _with_moving(
    fixed: tuple[Sources, Int], aim: Aim, rows: Rows, scene: Scene, psf: Psf, settings: Settings, seed: int
) -> tuple[Sources, Int, Lights]:
    """The sources with those that move, whose identifiers are the largest; and bright ones around, as far as read."""
    (sources, sizes), detector = fixed, aim.detector
    reach = (detector.half_diagonal + stamp_sizes.reach(detector.pixel_scale)) / 3600.0
    bodies = solar_system.trailed_sources(aim, scene.mission, seed, reach, sources.shapes, rows.bodies)
    length = stamp_sizes.piece_length(bodies.trail_length)
    body_sizes = stamp_sizes.stamp_sizes(
        bodies.electrons, bodies.shape, bodies.shapes, psf, scene.pixel_noise, settings, length
    )
    body_reach = stamp_sizes.visible_sides(
        bodies.electrons, body_sizes, bodies.shape, None, psf, scene.pixel_noise, bodies.trail_length
    )
    on_detector = selection.overlaps_frame(bodies.column, bodies.row, body_reach, detector.nx, detector.ny) & (
        bodies.electrons > 0
    )
    if not on_detector.any():
        return sources, sizes, bright_lights.trail_lights(bodies)
    return (
        sources.with_moving(bodies.take(on_detector)),
        np.concatenate([sizes, body_sizes[on_detector]]),
        bright_lights.trail_lights(bodies),
    )


def touches_detector(sources: Sources, sizes: Int, detector: Detector) -> Bool:
    """Sources with a stamp on the detector."""
    return selection.overlaps_frame(sources.column, sources.row, sizes + sources.trail_length, detector.nx, detector.ny)


def _photon_fractions(spectrum_rows: Int, rows: Rows, band: Passband) -> Float:
    """Photon fractions of the rows that are drawn; `kept` counts on from the galaxies to the stars."""
    of_galaxy = spectrum_rows < len(rows.galaxies)
    out = np.empty((len(spectrum_rows), sub_bands.N_SUB_BANDS))
    out[of_galaxy] = colours.galaxies(rows.galaxies.take(spectrum_rows[of_galaxy]), band, rows.galaxy_library)
    out[~of_galaxy] = colours.stars(
        rows.stars.take(spectrum_rows[~of_galaxy] - len(rows.galaxies)), band, rows.stellar_library
    )
    return out


def _check_sources(ids: Int, electrons: Float) -> None:
    if len(np.unique(ids)) != len(ids):
        raise BadInput("a source is given twice")
    bad = ~((electrons >= 0) & (electrons <= _MAX_ELECTRONS))
    if bad.any():
        raise BadInput(f"source {ids[np.argmax(bad)]}: {electrons[np.argmax(bad)]} electrons, outside 0 .. 1e17")


def row_fluxes(rows: pa.Table, fluxes: pa.Table, column: str) -> Float:
    """float64[n] f_nu of catalogue rows, microjansky; BadInput where the flux table is not of the same rows."""
    if column not in fluxes.column_names:
        raise BadInput(f"the flux table has no column {column}")
    if len(rows) != len(fluxes) or not np.array_equal(rows["id"].to_numpy(), fluxes["id"].to_numpy()):
        raise BadInput("the flux table is not of the same rows as its catalogue")
    return np.asarray(fluxes[column].to_numpy(), float)
