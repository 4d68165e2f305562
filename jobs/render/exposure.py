"""One detector of one exposure: catalogue rows in, a raw image and its noise-free truth out.

render          the whole of it
numbers_of      whose random numbers an effect takes
least_flux      what a source beyond the margin must have to be read
spike_flux, outer_flux   and a star, a galaxy still farther out
sources_of      the rows that shine onto the detector, as what is drawn
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from astropy.wcs import WCS

from jobs import rng
from jobs.accuracy import Accuracy
from jobs.fluxes import passbands
from jobs.fluxes.passbands import Passband
from jobs.fluxes.templates import Library
from jobs.render import (
    chromatic,
    costs,
    edges,
    exposing,
    focal_plane,
    moving,
    outskirts,
    own_psf,
    pictures,
    profiles,
    psf,
    selection,
    stamps,
    truth_maps,
)
from jobs.render.channels import ext, vis
from jobs.render.effects import calibration_lamp, charge_injection, cosmic_rays, quadrants
from jobs.render.effects.effect import NOTICEABLE, Decision, Effect, Lights, Scene, apply_all, decide
from jobs.render.focal_plane import Detector
from jobs.render.psf import Psf
from jobs.render.stamps import Settings, Sources
from lake_schema import units
from lake_schema.errors import BadInput
from lake_schema.ids import kind_of
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.strong_lenses import STRONG_LENSES

Float = npt.NDArray[np.float64]
Row = Mapping[str, Any]

# What is read of the catalogues; fluxes are read besides.
GALAXY_COLUMNS = tuple(
    dict.fromkeys(("id", "kind", "ra_lensed", "dec_lensed", *profiles.COLUMNS, *chromatic.GALAXY_COLUMNS))
)
STAR_COLUMNS = ("id", "ra", "dec", *chromatic.STAR_COLUMNS)
# Memory of a task, bytes: what an executor's core may count on.
_MOST_BYTES = 2e9
# And its drawing's time, CPU s: a scene that takes longer is a mistake.
_MOST_SECONDS = 6 * 3600.0
EFFECTS: Mapping[str, Mapping[str, tuple[Effect, ...]]] = {"VIS": vis.EFFECTS, "EXT": ext.EFFECTS}
# What fills pixels besides the sky and its sources.
_LAMPS = (calibration_lamp.EFFECT, charge_injection.EFFECT, charge_injection.NOISE)
# What crosses it besides light: its tracks are squeezed, and left behind, in the dark, too.
_RAYS = (cosmic_rays.EFFECT, cosmic_rays.READOUT)
# Of a source: more would leave the frame's integers to a tenth of an electron (kernel.units_of).
_MOST_ELECTRONS = 1e17
# Electrons of a source that may shine where it is not.
_LIGHT = 1e6
# Pixels of a trail that shine around corners as a point.
_PIECE = 32.0
# Code of a star in an identifier.
_STAR = 5


@dataclass(frozen=True, slots=True)
class Rendered:
    """One detector's products before they are files.

    raw        : uint16[ny, nx] ADU, or [4, ny, nx] quadrants in readout order with pre- and overscan
    maps       : truth [ny, nx] by its name: noise_free, and what was asked for besides
    sources    : what was drawn, ascending id: those with light of their stamps on pixels that are read, and stars whose
                 spikes may be noticed
    sizes      : int[n] sides of their stamps;  drawn : float64[n] electrons of each stamp on the detector
    zero_point : AB magnitude of one electron per second
    complete   : how far beyond the detector every source was known that may reach it, arcsec
    """

    exposure: Row
    detector: Detector
    wcs: WCS
    psf: Psf | None
    raw: npt.NDArray[np.uint16]
    maps: Mapping[str, npt.NDArray[Any]]
    sources: Sources
    sizes: stamps.Int
    drawn: Float
    zero_point: float
    scene: Scene
    decisions: tuple[Decision, ...]
    accuracy: Accuracy
    seed: int
    complete: float

    @property
    def science(self) -> npt.NDArray[np.uint16]:
        """uint16[ny, nx] ADU: the pixels alone, in the detector's own axes."""
        return self.raw if self.raw.ndim == 2 else quadrants.assembled(self.raw, *quadrants.sizes(self.scene))

    @property
    def noise_free(self) -> npt.NDArray[np.float32]:
        """float32[ny, nx] expected electrons of the sources alone."""
        return self.maps["noise_free"]


