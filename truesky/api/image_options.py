"""Arguments of images of single places, and their checks."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypedDict

from lake_schema import arguments
from lake_schema.errors import BadInput
from lake_schema.texts import spelling, synonyms
from truesky.request import sky_notation
from truesky.request.accuracy import Accuracy
from truesky.request.from_toml import from_table

# Largest number of an exposure and largest identifier of a source, which are signed 64-bit integers.
_MAX_INT64 = 2**63 - 1
# Largest side of an image in arcsec.
_MAX_SIZE = 3600.0
# Other arguments of the methods that take `ImageOptions`.
_ARGUMENTS = {"render": ("ra", "dec", "size", "band"), "stamps": ("table", "size", "band", "processes")}


class ImageOptions(TypedDict, total=False):
    """Options of `Lake.render`. All may be left out.

    Attributes
    ----------
    camera : str
        Name of the camera. By default the first one that has the band.
    exposure : int
        Number of a planned exposure of the lake, whose band, pointing, PSF and sky are used. The band, `camera` and
        `date` are then ignored. By default a nominal exposure of the band, in which the place is in the middle of the
        central detector. Its date, sky and PSF belong to the middle of the surrounding square degree.
    date : float or str
        Start of a nominal exposure, as MJD or as an ISO date in UTC. By default the first date at which the Sun
        allows the place (Euclid), or at which the place crosses the meridian at night (ground cameras).
    accuracy : str or mapping
        Name of an accuracy, such as ``survey`` (see `truesky.accuracies`), or its four errors. By default ``survey``.
    noise : bool
        If False, no raw image is made. By default True.
    seed : int
        Seed of the noise. By default the seed of the lake.
    effects : collection of str
        Names of the detector effects of the raw image, such as ``poisson`` and ``read_noise``. By default the effects
        that are noticeable. Effects that depend on the rest of the detector, such as charge transfer and ghosts,
        cannot be applied.
    without : sequence of int
        Identifiers of sources or of arcs of strong lenses that are left out. `Lake.render` refuses an identifier that
        does not exist around the image.
    extra : table
        Sources to add, with the columns of the section ``[sources]`` of a request: stars with ``ra``, ``dec`` and
        ``mag`` (AB, in the band of the image), galaxies also with ``half_light_radius``, ``axis_ratio`` and so on. A
        DataFrame, an astropy or Arrow table, or a dictionary of arrays; or a dictionary with two such tables,
        ``galaxies`` and ``stars``.
    """

    camera: str | None
    exposure: int | None
    date: float | str | None
    accuracy: str | Mapping[str, float]
    noise: bool
    seed: int | None
    effects: Collection[str] | None
    without: Sequence[int]
    extra: Any


@dataclass(frozen=True, slots=True)
class ImageRequest:
    """Arguments of `Lake.render`, after they have been checked.

    Attributes
    ----------
    ra, dec : float
        Position of the middle of the image, deg.
    size : float
        Side of the image, arcsec.
    band : str
        Name of the passband.
    camera : str or None
        Name of the camera; None for the first one with this band.
    exposure : int or None
        Number of a planned exposure; None for a nominal exposure.
    mjd : float or None
        Start of a nominal exposure, MJD.
    accuracy : Accuracy
        Errors that are accepted.
    noise : bool
        True to make a raw image.
    noise_seed : int or None
        Seed of the noise; None for the seed of the lake.
    effects : tuple of str or None
        Names of the effects of the raw image; None for those that are noticeable.
    without : tuple of int
        Identifiers of sources that are left out.
    extra : object
        Table of sources that are added; None for none.
    title : str
        Row of the user's table of places, for messages, such as "places.csv, row 1"; "" without a table.
    """

    ra: float
    dec: float
    size: float
    band: str
    camera: str | None
    exposure: int | None
    mjd: float | None
    accuracy: Accuracy
    noise: bool
    noise_seed: int | None
    effects: tuple[str, ...] | None
    without: tuple[int, ...]
    extra: Any
    title: str = ""


def check_request(
    place: tuple[float | str, float | str], size: float, band: str, options: ImageOptions, method: str = "render"
) -> ImageRequest:
    """Check the arguments of `Lake.render` or `Lake.stamps`.

    Parameters
    ----------
    place : (float or str, float or str)
        Right ascension and declination, in degrees or sexagesimal.
    size : float
        Side of the image, arcsec.
    band : str
        Name of the passband.
    options : ImageOptions
        The other arguments.
    method : str, optional
        Name of the method, "render" or "stamps", for messages about unknown arguments.

    Returns
    -------
    ImageRequest
        The arguments.

    Raises
    ------
    BadInput
        If an option is unknown or its value is not valid. The message names the option and the allowed values.
    """
    _refuse_unknown(method, options)
    if not isinstance(band, str):
        raise BadInput(f"band must be the name of one passband, got {band!r}: call lake.{method} once for each band")
    exposure, date, seed = (options.get(name) for name in ("exposure", "date", "seed"))
    effects, without, noise = options.get("effects"), options.get("without", ()), options.get("noise", True)
    if noise not in (True, False):
        raise BadInput(f"noise = {noise!r} must be True or False")
    return ImageRequest(
        *check_place(*place),
        check_size(size),
        band,
        options.get("camera"),
        None if exposure is None else _check_exposure(exposure),
        None if date is None else sky_notation.mjd(date, "date"),
        parse_accuracy(options.get("accuracy", "survey")),
        bool(noise),
        None if seed is None else check_count("seed", seed),
        None if effects is None else _check_effects(effects),
        tuple(arguments.check_integers("without", without, 0, _MAX_INT64)),
        options.get("extra"),
    )


def _refuse_unknown(method: str, options: ImageOptions) -> None:
    """Raise BadInput for an option that does not exist. The message lists the arguments of the method."""
    allowed = (*_ARGUMENTS[method], *ImageOptions.__annotations__)
    for name in options:
        if name not in allowed:
            question = spelling.did_you_mean(name, allowed)
            if synonyms.find_columns(name, ("exposures",), ("exposure_time_s",)):
                question = "the exposure time is that of the camera, or of the planned exposure exposure=N;"
            raise BadInput(f"lake.{method} has no argument {name}: {question} allowed: {', '.join(allowed)}")


def _check_exposure(exposure: Any) -> int:
    if isinstance(exposure, str):
        numbers = 'lake.table("exposures", "exposure_id") lists them'
        raise BadInput(f"exposure must be the number of a planned exposure, got {exposure!r}; {numbers}")
    return check_count("exposure", exposure)


def _check_effects(effects: Collection[str]) -> tuple[str, ...]:
    if isinstance(effects, str):
        raise BadInput(f'effects must be a list such as ["poisson"], got {effects!r}; effects=[] for none')
    return arguments.check_names("effects", effects)


def check_place(ra: float | str, dec: float | str) -> tuple[float, float]:
    """Return a position in degrees, with ra from 0 to 360; raises BadInput if the values are not allowed."""
    return (
        sky_notation.angle(ra, "ra", "ra", sky_notation.RA_LIMITS) % 360.0,
        sky_notation.angle(dec, "dec", "dec", sky_notation.DEC_LIMITS, ra),
    )


def check_size(size: float) -> float:
    """Return the side of an image in arcsec; raises BadInput if it is not a number from 0 to 3600."""
    arguments.refuse_angle("size", size, "of arcsec", "arcsec")
    return arguments.check_number("size", size, 0.0, _MAX_SIZE, "arcsec")


def check_count(name: str, value: Any) -> int:
    """Return a number of an exposure, or a seed; raises BadInput if it is not a 64-bit integer from 0 on."""
    return arguments.check_integer(name, value, 0, _MAX_INT64)


def parse_accuracy(value: str | Mapping[str, float]) -> Accuracy:
    """Return an accuracy from its name or its four errors; raises BadInput if it is not valid."""
    area = {"cone": {"ra": 0.0, "dec": 0.0, "radius": 0.1}}
    return from_table({"name": "image", "seed": 0, "area": area, "accuracy": value}).accuracy
