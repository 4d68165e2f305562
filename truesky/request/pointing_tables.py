"""Read a user's table of pointings: a CSV file with position and other properties of one exposure per line.

Lines that begin with # are comments. `COLUMNS` lists the columns with units and with defaults for empty fields.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lake_schema import user_files
from lake_schema.errors import BadInput
from lake_schema.store.provenance import file_sha256
from lake_schema.tables import exposures as declared
from lake_schema.tables.exposures import EUCLID_BANDS

CHANNELS = tuple(code for code, _ in declared.CHANNELS)
IMAGE_TYPES = tuple(code for code, _ in declared.IMAGE_TYPES)

# Columns of the file: name, unit, meaning, and a description of the default for an empty field. A column is required if
# its default is "".
COLUMNS = (
    ("ra", "deg", "right ascension of the boresight, ICRS, -360 to 360", ""),
    ("dec", "deg", "declination of the boresight, ICRS", ""),
    (
        "position_angle",
        "deg",
        "position angle of the focal plane's y axis, north through east",
        "Euclid: set by the direction of the Sun; ground: 0",
    ),
    (
        "mjd",
        "d",
        "start of the exposure, MJD (UTC)",
        "the observation's `mjd`; Euclid: the first date the Sun allows; ground: when the field is next up at night",
    ),
    ("channel", "", "VIS, NISP-P, NISP-S or EXT", "the channel of the observation, if it has only one"),
    ("camera", "", "camera in the mission database", "vis, nisp; EXT: the camera of the observation's `survey`"),
    ("band", "", "passband", "VIS: euclid_vis"),
    ("exposure_time_s", "s", "effective exposure time", "the observation's, else the mission's"),
    ("image_type", "", "image type, as in a request", "the observation's"),
    ("detectors", "", "names of detectors, separated by blanks", "the observation's, else all of the camera"),
    ("sky", "electron pix-1 s-1", "diffuse sky", "the mission's"),
    ("seeing", "arcsec", "FWHM of the atmosphere for ground cameras", "drawn around the mission's value"),
    ("zero_point", "mag", "AB magnitude of 1 electron/s", "the mission's"),
    ("psf", "", "PSF file, relative to the table's folder", "the request's `[psf]`, else the model"),
    ("grism_angle", "deg", "direction of NISP-S spectra in the focal plane: -4, 0, 180 or 184", "0"),
)
_REQUIRED = tuple(name for name, _, _, default in COLUMNS if not default)
_NAMES = tuple(name for name, *_ in COLUMNS)
_MAX_ROWS, _MAX_LENGTH = 1_000_000, 1000
_MAX_LINES, _MAX_LINE_LENGTH = 2 * _MAX_ROWS, 20 * _MAX_LENGTH


@dataclass(frozen=True, slots=True)
class Row:
    """One exposure of a table of pointings.

    An attribute is None, "" or () if its field is empty and its default is not in the file. The default may be in the
    observation, the request or the mission database.

    Attributes
    ----------
    location : str
        File and line of the exposure, for error messages.
    channel : str
        VIS, NISP-P, NISP-S or EXT (ground cameras).
    camera : str
        Name of the camera in the mission database; "" for the camera of the observation's ground survey.
    band : str
        Name of the passband.
    image_type : str
        Image type, such as "science".
    ra, dec : float
        ICRS position of the boresight in degrees.
    position_angle : float, optional
        Position angle of the focal plane's y axis in degrees, from north through east.
    mjd : float, optional
        Start of the exposure (MJD, UTC).
    exposure_time_s : float, optional
        Effective exposure time in seconds.
    sky : float, optional
        Diffuse sky brightness in electrons per pixel and second.
    seeing : float, optional
        FWHM of the atmosphere's PSF in arcsec; always None for Euclid.
    zero_point : float, optional
        AB magnitude of a source that gives 1 electron per second.
    psf : str, optional
        Path of a PSF file.
    grism_angle : float, optional
        Direction of NISP-S spectra in the focal plane in degrees.
    detectors : tuple of str
        Names of detectors to render; () for the detectors of the observation.
    """

    location: str
    channel: str
    camera: str
    band: str
    image_type: str
    ra: float
    dec: float
    position_angle: float | None
    mjd: float | None
    exposure_time_s: float | None
    sky: float | None
    seeing: float | None
    zero_point: float | None
    psf: str | None
    grism_angle: float | None
    detectors: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Contents:
    """Summary of a table of pointings.

    Attributes
    ----------
    sha256 : str
        SHA-256 checksum of the file.
    bands : tuple of str
        Passbands of the exposures, each once.
    kinds : tuple of (str, str)
        Pairs (channel, image type) of the exposures, each once.
    """

    sha256: str
    bands: tuple[str, ...]
    kinds: tuple[tuple[str, str], ...]


def contents(path: Path, channels: Sequence[str], image_type: str) -> Contents:
    """Read and check a table of pointings, and return its summary.

    Parameters
    ----------
    path : Path
        The file.
    channels : sequence of str
        Channels of the observation to which the table belongs.
    image_type : str
        Image type of the observation, the default for rows without one.

    Returns
    -------
    Contents
        Checksum of the file, and passbands, channels and image types of its exposures.

    Raises
    ------
    BadInput
        If the file does not exist or the table is not valid, see `read`.
    """
    rows = read(path, channels, image_type)
    bands = tuple(dict.fromkeys(row.band for row in rows))
    return Contents(file_sha256(path), bands, tuple(dict.fromkeys((row.channel, row.image_type) for row in rows)))


def read(path: Path, channels: Sequence[str], image_type: str) -> list[Row]:
    """Read and check a table of pointings.

    Parameters
    ----------
    path : Path
        The file.
    channels : sequence of str
        Channels of the observation to which the table belongs.
    image_type : str
        Image type of the observation, the default for rows without one.

    Returns
    -------
    list of Row
        The exposures in the order of the file; empty if the file has only a line with column names.

    Raises
    ------
    BadInput
        If the file does not exist or is too long, a column is missing, unknown or repeated, or a value is missing,
        wrong or out of range. The message names the file, and the line and the column if there are any.
    """
    stream = io.StringIO(user_files.read_text(path, "table of pointings"), newline="")
    numbered_lines, line_number = _data_lines(path, stream), 0

    def texts() -> Iterator[str]:
        nonlocal line_number
        for number, line in numbered_lines:
            line_number = number
            yield line

    lines = csv.DictReader(texts())
    rows: list[Row] = []
    try:
        _refuse_columns(path, lines.fieldnames or [], channels)
        for row in lines:
            if len(rows) >= _MAX_ROWS:
                raise BadInput(f"{path}: more than {_MAX_ROWS} pointings")
            if not all(isinstance(text, str) and len(text) <= _MAX_LENGTH for text in row.values() if text is not None):
                raise BadInput(f"{path} line {line_number}: a text is too long, or there are more values than columns")
            rows.append(
                _row_from_line({k: (v or "").strip() for k, v in row.items()}, path, line_number, channels, image_type)
            )
    except csv.Error as error:
        raise BadInput(f"{path}: {' '.join(str(error).split())}") from None
    return rows


def _refuse_columns(path: Path, names: Sequence[str], channels: Sequence[str]) -> None:
    required = (*_REQUIRED, *(("channel",) if len(channels) > 1 else ()))
    if missing := [name for name in required if name not in names]:
        raise BadInput(f"{path}: column {missing[0]} is missing")
    if unknown := [name for name in names if name not in _NAMES]:
        raise BadInput(f"{path}: column {user_files.format_path(unknown[0])} is unknown; allowed: {', '.join(_NAMES)}")
    if twice := [name for name in names if list(names).count(name) > 1]:
        raise BadInput(f"{path}: column {twice[0]} occurs twice")


def _data_lines(path: Path, stream: Iterable[str]) -> Iterator[tuple[int, str]]:
    """Yield number (from 1) and text of each line that does not begin with #.

    Raises BadInput if the file has too many lines or a line is too long.
    """
    for number, line in enumerate(stream, start=1):
        if number > _MAX_LINES or len(line) > _MAX_LINE_LENGTH:
            raise BadInput(f"{path}: more than {_MAX_LINES} lines, or one of more than {_MAX_LINE_LENGTH} characters")
        if not line.startswith("#"):
            yield number, line


def _row_from_line(row: Mapping[str, str], path: Path, line: int, channels: Sequence[str], image_type: str) -> Row:
    location = f"{path} line {line}"
    channel = row.get("channel") or (channels[0] if len(channels) == 1 else "")
    if channel not in channels:
        raise BadInput(f"{location}: channel = {channel!r} is not one of the observation's: {', '.join(channels)}")
    euclid_bands = EUCLID_BANDS.get(channel, ())
    band = row.get("band") or (euclid_bands[0] if len(euclid_bands) == 1 else "")
    if not band:
        raise BadInput(f"{location}: band is missing")
    kind = row.get("image_type") or image_type
    if kind not in IMAGE_TYPES:
        raise BadInput(f"{location}: image_type = {kind!r} is not one of {', '.join(IMAGE_TYPES)}")

    def number_of(name: str, lo: float, hi: float) -> float:
        if not row[name]:
            raise BadInput(f"{location}: {name} is missing")
        try:
            value = float(row[name])
        except ValueError:
            raise BadInput(f"{location}: {name} = {row[name]!r} is not a number") from None
        if not lo <= value <= hi:
            raise BadInput(f"{location}: {name} = {value} is outside {lo:g} to {hi:g}")
        return value

    def optional(name: str, lo: float, hi: float) -> float | None:
        return number_of(name, lo, hi) if row.get(name) else None

    return Row(
        location=location,
        channel=channel,
        camera=row.get("camera") or ("" if channel == "EXT" else channel.lower().partition("-")[0]),
        band=band,
        image_type=kind,
        ra=number_of("ra", -360.0, 360.0) % 360.0,
        dec=number_of("dec", -90.0, 90.0),
        position_angle=optional("position_angle", -360.0, 360.0),
        mjd=optional("mjd", 40_000.0, 100_000.0),
        exposure_time_s=optional("exposure_time_s", 0.0, 1e6),
        sky=optional("sky", 0.0, 1e6),
        seeing=optional("seeing", 0.01, 10.0) if channel == "EXT" else None,
        zero_point=optional("zero_point", 0.0, 50.0),
        psf=str(user_files.expand_path(row["psf"], path.parent)) if row.get("psf") else None,
        grism_angle=optional("grism_angle", -360.0, 360.0),
        detectors=tuple(row.get("detectors", "").split()),
    )