def render(
    task: Row,
    exposure: Row,
    galaxies: pa.Table,
    galaxy_fluxes: pa.Table,
    stars: pa.Table,
    star_fluxes: pa.Table,
    mission: MissionConfiguration,
    accuracy: Accuracy,
    seed: int,
    forced: Mapping[str, bool] | None = None,
    detector: Detector | None = None,
    progress: Callable[[int], None] | None = None,
    library: Library | None = None,
    stellar: Library | None = None,
    passband: Passband | None = None,
    complete: float = 0.0,
    truth: Sequence[str] = (),
    lenses: pa.Table | None = None,
    bodies: Callable[[int], moving.Population] | None = None,
) -> Rendered:
    """Render one detector.

    task, exposure : rows of the tables `tasks` and `exposures`
    galaxies ..    : rows that may touch the detector (GALAXY_COLUMNS, STAR_COLUMNS) and, row by row, their
                     f_nu in the band
    forced         : effect name -> on or off, instead of what the scene needs
    library        : what the galaxies' sed_1 and sed_2 count, stellar : what the stars' sed, None = the embedded ones
    passband       : the exposure's, None = the embedded one of its name
    detector       : another geometry than the mission's for task["detector"], e.g. a part of it
    complete       : how far beyond the detector the rows have every source, arcsec; for the header
    truth          : maps that are wanted besides the noise-free one, of lake_schema.tables.products.CONTENTS
    lenses         : rows of `strong_lenses` (pictures.ARC_COLUMNS) whose sources are among the galaxies
    bodies         : a day's moving bodies (own_bodies.Bodies.of_day), None = the embedded population
    """
    camera, band, channel = str(exposure["camera"]), str(exposure["band"]), str(exposure["channel"])
    passband = passband or passbands.load(band)
    effects = effects_of(channel, str(exposure["image_type"]), f"exposure {exposure['exposure_id']}")
    if detector is None:
        detector = focal_plane.detector(camera, str(task["detector"]), mission)
    system = focal_plane.wcs(detector, exposure["ra"], exposure["dec"], exposure["position_angle"])
    zero_point, scene = float(exposure["zero_point"]), scene_of(exposure, detector, mission, accuracy)
    scene = replace(scene, band=passband, forced=forced or {})
    decisions: tuple[Decision, ...] = ()
    spread: Psf | None = None
    maps: dict[str, npt.NDArray[Any]] = {}
    sources, sizes, drawn = _no_sources(galaxies), np.zeros(0, np.int64), np.zeros(0)
    if exposing.sees_sky(channel, str(exposure["image_type"])):
        electrons = [
            _fluxes(rows, fluxes, f"f_nu_{band}") * _rate(exposure) * scene.exposure_time_s
            for rows, fluxes in ((galaxies, galaxy_fluxes), (stars, star_fluxes))
        ]
        settings = stamps.settings_for(accuracy)
        spread = psf.of_colours(_psf(exposure, detector, passband, mission, settings.positions), settings.colours)
        sources, sizes = sources_of(
            (galaxies, electrons[0]), (stars, electrons[1]), detector, system, spread, scene.pixel_noise, settings,
            passband, library, stellar, lenses,
        )  # fmt: skip
        if channel == "VIS":
            sources, sizes, bright = _with_moving(
                sources, sizes, exposure, detector, system, passband, scene, spread, settings, seed, bodies
            )
            lights = _lights((galaxies, electrons[0]), (stars, electrons[1]), detector, system).and_those(bright)
            brightest = sources.electrons[_touching(sources, sizes, detector)].max(initial=0.0)
            peak = float(spread.surface[0]) * float(brightest)
            scene = replace(scene, lights=lights, peak_electrons=peak)
            decisions = decide((vis.DRAWN,), scene)
            if decisions[0].applied and spread.intra_pixel is not None:
                (strength,) = vis.DRAWN.parameters(scene)
                spread = replace(spread, intra_pixel=strength)
        _refuse_too_large(exposure, detector, sources, sizes, spread)
        floors = stamps.floors(sources.electrons, scene.pixel_noise, settings)
        drawn = np.zeros(len(sources))
        noise_free = stamps.draw(
            sources, sizes, spread, detector.nx, detector.ny, progress, floors, drawn, scene.unread
        )
        halves = noise_free[: scene.unread[0]], noise_free[scene.unread[1] :]
        scene = replace(scene, peak_electrons=max(float(half.max(initial=0.0)) for half in halves))
        if "stars" in truth:
            of_stars = kind_of(sources.ids) == _STAR
            maps["stars"] = stamps.draw(
                sources.take(of_stars), sizes[of_stars], spread, detector.nx, detector.ny, None, floors[of_stars]
            ).astype(np.float32)
        # What sends in no more than faint wings is drawn, not listed.
        a_piece = sources.electrons / stamps.piece_count(sources.length)
        listed = (drawn > 0.0) | stamps.shining(a_piece, sizes, sources.shape, sources.picture, spread)
        sources, sizes, drawn = sources.take(listed), sizes[listed], drawn[listed]
    else:
        noise_free = np.zeros((detector.ny, detector.nx))
    scene = with_own_light(scene, effects)
    maps["noise_free"] = noise_free.astype(np.float32)
    # Handed over: a frame that nobody looks at any more is freed.
    light = [noise_free]
    del noise_free

    def stream(effect: Effect) -> np.random.Generator:
        return rng.stream(*numbers_of(effect, exposure, detector.name, seed))

    frame, more = apply_all(light.pop(), effects, scene, stream, truth_maps.watch(maps, scene, truth))
    raw = frame.astype(np.uint16)
    truth_maps.complete(maps, raw, effects, scene, truth)
    return Rendered(
        exposure, detector, system, spread, raw, maps, sources, sizes, drawn, zero_point, scene, (*decisions, *more),
        accuracy, seed, complete,
    )  # fmt: skip


