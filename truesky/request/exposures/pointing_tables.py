"""Read a user's table of pointings: a CSV file with position and other properties of one exposure per line.

Lines that begin with # are comments. `COLUMNS` lists the columns with units and with defaults for empty fields.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from lake_schema import user_files
from lake_schema.errors import BadInput, Mistakes
from lake_schema.external import csv_headers
from lake_schema.store.provenance import file_sha256
from lake_schema.tables import exposures as declared
from lake_schema.tables.exposures import EUCLID_BANDS
from lake_schema.texts import spelling
from truesky.request import sky_notation
from truesky.request.instruments import EUCLID_CAMERAS, replace_grism

CHANNELS = tuple(code for code, _ in declared.CHANNELS)
IMAGE_TYPES = tuple(code for code, _ in declared.IMAGE_TYPES)

# Columns of the file: name, unit, meaning, and a description of the default for an empty field. A column is required if
# its default is "".
COLUMNS = (
    ("ra", "deg", "right ascension of the boresight, ICRS, -360 to 360, or sexagesimal in hours", ""),
    ("dec", "deg", "declination of the boresight, ICRS, or sexagesimal in degrees", ""),
    (
        "position_angle",
        "deg",
        "position angle of the focal plane's y axis, north through east",
        "Euclid: set by the direction of the Sun; ground: 0",
    ),
    (
        "mjd",
        "d",
        "start of the exposure, MJD (UTC) or an ISO date (UTC)",
        "the observation's `mjd`; Euclid: the first date the Sun allows; ground: its next transit at night",
    ),
    ("channel", "", "VIS, NISP-P, NISP-S or EXT", "the channel of the observation, if it has only one"),
    ("camera", "", "camera in the mission database", "vis, nisp; EXT: the camera of the observation's `survey`"),
    ("band", "", "passband, or a grism", "VIS: euclid_vis"),
    ("exposure_time_s", "s", "effective exposure time", "the observation's, else the mission's"),
    ("image_type", "", "image type, as in a request", "the observation's"),
    ("detectors", "", "names of detectors, separated by blanks", "the observation's, else all of the camera"),
    ("sky", "electron pix-1 s-1", "diffuse sky", "the mission's"),
    (
        "seeing",
        "arcsec",
        "FWHM of the air at zenith and 500 nm, for ground cameras",
        "drawn around the mission's value",
    ),
    ("zero_point", "mag", "AB magnitude of 1 electron/s", "the mission's"),
    ("clouds", "mag", "mean extinction by clouds of the night, for ground cameras", "the observation's, else 0"),
    ("psf", "", "PSF file, relative to the table's folder", "the request's `[psf]`, else the model"),
    ("grism_angle", "deg", "direction of NISP-S spectra in the focal plane: -4, 0, 180 or 184", "0, or the grism's"),
)
# Smallest and largest mean extinction by clouds, mag. A sky with thicker clouds is not observed.
CLOUDS_LIMITS = (0.0, 5.0)
# Smallest and largest allowed number of each column of numbers.
BOUNDS = {
    "ra": sky_notation.RA_LIMITS,
    "dec": sky_notation.DEC_LIMITS,
    "position_angle": (-360.0, 360.0),
    "mjd": sky_notation.MJD_LIMITS,
    "exposure_time_s": (0.0, 1e6),
    "sky": (0.0, 1e6),
    "seeing": (0.01, 10.0),
    "zero_point": (0.0, 50.0),
    "clouds": CLOUDS_LIMITS,
    "grism_angle": (-360.0, 360.0),
}
_REQUIRED = tuple(name for name, _, _, default in COLUMNS if not default)
_NAMES = tuple(name for name, *_ in COLUMNS)
# Names that other programs give to the columns, in lower case.
_OTHER_NAMES = {
    "filter": "band", "exptime": "exposure_time_s", "exposure": "exposure_time_s", "date": "mjd", "date-obs": "mjd",
    "pa": "position_angle", "rotation": "position_angle", "instrument": "camera", "seeingfwhm500": "seeing",
}  # fmt: skip
_MAX_ROWS, _MAX_LENGTH = 1_000_000, 1000
# Largest number of messages about the names of columns.
_MAX_MESSAGES = 20
_MAX_LINES, _MAX_LINE_LENGTH = 2 * _MAX_ROWS, 20 * _MAX_LENGTH
# Number of mistakes after which the rest of a table is not read.
_MAX_MISTAKES = 20


@dataclass(frozen=True, slots=True)
class Visit:
    """Values of a visit of the Rubin Observatory's scheduler from which the planner computes those of its exposures.

    Attributes
    ----------
    exposures : int
        Number of exposures of the visit, which have the exposure time of the row.
    overhead_s : float
        Seconds from the end of an exposure of the visit to the start of the next one.
    seeing_eff : float
        FWHM in arcsec of the Gaussian with the same effective area as the PSF.
    airmass : float
        Airmass to which `seeing_eff` belongs.
    sky_brightness : float
        Surface brightness of the sky, AB mag per arcsec2.
    rot_sky, rot_tel : float, optional
        Rotation of the camera relative to the sky and to the telescope in degrees; one of them may be None.
    parallactic : float, optional
        Position angle of the zenith in degrees; None to compute it.
    """

    exposures: int
    overhead_s: float
    seeing_eff: float
    airmass: float
    sky_brightness: float
    rot_sky: float | None
    rot_tel: float | None
    parallactic: float | None


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
        FWHM of the air at the zenith and at 500 nm, arcsec; always None for Euclid.
    zero_point : float, optional
        AB magnitude of a source that gives 1 electron per second.
    clouds : float, optional
        Mean extinction by clouds in magnitudes; always None for Euclid.
    psf : str, optional
        Path of a PSF file.
    grism_angle : float, optional
        Direction of NISP-S spectra in the focal plane in degrees.
    detectors : tuple of str
        Names of detectors to render; () for the detectors of the observation.
    visit : Visit, optional
        Values of a visit, from which the planner computes sky, seeing and position angle; None for a pointing.
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
    clouds: float | None
    psf: str | None
    grism_angle: float | None
    detectors: tuple[str, ...]
    visit: Visit | None = None


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
    return summarise(path, read(path, channels, image_type))


def summarise(path: Path, rows: Sequence[Row]) -> Contents:
    """Return the summary of the table in a file, whose rows have been read."""
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
        wrong or out of range. There is one message for each column and kind of mistake, which names the file, and the
        first line and the column if there are any.
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
    with Mistakes() as mistakes:
        try:
            names = lines.fieldnames or []
            mistakes.read(_refuse_columns, path, names, channels)
            # The rows are also checked if the table has unknown columns.
            for row in lines if {*_required_columns(channels)} <= {*names} else ():
                if len(rows) >= _MAX_ROWS:
                    raise BadInput(f"{path}: more than {_MAX_ROWS} pointings")
                rows.append(mistakes.read(_row_from_line, row, path, line_number, channels, image_type))
                if len(mistakes) >= _MAX_MISTAKES:
                    break
        except csv.Error as error:
            raise BadInput(f"{path}: {' '.join(str(error).split())}") from None
    return rows


def _required_columns(channels: Sequence[str]) -> tuple[str, ...]:
    return (*_REQUIRED, *(("channel",) if len(channels) > 1 else ()))


def _refuse_columns(path: Path, names: Sequence[str], channels: Sequence[str]) -> None:
    missing = [name for name in _required_columns(channels) if name not in names]
    if missing:
        csv_headers.check_header(path, names)
    similar = {name: _similar_name(name) for name in names if name not in _NAMES}
    renamed = {name: other for name, other in similar.items() if other and other not in names}
    with Mistakes() as mistakes:
        if renamed:
            unknown = user_files.format_path(", ".join(renamed))
            subject = f"columns {unknown} are" if len(renamed) > 1 else f"column {unknown} is"
            mistakes.add(BadInput(f"{path}: {subject} unknown: did you mean {', '.join(renamed.values())}?"))
        if absent := [name for name in missing if name not in renamed.values()]:
            subject = f"column{'s' if len(absent) > 1 else ''} {', '.join(absent)}"
            problem = f"{path}: {subject} {'are' if len(absent) > 1 else 'is'} missing"
            mistakes.add(BadInput(f"{problem}; the first line must have the names of the columns"))
        for name in similar:
            if name not in renamed:
                problem = f"{path}: column {user_files.format_path(name)} is unknown"
                mistakes.add(BadInput(f"{problem}: {spelling.choices(name, _NAMES)}"))
        for name in dict.fromkeys(names):
            if list(names).count(name) > 1:
                mistakes.add(BadInput(f"{path}: column {name} occurs twice"))


def _similar_name(name: str) -> str:
    """Return the name of the column that a user may have meant by an unknown name, or ""."""
    return _OTHER_NAMES.get(name.strip().lower()) or "".join(spelling.closest_names(name, _NAMES, 1))


def _data_lines(path: Path, stream: Iterable[str]) -> Iterator[tuple[int, str]]:
    """Yield number (from 1) and text of each line that does not begin with #.

    Raises BadInput if the file has too many lines or a line is too long.
    """
    for number, line in enumerate(stream, start=1):
        if number > _MAX_LINES or len(line) > _MAX_LINE_LENGTH:
            raise BadInput(f"{path}: more than {_MAX_LINES} lines, or one of more than {_MAX_LINE_LENGTH} characters")
        if not line.startswith("#"):
            yield number, line


def _row_from_line(
    fields: Mapping[str | None, object], path: Path, line: int, channels: Sequence[str], image_type: str
) -> Row:
    location = f"{path} line {line}"
    if not all(isinstance(text, str) and len(text) <= _MAX_LENGTH for text in fields.values() if text is not None):
        raise BadInput(f"{location}: a text is too long, or there are more values than columns")
    row = {str(name): str(text or "").strip() for name, text in fields.items()}
    channel = row.get("channel") or (channels[0] if len(channels) == 1 else "")
    if channel not in channels:
        raise BadInput(f"{location}: channel = {channel!r} is not one of the observation's: {', '.join(channels)}")
    with Mistakes() as mistakes:
        read = mistakes.read
        parsed = Row(
            location=location,
            channel=channel,
            camera=row.get("camera") or EUCLID_CAMERAS.get(channel, ""),
            band=read(_band, row, channel, location),
            image_type=read(_image_type, row, image_type, location),
            ra=read(_angle, row, "ra", location),
            dec=read(_angle, row, "dec", location),
            position_angle=read(_number, row, "position_angle", location),
            mjd=read(_mjd, row, location),
            exposure_time_s=read(_number, row, "exposure_time_s", location),
            sky=read(_number, row, "sky", location),
            seeing=read(_number, row, "seeing", location) if channel == "EXT" else None,
            zero_point=read(_number, row, "zero_point", location),
            clouds=read(_number, row, "clouds", location) if channel == "EXT" else None,
            psf=str(read(user_files.expand_path, row["psf"], path.parent)) if row.get("psf") else None,
            grism_angle=read(_number, row, "grism_angle", location),
            detectors=tuple(row.get("detectors", "").split()),
        )
        spectra = read(replace_grism, parsed.band or "", parsed.grism_angle, f"{location}: grism_angle")
    band, grism_angle = spectra
    return replace(parsed, ra=parsed.ra % 360.0, band=band, grism_angle=grism_angle)


def _band(row: Mapping[str, str], channel: str, location: str) -> str:
    euclid_bands = EUCLID_BANDS.get(channel, ())
    band = row.get("band") or (euclid_bands[0] if len(euclid_bands) == 1 else "")
    if not band:
        allowed = f": one of {', '.join(euclid_bands)}" if euclid_bands else ""
        raise BadInput(f"{location}: band is missing{allowed}")
    return band


def _image_type(row: Mapping[str, str], default: str, location: str) -> str:
    kind = row.get("image_type") or default
    if kind not in IMAGE_TYPES:
        raise BadInput(f"{location}: image_type = {kind!r} is not one of {', '.join(IMAGE_TYPES)}")
    return kind


def _number(row: Mapping[str, str], name: str, location: str) -> float | None:
    """Read a number from a field of a row; None if the field is empty. Raises BadInput if it is wrong."""
    if not row.get(name):
        return None
    try:
        value = float(row[name])
    except ValueError:
        raise BadInput(f"{location}: {name} = {row[name]!r} is not a number") from None
    lo, hi = BOUNDS[name]
    if not lo <= value <= hi:
        raise BadInput(f"{location}: {name} = {value} is outside {lo:g} to {hi:g}")
    return value


def _angle(row: Mapping[str, str], axis: str, location: str) -> float:
    if not row[axis]:
        raise BadInput(f"{location}: {axis} is missing")
    ra = _as_number(row["ra"]) if axis == "dec" else None
    return sky_notation.angle(_as_number(row[axis]), f"{location}: {axis}", axis, BOUNDS[axis], ra)


def _mjd(row: Mapping[str, str], location: str) -> float | None:
    return sky_notation.mjd(_as_number(row["mjd"]), f"{location}: mjd") if row.get("mjd") else None


def _as_number(text: str) -> float | str:
    """Return the number that a text contains, or the text if it is not a number."""
    try:
        return float(text)
    except ValueError:
        return text
