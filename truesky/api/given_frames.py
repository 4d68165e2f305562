"""Add sources to a calibrated frame of a real telescope: function `frame` and class `GivenFrame`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from lake_schema import arguments, user_files
from lake_schema.arrays import Array
from lake_schema.errors import BadInput, Mistakes
from lake_schema.fits import external, tables
from truesky.catalogue import injected_rows
from truesky.catalogue.injected_rows import InjectedRows
from truesky.render.camera import astrometry
from truesky.render.injection import frame_psf, frame_wcs
from truesky.render.injection.add_sources import FramePixels, add_sources
from truesky.render.injection.calibration import Calibration, read_calibration
from truesky.render.psf.model import Psf
from truesky.render.sources import galaxy_shapes
from truesky.render.sources.source_list import Sources

if TYPE_CHECKING:
    # Imported where they are used, because their imports are slow.
    import pandas as pd
    from astropy.wcs import WCS

# Name of the extension with the table of the added sources.
TABLE_NAME = "INJECTED"
# A number with or without a unit, such as 0.8arcsec.
_NUMBER = re.compile(r"\s*\d*\.?\d+\s*(?P<unit>[^\d\s.]*)\s*")
# Largest seed.
_MAX_SEED = 2**63 - 1
# Columns of the table of added sources: unit and meaning.
_TRUTH_COLUMNS = {
    "id": ("", "identifier of the source"),
    "kind": ("", "galaxies or stars"),
    "ra": ("deg", "right ascension in the system of the frame"),
    "dec": ("deg", "declination in the system of the frame"),
    "x": ("pix", "column, the centre of the first pixel is 0"),
    "y": ("pix", "row, the centre of the first pixel is 0"),
    "mag": ("mag", "AB magnitude without magnification"),
    "flux": ("count", "expected counts, with magnification"),
    "drawn": ("count", "counts added to pixels that are not saturated"),
    "on_frame": ("", "T if the centre of the source is on the frame"),
}


@dataclass(frozen=True, slots=True)
class _Plane:
    """Place of an image in a FITS file: the file, and the number of the extension."""

    file: Path
    number: int


@dataclass(frozen=True, slots=True, eq=False)
class GivenFrame:
    """A calibrated frame of a real telescope, made by `truesky.frame`.

    Attributes
    ----------
    image : float array, shape (ny, nx)
        Image, counts. Frames of integers become floating-point numbers.
    weight : float array, shape (ny, nx), or None
        Inverse variances, 1 / counts^2; 0 for bad pixels.
    flags : int array, shape (ny, nx), or None
        Flag bits.
    wcs : astropy.wcs.WCS
        World coordinate system.
    zero_point : float
        AB magnitude of a source that adds one count to the image.
    gain : float
        Electrons per count.
    saturation : float
        Level of saturated pixels, counts; infinite if none is known.
    psf : Psf
        PSF model.
    planes : dict of str to object
        File and extension of image, weight and flags.
    """

    image: Array
    weight: Array | None
    flags: Array | None
    wcs: WCS
    zero_point: float
    gain: float
    saturation: float
    psf: Psf
    planes: dict[str, _Plane]

    @arguments.refuse_missing('frame.with_sources({"ra": [53.1], "dec": [-27.8], "mag": [21.0]})')
    def with_sources(
        self,
        rows: Any,
        seed: int = 1,
        noise: bool = True,
        ellipticity: str | None = None,
        axes: str | None = None,
        saturated_flag: int = 8,
    ) -> InjectedFrame:
        """Return the frame with sources added. The frame itself does not change.

        Parameters
        ----------
        rows : table, str, Path or mapping
            Table of the sources: a pandas, astropy or Arrow table, a mapping of column names to arrays, or the path of
            a Parquet, FITS, CSV or HDF5 file. The columns are the same as in the section `sources` of a request; `mag`
            is the AB magnitude in the band of the frame. A column `id` is optional. A table with columns that only
            galaxies have, such as ``half_light_radius``, contains galaxies, other tables contain stars. To add both,
            give ``{"galaxies": table, "stars": table}``.
        seed : int, optional
            Seed of the noise of the added light. The noise of a source depends on the seed and the number of its row.
        noise : bool, optional
            False to add the expected light without noise. The weights then do not change.
        ellipticity : str, optional
            Convention of the columns ``e1`` and ``e2``: shear, distortion, conformal or flattening.
        axes : str, optional
            Axes of the ellipticities: east_north (default), west_north, north_east or north_west.
        saturated_flag : int, optional
            Flag bit that is set in pixels that become saturated.

        Returns
        -------
        InjectedFrame
            The new image, weights and flags, and a table of the added sources.

        Raises
        ------
        BadInput
            If a table cannot be read, a column is unknown or missing, or a value is missing or out of range.

        Examples
        --------
        >>> given = truesky.frame("image.fits", psf="image.psf")  # doctest: +SKIP
        >>> new = given.with_sources({"ra": [150.1], "dec": [2.2], "mag": [21.0]})  # doctest: +SKIP
        >>> new.write("injected.fits")  # doctest: +SKIP
        """
        number = arguments.check_integer("seed", seed, 0, _MAX_SEED)
        largest_bit = _MAX_SEED if self.flags is None else int(np.iinfo(self.flags.dtype).max)
        bit = arguments.check_integer("saturated_flag", saturated_flag, 1, largest_bit)
        row_tables = injected_rows.read_rows(rows, ellipticity, axes)
        calibration = Calibration(self.zero_point, self.gain, self.saturation)
        truth, sources = _place_sources(row_tables, self.wcs, calibration, self.image.shape)
        reached = np.flatnonzero(np.isfinite(sources.column) & np.isfinite(sources.row))
        identities = [(table.name, i) for table in row_tables for i in range(1, len(table.ids) + 1)]
        pixels, drawn = add_sources(
            FramePixels(self.image, self.weight, self.flags),
            sources.take(reached),
            [identities[i] for i in reached.tolist()],
            self.psf,
            calibration,
            number,
            bool(noise),
            bit,
        )
        truth.loc[reached, "drawn"] = drawn
        outside = int(np.sum(~truth["on_frame"].to_numpy(bool)))
        return InjectedFrame(pixels.image, pixels.weight, pixels.flags, truth, outside, self, number, bool(noise))


@dataclass(frozen=True, slots=True, eq=False)
class InjectedFrame:
    """A frame to which sources were added, made by `GivenFrame.with_sources`.

    Attributes
    ----------
    image : float array, shape (ny, nx)
        Image, counts.
    weight : float array, shape (ny, nx), or None
        Inverse variances, 1 / counts^2, which include the noise of the added light.
    flags : int array, shape (ny, nx), or None
        Flag bits; pixels that became saturated have the bit `saturated_flag`.
    truth : pandas.DataFrame
        One row per source: ``id``, ``kind`` (galaxies or stars), ``ra``, ``dec`` (deg), ``x``, ``y`` (pixels from 0,
        NaN far from the frame), ``mag``, ``flux`` (expected counts), ``drawn`` (counts added to the frame) and
        ``on_frame``.
    outside : int
        Number of sources whose centre is outside the frame. Their light may still reach it.
    original : GivenFrame
        The frame without the sources.
    seed : int
        Seed of the noise.
    noise : bool
        True if the added light has noise.
    """

    image: Array
    weight: Array | None
    flags: Array | None
    truth: pd.DataFrame
    outside: int
    original: GivenFrame
    seed: int
    noise: bool

    @arguments.refuse_missing('frame.write("image.fits")')
    def write(self, path: str | Path) -> list[Path]:
        """Write a copy of the original file with the new image, and a table INJECTED of the added sources.

        All headers and other extensions of the original are copied. Weights and flags that are extensions of the same
        file are replaced. If they are separate files, copies are written to ``NAME.weight.fits`` and
        ``NAME.flags.fits`` next to the image ``NAME.fits``. Existing files are replaced.

        Parameters
        ----------
        path : str or Path
            File of the image.

        Returns
        -------
        list of Path
            The files that were written, the image first.

        Raises
        ------
        BadInput
            If an original file no longer exists or its image has changed its size, the name does not end in .fits or
            .fit, or the folder does not exist.
        """
        target = check_target(path)
        planes = self.original.planes
        pixels = {"image": self.image, "weight": self.weight, "flags": self.flags}
        frames: dict[Path, dict[int, Array]] = {}
        for name, plane in planes.items():
            array = pixels[name]
            assert array is not None
            frames.setdefault(plane.file, {})[plane.number] = array
        image_file, stem = planes["image"].file, target.stem
        outputs = {image_file: target}
        for name, plane in planes.items():
            outputs.setdefault(plane.file, target.with_name(f"{stem}.{name}.fits"))
        for source, output in outputs.items():
            added = [self._table()] if source == image_file else []
            external.copy_with_frames(source, output, frames[source], added)
        return list(outputs.values())

    def _table(self) -> Any:
        original = self.original
        cards = (
            ("INJZP", original.zero_point, "[mag] AB magnitude of one count"),
            ("INJGAIN", original.gain, "electrons per count"),
            ("INJSEED", self.seed, "seed of the noise of the added light"),
            ("INJNOISE", self.noise, "T if the added light has Poisson noise"),
            ("INJOUT", self.outside, "number of sources outside the frame"),
        )
        columns = [
            (name, self.truth[name].to_numpy(), unit, meaning) for name, (unit, meaning) in _TRUTH_COLUMNS.items()
        ]
        return tables.described_table(TABLE_NAME, columns, cards)


@arguments.refuse_missing("truesky.frame(path, psf=0.9) with the FWHM in arcsec, or psf with the path of a file")
def frame(
    path: str | Path,
    psf: str | Path | float,
    weight: str | Path | int | None = None,
    flags: str | Path | int | None = None,
    extension: int | str | None = None,
    zero_point: float | None = None,
    gain: float | None = None,
    saturation: float | None = None,
) -> GivenFrame:
    """Open a calibrated frame of a real telescope, to add sources to it.

    Parameters
    ----------
    path : str or Path
        FITS file of the image in counts. It must have a WCS with right ascension and declination, such as TAN, TAN-SIP
        or TPV.
    psf : str, Path or float
        PSF of the frame: a file of PSFEx, a FITS file with one image of the PSF, or the FWHM in arcsec of stars with a
        Gaussian profile.
    weight, flags : str, Path or int, optional
        Inverse variances in 1 / counts^2, and flag bits: a FITS file, or the name or number of an extension of `path`.
    extension : int or str, optional
        Number or name of the extension with the image. By default the first one with an image.
    zero_point : float, optional
        AB magnitude of one count. By default the card MAGZERO or PHOTZP; or MAGZPT or ZEROPNT, which are the magnitude
        of one count per second, with the exposure time EXPTIME unless BUNIT is a unit per second.
    gain : float, optional
        Electrons per count, by default the card GAIN.
    saturation : float, optional
        Level of saturated pixels in counts, by default the card SATURATE. Without it, no pixel is saturated.

    Returns
    -------
    GivenFrame
        The frame.

    Raises
    ------
    BadInput
        If a file cannot be read, zero point, gain or WCS are missing or wrong, the PSF does not belong to the frame or
        is narrower than a pixel, a weight is negative or NaN, or a file has another number of pixels.
    """
    file = user_files.expand_path(path)
    image, header, primary, number = external.read_frame(file, _extension("extension", extension))
    place, planes = user_files.format_path(file), {"image": _Plane(file, number)}
    image = image if image.dtype.kind == "f" else image.astype(_float_type(image.dtype))
    ny, nx = image.shape
    with Mistakes() as mistakes:
        calibration = mistakes.read(read_calibration, place, (header, primary), zero_point, gain, saturation)
        system = mistakes.read(frame_wcs.read_wcs, place, header, nx, ny)
        weights = mistakes.read(_read_plane, file, weight, "weight", image.shape)
        bits = mistakes.read(_read_plane, file, flags, "flags", image.shape)
    pixel_scale = frame_wcs.pixel_scale(system, nx, ny)
    psf = _check_psf(psf) if isinstance(psf, str | Path) else psf
    model = frame_psf.load_psf(psf, nx, ny, pixel_scale, system)
    if weights is not None:
        planes["weight"] = weights[1]
    if bits is not None:
        planes["flags"] = bits[1]
    return GivenFrame(
        image, None if weights is None else weights[0], None if bits is None else bits[0], system,
        calibration.zero_point, calibration.gain, calibration.saturation, model, planes,
    )  # fmt: skip


def check_target(path: str | Path) -> Path:
    """Return the path of a FITS file that can be written; raises BadInput for another ending or a missing folder."""
    return user_files.check_target(user_files.expand_path(path), (".fits", ".fit"))


def _check_psf(psf: str | Path) -> Path:
    """Return the path of the file of a PSF; raises BadInput if it does not exist or is a FWHM instead."""
    file = user_files.expand_path(psf)
    if isinstance(psf, str) and not file.exists() and (match := _NUMBER.fullmatch(psf)):
        if not match["unit"]:
            raise BadInput(f"psf = {psf!r} is a number in quotes: write psf={psf} for the FWHM in arcsec")
        arguments.refuse_angle("psf", psf, "of arcsec or a file", "arcsec")
        raise BadInput(f"psf must be a number of arcsec or a file, got {psf!r}")
    return user_files.check_file(file, "PSF", "psf")


def _float_type(kind: np.dtype[Any]) -> type[Any]:
    """Return float32 for integers that it stores exactly, else float64."""
    return np.float32 if kind.itemsize <= 2 else np.float64


def _extension(name: str, value: int | str | None) -> int | str | None:
    if value is None or isinstance(value, str):
        return value
    return arguments.check_integer(name, value, 0, 10**6)


def _read_plane(
    image_file: Path, value: str | Path | int | None, name: str, shape: tuple[int, int]
) -> tuple[Array, _Plane] | None:
    """Return the weights or flags of a frame, and their place in a file; None if the frame has none."""
    if value is None:
        return None
    file, extension = image_file, None
    if isinstance(value, str | Path) and (isinstance(value, Path) or user_files.expand_path(value).is_file()):
        file = user_files.expand_path(value)
    elif isinstance(value, str) and "." in value:
        # A name of an extension has no dot, so this is a file that does not exist.
        file = user_files.check_file(user_files.expand_path(value), "calibrated image", name)
    else:
        extension = _extension(name, value)
    pixels, _, _, number = external.read_frame(file, extension)
    place = f"{name}: {user_files.format_path(file)}"
    if pixels.shape != shape:
        has, must = (f"{nx} x {ny} pixels" for ny, nx in (pixels.shape, shape))
        raise BadInput(f"{place}: extension {number} has {has}, but the image has {must}")
    if name == "flags" and pixels.dtype.kind not in "iu":
        raise BadInput(f"{place}: extension {number} has floating-point numbers, but flags must be integers")
    if name == "weight":
        if pixels.dtype.kind != "f":
            pixels = pixels.astype(_float_type(pixels.dtype))
        wrong = ~((pixels >= 0.0) & (pixels < np.inf))
        if wrong.any():
            row, column = (int(at[0]) for at in np.nonzero(wrong))
            problem = f"{np.sum(wrong)} weights are negative or not finite, the first at column {column}, row {row}"
            raise BadInput(f"{place}: {problem} (from 0)")
    return pixels, _Plane(file, number)


def _place_sources(
    row_tables: list[InjectedRows], system: WCS, calibration: Calibration, shape: tuple[int, int]
) -> tuple[pd.DataFrame, Sources]:
    """Return the table of truth and the sources of all rows; positions far from the frame are NaN."""
    ny, nx = shape
    joined = {
        name: np.concatenate([np.zeros(0), *(table.values[name] for table in row_tables)])
        for name in ("ra", "dec", "mag")
    }
    x, y = frame_wcs.pixels_of_sky(system, joined["ra"], joined["dec"], nx, ny)
    is_galaxy = np.concatenate([np.zeros(0, bool), *(np.full(len(t.ids), t.name == "galaxies") for t in row_tables)])
    galaxies = next((t.values for t in row_tables if t.name == "galaxies"), None)
    shapes = galaxy_shapes.shapes(
        pa.table({name: np.zeros(0) if galaxies is None else galaxies[name] for name in galaxy_shapes.COLUMNS})
    )
    flux = calibration.counts(joined["mag"])
    flux[is_galaxy] *= shapes.magnification
    inside = (x >= -0.5) & (x < nx - 0.5) & (y >= -0.5) & (y < ny - 0.5)
    ids = np.concatenate([np.zeros(0, np.int64), *(table.ids for table in row_tables)])
    kinds = np.concatenate([np.zeros(0, "U8"), *(np.full(len(t.ids), t.name, "U8") for t in row_tables)])
    import pandas as pd

    truth = pd.DataFrame(
        {
            "id": ids, "kind": kinds.astype(object), **{name: joined[name] for name in ("ra", "dec")}, "x": x, "y": y,
            "mag": joined["mag"], "flux": flux, "drawn": np.zeros(len(ids)), "on_frame": inside,
        }
    )  # fmt: skip
    is_placed = np.isfinite(x)
    slopes = np.full((len(ids), 2, 2), np.nan)
    slopes[is_placed] = astrometry.jacobian(system, x[is_placed], y[is_placed])
    shape_rows = np.where(is_galaxy, np.cumsum(is_galaxy) - 1, -1)
    return truth, Sources(ids, x, y, slopes, flux * calibration.gain, shape_rows, shapes)