def with_own_light(scene: Scene, effects: Sequence[Effect]) -> Scene:
    """A lamp's light and injected charge are moved and squeezed like a star's, and so are tracks of cosmic rays."""
    lamps = [effect for effect in effects if effect in _LAMPS and scene.forced.get(effect.name, True)]
    rays = [effect for effect in effects if effect in _RAYS and effect.applied(scene)]
    return replace(
        scene,
        peak_electrons=scene.peak_electrons + sum(lamp.contribution(scene) for lamp in lamps),
        track_electrons=cosmic_rays.brightest(scene) if rays else 0.0,
    )


def numbers_of(effect: Effect, exposure: Row, detector: str, seed: int) -> tuple[int | str, ...]:
    """The identity of an effect's random numbers: nobody else's, but where it follows another's pattern.

    A detector's own patterns are in every exposure.
    """
    what = str(exposure["camera"]) if effect.fixed else exposing.identity(exposure)
    return seed, what, detector, effect.numbers or effect.name


def effects_of(channel: str, image_type: str, where: str) -> tuple[Effect, ...]:
    """The effects of a kind of image, in their order; BadInput where nothing renders it."""
    if channel not in EFFECTS:
        raise BadInput(f"{where}: channel {channel!r} is not one of {', '.join(EFFECTS)}")
    if image_type not in EFFECTS[channel]:
        raise BadInput(f"{where}: {channel} has no image type {image_type!r}, only {', '.join(EFFECTS[channel])}")
    return EFFECTS[channel][image_type]


def _no_sources(galaxies: pa.Table) -> Sources:
    none, whole = np.zeros(0), np.zeros(0, np.int64)
    return Sources(whole, none, none, np.zeros((0, 2, 2)), none, whole, profiles.shapes(galaxies.slice(0, 0)))


def _lights(galaxies: tuple[pa.Table, Float], stars: tuple[pa.Table, Float], detector: Detector, system: WCS) -> Lights:
    """Bright sources on the detector and around it, as far as rows were given."""
    found = []
    for (rows, electrons), (ra, dec) in ((galaxies, ("ra_lensed", "dec_lensed")), (stars, ("ra", "dec"))):
        bright = np.flatnonzero(electrons > _LIGHT)
        chosen = rows.select(["id", ra, dec]).take(bright)
        column, row = focal_plane.pixel_of_sky(system, chosen[ra].to_numpy(), chosen[dec].to_numpy())
        found.append((chosen["id"].to_numpy(), column, row, electrons[bright]))
    ids, column, row, electrons = (np.concatenate(part) for part in zip(*found, strict=True))
    order = np.argsort(ids)
    return Lights(column[order], row[order], electrons[order])


