"""Draw images of single places on the sky from the catalogues of a lake, without a request and without Spark."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow.compute as pc

from lake_schema import arguments, sky
from lake_schema.arrays import Bool, Float
from lake_schema.errors import BadInput
from lake_schema.fits import images
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import read
from lake_schema.store.object_storage.s3 import Folder
from lake_schema.tables.exposures import ExposureRow
from lake_schema.tables.galaxies import GALAXIES
from truesky.api import added
from truesky.api.image_options import ImageRequest
from truesky.cosmology import from_facts
from truesky.fluxes import passbands
from truesky.render.camera import astrometry, detectors
from truesky.render.camera.detectors import Detector
from truesky.render.camera.windows import Window
from truesky.render.channels.aim import Aim
from truesky.render.drawing import stamps, transfer
from truesky.render.drawing.settings import settings_for
from truesky.render.exposure import scene_factory, visible_sources
from truesky.render.exposure.records import Variant
from truesky.render.planning import exposure_chunks, variants
from truesky.render.psf.model import Psf
from truesky.render.sources import catalogue_rows, galaxy_shapes
from truesky.render.sources.source_list import Sources
from truesky.render.windows import image as window_images
from truesky.render.windows import inputs, nominal
from truesky.render.windows.image import WindowImage
from truesky.render.windows.inputs import SkyTables
from truesky.request import accuracy as accuracies
from truesky.request.accuracy import Accuracy

if TYPE_CHECKING:
    # Imported where they are used, because their imports are slow.
    import pandas as pd
    from astropy.wcs import WCS

# Largest and smallest size of an image in pixels.
_MAX_PIXELS, _MIN_PIXELS = 4096, 1
# Largest number of exposures that an error message lists.
_MAX_LISTED = 8
# Shapes of no galaxies.
_NO_SHAPES = galaxy_shapes.shapes(GALAXIES.empty().select(visible_sources.SHAPE_COLUMNS))
# Electrons of the star that is drawn to show a PSF. They are many, so that rounding to 1e-6 electrons does not matter.
_PSF_ELECTRONS = 1e9
# Number of PSFs that are kept for the images that follow. One has up to 150 MB with its Fourier transforms.
_PSFS = 4
# Tables that are used if the lake has them, besides the catalogues and their fluxes.
_CATALOGUES = ("galaxies", "galaxy_fluxes", "stars", "star_fluxes")
_OPTIONAL = ("strong_lenses", "transients", "lensed_images", "active_nuclei")
_PLANNED = ("exposures", "tasks", "mission")


@dataclass(frozen=True, slots=True)
class PsfImage:
    """Image of a point-spread function.

    Attributes
    ----------
    image : float array, shape (n, n)
        Fraction of a star's light in each pixel or sample, centred on the middle one.
    samples : int
        Samples per pixel of the detector; 1 for an image in pixels.
    light : float
        Fraction of the light that the image contains.
    """

    image: Float = field(repr=False)
    samples: int
    light: float

    def write(self, path: str | Path) -> Path:
        """Write the image to a FITS file that `[psf]` of a request and `truesky.frame` read.

        The header states the axes (PSFFRAME = 'PIXELS'), the spacing of the samples, and whether they are averaged over
        a pixel (PIXEL). An existing file is replaced. Raw frames of DECam and HSC are mirrored against an image of a
        place without a planned exposure: reverse the order of its rows for such frames.

        Parameters
        ----------
        path : str or Path
            The file.

        Returns
        -------
        Path
            The file.
        """
        file, step = Path(path), 1.0 / self.samples
        cards: tuple[images.Card, ...] = (
            ("PSFFRAME", "PIXELS", "axes: columns and rows of the detector"),
            ("CDELT1", step, "[pixel] spacing of the samples"),
            ("CDELT2", step, "[pixel] spacing of the samples"),
            ("CUNIT1", "pixel", "unit of CDELT1"),
            ("PIXEL", self.samples == 1, "averaged over the pixel of the detector"),
        )
        images.write_images(file, [images.Image(self.image.astype(np.float32), cards)])
        return file


class SkyImage:
    """Image of a place on the sky, with its truth. `Lake.render` returns it.

    Attributes
    ----------
    electrons : ndarray of float64, shape (ny, nx)
        Expected electrons of the sources alone, without sky and noise.
    raw : ndarray of int or None, shape (ny, nx)
        Pixels with sky and noise as the detector's converter gives them, ADU; None without noise.
    truth : pandas.DataFrame
        One row per drawn source: the columns of the table ``rendered_truth``.
    wcs : astropy.wcs.WCS
        World coordinate system of the pixels.
    errors : dict of str to float
        Measured errors of the drawing at this accuracy: ``flux`` (relative), ``shape`` (reduced shear), ``position``
        (pixels) and ``background`` (in units of the noise of a sky pixel).
    exposure : dict
        Properties of the exposure: the columns of the table ``exposures``.
    detector : str
        Name of the detector.
    first_pixel : (int, int)
        Column and row of the detector, from 0, of the first pixel of the image.
    gain : float
        Electrons per ADU.
    bias : float
        Level of a pixel without electrons, ADU.
    """

    def __init__(self, drawn: WindowImage, request: ImageRequest, painter: SkyPainter) -> None:
        aim, window, sources = drawn.aim, drawn.aim.drawn, drawn.sources
        self._ids, self._column, self._row, self._photons = sources.ids, sources.column, sources.row, sources.photons
        self._truth_table, self._intra_pixel = window_images.truth(drawn), drawn.psf.intra_pixel
        # The world coordinate system and the PSF are found again when they are needed, without the added sources.
        # astropy changes the numbers of a system that is copied, and a PSF is much larger than the image.
        self._request, self._lake = replace(request, extra=None), painter.source
        self._painter: SkyPainter | None = painter
        self.electrons, self.raw, self.detector = drawn.electrons, drawn.raw, aim.detector.name
        self.exposure = asdict(aim.exposure)
        self.first_pixel = window.column, window.row
        self.errors = asdict(accuracies.expected_errors(drawn.scene.accuracy))
        self.gain = float(drawn.scene.amplifier_values("gain", "electron / adu"))
        self.bias = float(drawn.scene.amplifier_values("bias", "adu"))

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_painter": None, "wcs": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update({name: value for name, value in state.items() if name != "wcs"})

    @cached_property
    def truth(self) -> pd.DataFrame:
        """Drawn sources: the columns of the table ``rendered_truth``."""
        frame: pd.DataFrame = self._truth_table.to_pandas()
        return frame

    @cached_property
    def wcs(self) -> WCS:
        """World coordinate system of the pixels."""
        aim, _ = self._find_painter().aim(self._request)
        return astrometry.shift_pixels(aim.wcs, *(-first for first in self.first_pixel))

    def attach(self, painter: SkyPainter) -> SkyImage:
        """Use a painter of the same lake for the coordinates and the PSF.

        Parameters
        ----------
        painter : SkyPainter
            The painter.

        Returns
        -------
        SkyImage
            This image.
        """
        self._painter = painter
        return self

    def _find_painter(self) -> SkyPainter:
        if self._painter is None:
            self._painter = shared_painter(self._lake)
        return self._painter

    def __repr__(self) -> str:
        ny, nx = self.electrons.shape
        return f"<SkyImage {nx} x {ny} pixels, {self.exposure['band']}, {len(self.truth)} sources>"

    @property
    def signal(self) -> Float:
        """Pixels with sky and noise in electrons above the bias, shape (ny, nx); raises BadInput without noise."""
        if self.raw is None:
            raise BadInput("signal: this image has no noise, draw it with noise=True")
        return np.asarray((self.raw - self.bias) * self.gain)

    def psf(
        self, ra: float | None = None, dec: float | None = None, source: int | None = None, oversampled: bool = False
    ) -> PsfImage:
        """Return the PSF at a place of the image.

        Parameters
        ----------
        ra, dec : float, optional
            Position in degrees. By default the middle of the image.
        source : int, optional
            Identifier of a drawn source, whose spectrum and, without `ra` and `dec`, whose position is used. By
            default the spectrum has constant f_nu.
        oversampled : bool, optional
            If True, return the samples of the model without the pixel of the detector, otherwise the light in pixels.

        Returns
        -------
        PsfImage
            The image of the PSF.

        Raises
        ------
        BadInput
            If the source was not drawn, or the model of the PSF has no samples.
        """
        photons = None
        ny, nx = self.electrons.shape
        column, row = (nx - 1) / 2, (ny - 1) / 2
        if source is not None:
            at = np.flatnonzero(self._ids == source)
            if not len(at):
                raise BadInput(f"source {source} was not drawn in this image")
            photons = None if self._photons is None else self._photons[at]
            column, row = float(self._column[at[0]]), float(self._row[at[0]])
        if ra is not None and dec is not None:
            x, y = astrometry.pixel_of_sky(self.wcs, [ra], [dec])
            column, row = float(x[0]), float(y[0])
        model = self._model()
        place = np.array([column]), np.array([row])
        weights = transfer.basis_weights(model, photons, *place)[0]
        if oversampled:
            if model.planes is None:
                raise BadInput("the model of this PSF is a profile without samples: use oversampled=False")
            image = np.asarray(transfer.image_of(model.planes, weights), float)
            return PsfImage(image, model.planes.samples, float(image.sum()))
        return self._psf_in_pixels(model, photons, place)

    def _model(self) -> Psf:
        psf = replace(self._find_painter().psf_of(self._request), intra_pixel=self._intra_pixel)
        return psf if psf.planes is None else replace(psf, planes=replace(psf.planes, origin=self.first_pixel))

    def _psf_in_pixels(self, model: Any, photons: Float | None, place: tuple[Float, Float]) -> PsfImage:
        side = model.side + 1
        if model.planes is not None:
            first = (self.first_pixel[0] + place[0][0] - side // 2, self.first_pixel[1] + place[1][0] - side // 2)
            model = replace(model, planes=replace(model.planes, origin=first))
        middle = np.array([float(side // 2)])
        star = Sources(
            np.zeros(1, np.int64), middle, middle, np.zeros((1, 2, 2)), np.array([_PSF_ELECTRONS]),
            np.array([-1]), _NO_SHAPES, photons,
        )  # fmt: skip
        image = stamps.draw(star, np.array([model.side]), model, side, side) / _PSF_ELECTRONS
        return PsfImage(image, 1, float(image.sum()))

    @arguments.refuse_missing('image.write("image.fits")')
    def write(self, path: str | Path) -> Path:
        """Write the image to a FITS file.

        The extensions are ELECTRONS (expected electrons), RAW (with sky and noise, if there is noise), and TRUTH (the
        table of drawn sources). An existing file is replaced.

        Parameters
        ----------
        path : str or Path
            The file.

        Returns
        -------
        Path
            The file.
        """
        file, exposure = Path(path), self.exposure
        place = astrometry.cards(self.wcs)
        cards: tuple[images.Card, ...] = (
            ("CAMERA", exposure["camera"], "camera"),
            ("FILTER", exposure["band"], "passband"),
            ("DETNAME", self.detector, "detector"),
            ("MJD-OBS", exposure["mjd"], "[d] start of the exposure, UTC"),
            ("EXPTIME", exposure["exposure_time_s"], "[s] exposure time"),
            ("ZEROPNT", exposure["zero_point"], "[mag] AB magnitude of 1 electron/s"),
            ("GAIN", self.gain, "[electron/adu] electrons per ADU"),
            ("BIAS", self.bias, "[adu] level without electrons"),
            ("SKYRATE", exposure["sky"], "[electron/(s pix)] rate of the sky"),
            ("COLUMN0", self.first_pixel[0], "[pix] first column on the detector, from 0"),
            ("ROW0", self.first_pixel[1], "[pix] first row on the detector, from 0"),
        )
        units = [images.Image(None, cards), images.Image(self.electrons.astype(np.float32), place, "ELECTRONS")]
        if self.raw is not None:
            units.append(images.Image(self.raw, place, "RAW"))
        truth = self._truth_table.drop_columns("detector")
        images.write_images_and_table(file, units, "TRUTH", {name: truth[name] for name in truth.column_names})
        return file


class SkyPainter:
    """Draws images of places on the sky from the tables of a lake.

    Parameters
    ----------
    source : PainterTables
        The lake, for other processes.
    tables : SkyTables
        Catalogues of the lake.
    settings : mapping
        Recorded settings of the images of the lake (`request` in the facts of the table products), or {} without
        images.
    planned : mapping of str to Version
        The tables `exposures`, `tasks` and `mission` if the lake has them.
    seed : int
        Seed of the lake.
    """

    def __init__(
        self,
        source: PainterTables,
        tables: SkyTables,
        settings: Mapping[str, Any],
        planned: Mapping[str, read.Version],
        seed: int,
    ) -> None:
        self.source, self.tables, self.planned, self.seed = source, tables, planned, seed
        self.mission = inputs.mission_of_lake(planned.get("mission"))
        effects = settings.get("effects", {"on": (), "off": ()})
        self.forced = {**dict.fromkeys(effects["on"], True), **dict.fromkeys(effects["off"], False)}
        self.nominal = lru_cache(maxsize=64)(self._nominal)
        self.psf = lru_cache(maxsize=_PSFS)(self._psf)
        self._cells = np.array(sorted(catalogue_rows.drawn_cells(tables.versions["galaxies"])), np.int64)

    def _nominal(self, band: str, camera: str | None, mjd: float | None, cell: tuple[float, float]) -> ExposureRow:
        instrument = nominal.find_instrument(band, camera, self.mission)
        return nominal.nominal_exposure(instrument, band, cell, self.seed, self.mission, mjd)

    def _psf(self, exposure: ExposureRow, detector: Detector, accuracy: Accuracy) -> Psf:
        """Return the PSF of a detector, which keeps its Fourier transforms for the images that follow."""
        variant = variants.variant(exposure.settings, self.mission, accuracy, self.forced)
        aim = Aim.from_exposure(exposure, detector, passbands.load(exposure.band), self.seed)
        psf = visible_sources.exposure_psf(aim, scene_factory.from_aim(aim, variant), settings_for(accuracy))
        return replace(psf, derived={})

    def _nominal_of(self, request: ImageRequest) -> tuple[ExposureRow, Detector]:
        """Return the exposure of the square degree around a place, and its central detector."""
        cell = round(request.ra), round(request.dec)
        exposure = self.nominal(request.band, request.camera, request.mjd, cell)
        detector = nominal.central_detector(exposure.camera, self.mission)
        # The rows for charge injection, which are not read, would be in the middle of the image.
        detector = replace(detector, injection_rows=0)
        return nominal.move_exposure(exposure, detector, cell), detector

    def psf_of(self, request: ImageRequest) -> Psf:
        """Return the PSF of an image, without the variation of response inside a pixel.

        Images at places that share a nominal exposure have the same PSF.
        """
        if request.exposure is None:
            return self.psf(*self._nominal_of(request), request.accuracy)
        aim, _ = self._planned_aim(request)
        return self.psf(aim.exposure, aim.detector, request.accuracy)

    def aim(self, request: ImageRequest) -> tuple[Aim, Variant]:
        """Return the exposure, the detector and the window of an image, and its parameters and accuracy."""
        if request.exposure is not None:
            return self._planned_aim(request)
        exposure, detector = self._nominal_of(request)
        variant = Variant(self.mission, request.accuracy, self.forced)
        moved = nominal.move_exposure(exposure, detector, (request.ra, request.dec))
        aim = Aim.from_exposure(moved, detector, passbands.load(exposure.band), self.seed)
        return _with_window(aim, request), variant

    def _planned_aim(self, request: ImageRequest) -> tuple[Aim, Variant]:
        number = int(request.exposure or 0)
        for name in ("exposures", "tasks"):
            if name not in self.planned:
                raise BadInput(f"exposure {number}: the lake has no planned exposures (table {name})")
        is_number = pc.field("exposure_id") == number
        exposure_rows = exposure_chunks.rows(self.planned["exposures"], [number], where=is_number).to_pylist()
        if not exposure_rows:
            raise BadInput(f"exposure {number}: the lake has no exposure with this number; {self._first_exposures()}")
        exposure = ExposureRow.from_row(exposure_rows[0])
        variant = variants.variant(exposure.settings, self.mission, request.accuracy, self.forced)
        tasks = exposure_chunks.rows(self.planned["tasks"], [number], where=is_number).to_pylist()
        for task in tasks:
            detector = detectors.detector(exposure.camera, task["detector"], variant.mission)
            aim = Aim.from_exposure(exposure, detector, passbands.load(exposure.band), self.seed)
            column, row = (float(at[0]) for at in astrometry.pixel_of_sky(aim.wcs, [request.ra], [request.dec]))
            if -0.5 <= column < detector.nx - 0.5 and -0.5 <= row < detector.ny - 0.5:
                return _with_window(aim, request), variant
        raise BadInput(f"ra {request.ra:.5f}, dec {request.dec:.5f}: on none of the {len(tasks)} planned detectors")

    def _first_exposures(self) -> str:
        """Return the first numbers of planned exposures, for a message."""
        numbers: list[int] = []
        for rows in exposure_chunks.rows_by_partition(self.planned["exposures"], ["exposure_id"]):
            numbers += rows["exposure_id"].to_pylist()
            if len(numbers) > _MAX_LISTED:
                break
        rest = ", .." if len(numbers) > _MAX_LISTED else ""
        return f"it has {', '.join(map(str, sorted(numbers)[:_MAX_LISTED]))}{rest}" if numbers else "it has none"

    def covers(self, ra: Float, dec: Float) -> Bool:
        """Return the mask [n] of the places (deg) that are in a cell of the catalogue."""
        return np.isin(sky.cell_at(ra, dec, GENERATION_ORDER), self._cells)

    def outside_area(self, ra: float, dec: float) -> BadInput:
        """Return the error for a place (deg) outside the catalogue."""
        return inputs.outside_area(self._cells, ra, dec)

    def check(self, request: ImageRequest) -> None:
        """Raise BadInput if an image cannot be drawn because of its options, or its place is outside the catalogue."""
        if request.exposure is None:
            # Answer a wrong band or camera with the names that exist, before anything is planned.
            nominal.find_instrument(request.band, request.camera, self.mission)
        aim, _ = self.aim(request)
        inputs.check_band(self.tables.versions["galaxy_fluxes"], aim.exposure.band)
        window_images.check_effects(aim, request.effects)

    def draw(self, request: ImageRequest, refuse_unknown: bool = False) -> SkyImage:
        """Draw an image; see `Lake.render`. With `refuse_unknown`, all sources that are left out must exist."""
        aim, variant = self.aim(request)
        rows = inputs.read_rows(self.tables, aim, variant)
        if refuse_unknown:
            inputs.refuse_unknown(rows, request.without)
        rows = inputs.select_rows(rows, request.without)
        if request.extra is not None:
            cosmology = from_facts(self.tables.versions["galaxies"].manifest["facts"])
            rows = added.add_sources(rows, request.extra, aim.exposure.band, cosmology)
        drawn = window_images.draw_window(
            aim, rows, variant, self.seed, request.noise_seed, request.effects, request.noise,
            self.psf_of(request),
        )  # fmt: skip
        return SkyImage(drawn, request, self)


def _with_window(aim: Aim, request: ImageRequest) -> Aim:
    detector = aim.detector
    if aim.channel.dispersion is not None:
        raise BadInput(f"band {aim.exposure.band}: spectra through a grism cannot be drawn in a part of a detector")
    if not aim.sees_sky:
        raise BadInput(f"exposure {aim.exposure.exposure_id}: its image type {aim.exposure.image_type} has no sky")
    side = round(request.size / detector.pixel_scale)
    if not _MIN_PIXELS <= side <= min(detector.nx, detector.ny, _MAX_PIXELS):
        largest = min(detector.nx, detector.ny, _MAX_PIXELS) * detector.pixel_scale
        raise BadInput(
            f"size = {request.size:g}: must be {detector.pixel_scale:.2g} to {largest:.0f} arcsec, at most a detector"
        )
    column, row = (float(at[0]) for at in astrometry.pixel_of_sky(aim.wcs, [request.ra], [request.dec]))
    first_column, first_row = (
        min(max(round(place - (side - 1) / 2), 0), count - side)
        for place, count in ((column, detector.nx), (row, detector.ny))
    )
    return replace(aim, window=Window(first_column, first_row, side, side))


@dataclass(frozen=True, slots=True)
class PainterTables:
    """Lake and versions of its tables, from which every process makes the same painter.

    Attributes
    ----------
    root : Folder
        The lake.
    keys : tuple of (str, str)
        Name and key of the version of each table.
    """

    root: Folder
    keys: tuple[tuple[str, str], ...]


def find_tables(versions: Mapping[str, read.Version], root: Folder) -> PainterTables:
    """Return what a painter needs of a lake; raises BadInput if it lacks catalogues or fluxes.

    `versions` are the versions of the tables of the lake `root`, by name.
    """
    for name in _CATALOGUES:
        if name not in versions:
            raise BadInput(f"lake {root}: has no table {name}, which images need")
    for name in _OPTIONAL[1:]:
        if name in versions and versions[name].manifest["facts"].get("galaxies") != versions["galaxies"].key:
            command = read.OPTIONAL_TABLES[name]
            raise BadInput(
                f"lake {root}: {name} was made from another version of galaxies: run truesky {command} first"
            )
    names = [name for name in (*_CATALOGUES, *_OPTIONAL, *_PLANNED, "products") if name in versions]
    return PainterTables(root, tuple((name, versions[name].key) for name in names))


def painter(source: PainterTables) -> SkyPainter:
    """Open the tables of a lake, and return its painter."""
    versions = {name: read.version(source.root, name, key) for name, key in source.keys}
    products = versions.get("products")
    settings = {} if products is None else products.manifest["facts"]["request"]
    tables = SkyTables(source.root, {name: versions[name] for name in (*_CATALOGUES, *_OPTIONAL) if name in versions})
    planned = {name: versions[name] for name in _PLANNED if name in versions}
    seed = settings.get("seed", versions["galaxies"].manifest["facts"].get("seed", 0))
    return SkyPainter(source, tables, settings, planned, seed)


@lru_cache(maxsize=1)
def shared_painter(source: PainterTables) -> SkyPainter:
    """Return the painter of a lake that all images use which were sent from another process."""
    return painter(source)