def least_flux(exposure: Row, detector: Detector, mission: MissionConfiguration, accuracy: Accuracy) -> float:
    """f_nu of the faintest source that reaches the detector from beyond its selection margin, microjansky.

    Infinite where no source shows: in the dark, or in no time.
    Error : of the fainter out there each leaves out less than the settings' `edge` of a pixel's noise
    """
    time = float(exposure["exposure_time_s"])
    if time == 0.0 or not exposing.sees_sky(str(exposure["channel"]), str(exposure["image_type"])):
        return float("inf")
    margin = mission.value("survey.selection_margin", "arcsec")
    noise = scene_of(exposure, detector, mission, accuracy).pixel_noise
    return stamps.least_electrons(margin, detector.pixel_scale, noise, stamps.settings_for(accuracy)) / (
        _rate(exposure) * time
    )


def spike_flux(
    exposure: Row, detector: Detector, mission: MissionConfiguration, accuracy: Accuracy, band: Passband
) -> float:
    """f_nu of the faintest star whose spikes are noticed from beyond what else is read, microjansky; or infinite."""
    time = float(exposure["exposure_time_s"])
    sees = exposing.sees_sky(str(exposure["channel"]), str(exposure["image_type"]))
    if time == 0.0 or not sees or detector.section != "vis" or exposure.get("psf"):
        return float("inf")
    pupil, noise = psf.vis_edges(detector, band, mission), scene_of(exposure, detector, mission, accuracy).pixel_noise
    (one,) = edges.reach(pupil, np.ones(1), NOTICEABLE * noise)
    return float((stamps.reach(1.0) / one) ** 2 / (_rate(exposure) * time))


def outer_flux(exposure: Row, detector: Detector, mission: MissionConfiguration, accuracy: Accuracy) -> float:
    """f_nu of the faintest galaxy that may be noticed from beyond what else is read, microjansky; or infinite."""
    time = float(exposure["exposure_time_s"])
    if time == 0.0 or not exposing.sees_sky(str(exposure["channel"]), str(exposure["image_type"])):
        return float("inf")
    noise, scale = scene_of(exposure, detector, mission, accuracy).pixel_noise, detector.pixel_scale
    return outskirts.least_electrons(stamps.reach(scale), scale, noise) / (_rate(exposure) * time)


def _refuse_too_large(exposure: Row, detector: Detector, sources: Sources, sizes: stamps.Int, spread: Psf) -> None:
    """Before anything is drawn: a task must fit into its memory, and end."""
    here = _touching(sources, sizes, detector)
    where = f"exposure {exposure['exposure_id']}, detector {detector.name}: {int(here.sum())} sources"
    base = costs.of_channel(str(exposure["channel"])).base_gb * 1e9
    picture = None if sources.picture is None else sources.picture[here]
    wanted = base + stamps.memory(sources.electrons[here], sizes[here], detector.nx, detector.ny, picture)
    if wanted > _MOST_BYTES:
        raise BadInput(
            f"{where} take {wanted / 1e9:.1f} GB, a task has {_MOST_BYTES / 1e9:g}: "
            "ask for fainter sources to be left out"
        )
    seconds = stamps.seconds(sources, sizes, spread, detector.nx, detector.ny)
    if seconds > _MOST_SECONDS:
        raise BadInput(
            f"{where} take {seconds / 3600:.1f} h, a task has {_MOST_SECONDS / 3600:g}: "
            "ask for less accuracy, or for fainter sources to be left out"
        )


def _touching(sources: Sources, sizes: stamps.Int, detector: Detector) -> npt.NDArray[np.bool_]:
    """Sources with a stamp on the detector."""
    return selection.touching(sources.column, sources.row, sizes + sources.length, detector.nx, detector.ny)


def scene_of(exposure: Row, detector: Detector, mission: MissionConfiguration, accuracy: Accuracy) -> Scene:
    """Before anything is drawn."""
    return Scene(
        mission, detector.section, float(exposure["exposure_time_s"]), float(exposure["sky"]), 0.0, detector,
        lamp=int(exposure.get("lamp") or 1), accuracy=accuracy,
    )  # fmt: skip


def _rate(exposure: Row) -> float:
    """Electrons a second of a source of one microjansky."""
    return float(10.0 ** (0.4 * (float(exposure["zero_point"]) - units.AB_UJY)))


def sources_of(
    galaxies: tuple[pa.Table, Float],
    stars: tuple[pa.Table, Float],
    detector: Detector,
    system: WCS,
    spread: Psf,
    noise: float,
    settings: Settings,
    band: Passband,
    library: Library | None = None,
    stellar: Library | None = None,
    lenses: pa.Table | None = None,
) -> tuple[Sources, stamps.Int]:
    """Everything that shines onto the detector, with its stamp or beyond it, ascending id, and the stamps' sides.

    galaxies, stars : (rows, expected electrons [n]);  lenses : rows of `strong_lenses`, None = none
    """
    catalogue, points = galaxies[0], stars[0]
    form = profiles.shapes(catalogue)
    arcs = _arcs(lenses, catalogue, galaxies[1], form)
    ids = np.concatenate([catalogue["id"].to_numpy(), points["id"].to_numpy(), arcs.ids]).astype(np.int64)
    ra = np.concatenate([catalogue["ra_lensed"].to_numpy(), points["ra"].to_numpy(), arcs.ra])
    dec = np.concatenate([catalogue["dec_lensed"].to_numpy(), points["dec"].to_numpy(), arcs.dec])
    electrons = np.concatenate([galaxies[1], stars[1], arcs.electrons])
    rest = len(points) + len(arcs.ids)
    shape = np.concatenate([np.arange(len(catalogue)), np.full(rest, -1)]).astype(np.int64)
    picture = np.concatenate([np.full(len(catalogue) + len(points), -1), np.arange(len(arcs.ids))]).astype(np.int64)
    _check(ids, electrons)
    farthest = np.where((shape < 0) & (picture < 0), _spikes(electrons, detector, spread, noise), 0.0)
    farthest[: len(catalogue)] = _outskirts(electrons[: len(catalogue)], form, detector, noise)
    reach = detector.half_diagonal + np.maximum(farthest, stamps.reach(detector.pixel_scale))
    seen = selection.near(ra, dec, focal_plane.centre(detector, system), reach / 3600.0) & (electrons > 0)
    kept = np.flatnonzero(seen)[np.argsort(ids[seen], kind="stable")]
    column, row = focal_plane.pixel_of_sky(system, ra[kept], dec[kept])
    wide = np.array([0.0, *(found.diagonal for found in arcs.pictures)])[picture[kept] + 1] / detector.pixel_scale
    sizes = stamps.stamp_sizes(electrons[kept], shape[kept], form, spread, noise, settings, wide)
    here = stamps.shone_on(
        column, row, electrons[kept], sizes, shape[kept], form, picture[kept], spread, noise, detector.nx, detector.ny
    )
    kept, column, row = kept[here], column[here], row[here]
    jacobian = focal_plane.jacobian(system, column, row)
    # Arcs have the colour of what they are an image of.
    coloured = np.concatenate([np.arange(len(catalogue) + len(points)), arcs.source])[kept]
    colourful = spread.planes is not None and len(spread.planes.wavelength) > 1
    photons = _colours(coloured, catalogue, points, band, (library, stellar)) if colourful else None
    found = Sources(
        ids[kept], column, row, jacobian, electrons[kept], shape[kept], form, photons, picture[kept], arcs.pictures
    )
    return found, sizes[here]


def _spikes(electrons: Float, detector: Detector, spread: Psf, noise: float) -> Float:
    """[n] arcsec as far as which points' spikes are noticed."""
    if spread.edges is None:
        return np.zeros(len(electrons))
    return edges.reach(spread.edges, electrons, NOTICEABLE * noise) * detector.pixel_scale


def _outskirts(electrons: Float, form: profiles.Shapes, detector: Detector, noise: float) -> Float:
    """[n] arcsec as far as which galaxies are noticed that may be from beyond what else is read, 0 of others."""
    out, least = np.zeros(len(electrons)), stamps.reach(detector.pixel_scale)
    some = np.flatnonzero(electrons > outskirts.least_electrons(least, detector.pixel_scale, noise))
    out[some] = outskirts.reach(electrons[some], form.take(some), detector.pixel_scale, noise, least)
    return out


def _arcs(lenses: pa.Table | None, galaxies: pa.Table, electrons: Float, form: profiles.Shapes) -> pictures.Arcs:
    """Those of strong lenses: their pictures magnify what the galaxy shines by itself."""
    rows = STRONG_LENSES.empty().select(pictures.ARC_COLUMNS) if lenses is None else lenses
    return pictures.arcs(rows, galaxies["id"].to_numpy(), electrons / form.magnification)


def _with_moving(
    sources: Sources, sizes: stamps.Int, exposure: Row, detector: Detector, system: WCS, band: Passband, scene: Scene,
    spread: Psf, settings: Settings, seed: int, bodies: Callable[[int], moving.Population] | None,
) -> tuple[Sources, stamps.Int, Lights]:  # fmt: skip
    """The sources with those that move, whose identifiers are the largest; and bright ones around, as far as read."""
    reach = (detector.half_diagonal + stamps.reach(detector.pixel_scale)) / 3600.0
    found = moving.sources(exposure, detector, system, band, scene.mission, seed, reach, sources.shapes, bodies)
    own = stamps.stamp_sizes(
        found.electrons,
        found.shape,
        found.shapes,
        spread,
        scene.pixel_noise,
        settings,
        stamps.piece_length(found.length),
    )
    wide = stamps.reaches(found.electrons, own, found.shape, None, spread, scene.pixel_noise, found.length)
    here = selection.touching(found.column, found.row, wide, detector.nx, detector.ny) & (found.electrons > 0)
    if not here.any():
        return sources, sizes, _trails(found)
    return sources.with_moving(found.take(here)), np.concatenate([sizes, own[here]]), _trails(found)


def _trails(bodies: Sources) -> Lights:
    """Bright bodies as points along their trails, near each other beside what light spreads over around corners."""
    bright = np.flatnonzero(bodies.electrons > _LIGHT)
    pieces = np.ceil(bodies.length[bright] / _PIECE).astype(np.int64) + 1
    body, first = np.repeat(bright, pieces), np.repeat(np.cumsum(pieces) - pieces, pieces)
    count = np.repeat(pieces, pieces)
    # Of the trail, from its middle.
    place = (np.arange(len(body)) - first + 0.5) / count - 0.5
    trail = np.zeros((len(bodies), 2)) if bodies.trail is None else bodies.trail
    along = place[:, None] * trail[body]
    return Lights(bodies.column[body] + along[:, 0], bodies.row[body] + along[:, 1], bodies.electrons[body] / count)


def _colours(
    kept: npt.NDArray[np.int64],
    galaxies: pa.Table,
    stars: pa.Table,
    band: Passband,
    libraries: tuple[Library | None, Library | None],
) -> Float:
    """Photon fractions of the rows that are drawn; `kept` counts on from the galaxies to the stars."""
    of_galaxy = kept < len(galaxies)
    out = np.empty((len(kept), chromatic.PARTS))
    out[of_galaxy] = chromatic.galaxies(galaxies.take(kept[of_galaxy]), band, libraries[0])
    out[~of_galaxy] = chromatic.stars(stars.take(kept[~of_galaxy] - len(galaxies)), band, libraries[1])
    return out


def _check(ids: npt.NDArray[np.int64], electrons: Float) -> None:
    if len(np.unique(ids)) != len(ids):
        raise BadInput("a source is given twice")
    bad = ~((electrons >= 0) & (electrons <= _MOST_ELECTRONS))
    if bad.any():
        raise BadInput(f"source {ids[np.argmax(bad)]}: {electrons[np.argmax(bad)]} electrons, outside 0 .. 1e17")


def _fluxes(rows: pa.Table, fluxes: pa.Table, column: str) -> Float:
    if column not in fluxes.column_names:
        raise BadInput(f"the flux table has no column {column}")
    if len(rows) != len(fluxes) or not np.array_equal(rows["id"].to_numpy(), fluxes["id"].to_numpy()):
        raise BadInput("the flux table is not of the same rows as its catalogue")
    return np.asarray(fluxes[column].to_numpy(), float)


def _psf(exposure: Row, detector: Detector, band: Passband, mission: MissionConfiguration, positions: int) -> Psf:
    if exposure.get("psf"):
        return own_psf.read(own_psf.file_of(exposure["psf"], detector.name), detector, band)
    if detector.section == "vis":
        return psf.vis_psf(detector, band, mission, positions)
    beta = mission.value(f"{detector.section}.psf.moffat_beta")
    return psf.ground_psf(float(exposure["seeing"]), beta, detector.pixel_scale)
