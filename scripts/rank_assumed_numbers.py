"""Measure how much each assumed number of a ground camera changes an image, and write docs/assumed_numbers.csv.

    python -m scripts.rank_assumed_numbers [--all]

Without --all, only numbers that are new or have another value than in the file are measured. All take five minutes. A
field of stars is drawn on the central part of the central detector, once with the numbers of the mission database,
and once per assumed number with this number changed. Both images have the same random numbers. The file
scripts/assumed_changes.csv contains the changes, which are plausible errors of the numbers: the first pattern that
matches a name gives its change.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Float
from lake_schema.mission.configuration import MissionConfiguration, resolve
from lake_schema.mission.parameter import Parameter
from lake_schema.tables.exposures import ExposureRow
from truesky.randomness import rng
from truesky.render.camera import amplifiers, astrometry
from truesky.render.camera.detectors import Detector
from truesky.render.channels.aim import Aim
from truesky.render.exposure.records import Rows, Variant
from truesky.render.exposure.render import render
from truesky.render.exposure.rendered_detector import RenderedDetector
from truesky.render.exposure.visible_sources import SHAPE_COLUMNS
from truesky.render.windows import nominal
from truesky.request.accuracy import SURVEY
from truesky.request.instruments import GROUND_CHANNEL, band_names

CHANGES = Path(__file__).with_name("assumed_changes.csv")
RANKING = Path(__file__).resolve().parents[1] / "docs" / "assumed_numbers.csv"
COLUMNS = ("parameter", "value", "changed_to", "unit", "image", "noise", "level", "flux")
# Side of the square of pixels that is drawn, in pixels. Rare features, such as cosmic rays, need the larger one.
_SIDE, _LARGE_SIDE = 256, 1024
_RARE = ("cosmic_rays.", "hot_", "dead_pixels", "dark_columns", "dust")
# Numbers whose effect this measurement cannot show: they act on other detectors, on headers, or on the pointing.
_ELSEWHERE = ("crosstalk_detectors", "fpa.board", "header.", "pointing_error")
# Band of each camera in which numbers that belong to no band are measured.
_BANDS = {
    "decam": "des_r", "gpc1": "ps1_i", "hsc": "hsc_z", "jpcam": "jedis_g", "lsstcam": "lsst_r", "megacam": "cfis_r",
}  # fmt: skip
# Place of the field (ra, dec in degrees), which all sites can observe, and seed of all random numbers.
_PLACE, _SEED = (150.0, -5.0), 1
# Number of stars per 256 x 256 pixels, their range of AB magnitudes, the magnitude of the star in the middle, and the
# radius of the aperture in which its flux is measured (arcsec).
_STARS, _MAGNITUDES, _MIDDLE_MAGNITUDE, _APERTURE = 30, (16.0, 24.0), 18.0, 3.0
# Changes of a pixel are limited to this number of standard deviations of its noise, so that a few pixels do not decide.
_LIMIT = 10.0
_AB_ZERO = 23.9  # AB magnitude of 1 microjansky


@dataclass(frozen=True, slots=True)
class Effect:
    """Change of an image by the change of a number.

    Attributes
    ----------
    changed_to : float
        The number with which the second image was made.
    image : str
        Band and image type, or "" if nothing was measured.
    noise : float
        Root mean square change of a pixel, divided by the noise of a pixel without sources
        (in a flat, with the light of the lamp).
    level : float
        Mean change of a pixel, divided by the same noise.
    flux : float
        Change of the flux of a star of 18 mag in an aperture of 3 arcsec, mmag.
    """

    changed_to: float
    image: str = ""
    noise: float = 0.0
    level: float = 0.0
    flux: float = 0.0


def assumed_parameters(mission: MissionConfiguration) -> list[Parameter]:
    """Return the assumed numbers of ground cameras that are used by default."""
    return [p for p in mission.parameters if p.key.startswith("ext.") and p.confidence == "assumed"]


@cache
def _changes() -> tuple[Mapping[str, str], ...]:
    with CHANGES.open(encoding="utf-8", newline="") as stream:
        return tuple(csv.DictReader(stream))


def changed_value(parameter: Parameter) -> float:
    """Return the value of a number after its plausible change: x factor, + or - a difference, or one of two values."""
    text = next(row["change"] for row in _changes() if fnmatchcase(parameter.key, row["pattern"]))
    if text.startswith("or "):
        return next(float(value) for value in text.split()[1:] if float(value) != parameter.value)
    return parameter.value * float(text[1:]) if text.startswith("x") else parameter.value + float(text)


def measure(parameter: Parameter) -> Effect:
    """Draw two images, and return the effect of the plausible change of a number."""
    changed_to, (camera, name) = changed_value(parameter), parameter.key.split(".", 2)[1:]
    if name.startswith(_ELSEWHERE) or changed_to == parameter.value:
        return Effect(changed_to)
    band, side = _band_of(camera, name), _LARGE_SIDE if name.startswith(_RARE) else _SIDE
    kind = "flat" if name.startswith(("flat.", "exposure_time_flat")) else "science"
    reference = _draw(camera, band, kind, side, ())
    changed = _draw(camera, band, kind, side, ((parameter.key, changed_to, parameter.unit),))
    light = max(float(np.median(_electrons(reference))), 0.0) if kind == "flat" else 0.0
    change = (_electrons(changed) - _electrons(reference)) / np.hypot(reference.scene.pixel_noise, np.sqrt(light))
    clipped = np.clip(change, -_LIMIT, _LIMIT)
    flux = _flux_of_middle(changed) / _flux_of_middle(reference) if kind == "science" else 1.0
    return Effect(
        changed_to, f"{band} {kind}", float(np.sqrt((clipped**2).mean())), float(clipped.mean()),
        float(-2500.0 * np.log10(flux)),
    )  # fmt: skip


def _band_of(camera: str, name: str) -> str:
    """Return the band in the name of a number, or the camera's reddest one for fringes, else the one of `_BANDS`."""
    bands = band_names(GROUND_CHANNEL, camera, resolve())
    named = [band for band in bands if name.startswith(f"{band}.")]
    fringed = [band for band in bands if f"ext.{camera}.{band}.fringes" in resolve()]
    return named[0] if named else fringed[-1] if name == "fringe_period" else _BANDS[camera]


def _draw(
    camera: str, band: str, kind: str, side: int, changes: tuple[tuple[str, float, str], ...]
) -> RenderedDetector:
    """Draw the field on the central pixels of a camera, with some numbers (name, value, unit) changed."""
    return _draw_unchanged(camera, band, kind, side) if not changes else _render(camera, band, kind, side, changes)


@cache
def _draw_unchanged(camera: str, band: str, kind: str, side: int) -> RenderedDetector:
    return _render(camera, band, kind, side, ())


def _render(
    camera: str, band: str, kind: str, side: int, changes: tuple[tuple[str, float, str], ...]
) -> RenderedDetector:
    mission = resolve(overrides={name: (value, unit) for name, value, unit in changes})
    detector = replace(nominal.central_detector(camera, mission), nx=side, ny=side)
    aim = Aim.from_exposure(_exposure(camera, band, kind, mission), detector, None, _SEED)
    return render(aim, _stars(camera, band, detector), Variant(mission, SURVEY, {}), _SEED)


def _exposure(camera: str, band: str, kind: str, mission: MissionConfiguration) -> ExposureRow:
    row = nominal.nominal_exposure((GROUND_CHANNEL, camera), band, _PLACE, _SEED, mission)
    if kind == "science":
        return row
    seconds = mission.value(f"ext.{camera}.exposure_time_flat", "s")
    return replace(row, image_type=kind, exposure_time_s=seconds, sky=0.0)


@cache
def _stars(camera: str, band: str, detector: Detector) -> Rows:
    """Return stars at random pixels of a detector in the unchanged exposure, and one in the middle."""
    system = Aim.from_exposure(_exposure(camera, band, "science", resolve()), detector, None, _SEED).wcs
    random, side = rng.stream(_SEED, "stars of the field"), detector.nx
    count = _STARS * (side // _SIDE) ** 2
    pixels, magnitudes = random.uniform(0.0, side - 1.0, (2, count)), random.uniform(*_MAGNITUDES, count)
    # No other star is near the one in the middle.
    is_far = np.hypot(*(pixels - side / 2)) > 10.0 * _APERTURE / detector.pixel_scale * 0.5
    columns, rows = (np.append(axis[is_far], float(side // 2)) for axis in pixels)
    magnitudes = np.append(magnitudes[is_far], _MIDDLE_MAGNITUDE)
    ra, dec = astrometry.sky_of_pixel(system, columns, rows)
    ids = (5 << 60) + np.arange(len(ra))
    light = np.asarray(10.0 ** (-0.4 * (magnitudes - _AB_ZERO)), np.float32)
    none = {name: np.zeros(0, np.int64 if name in ("id", "kind") else np.float64) for name in SHAPE_COLUMNS}
    return Rows(
        pa.table(none), pa.table({"id": none["id"], f"f_nu_{band}": np.zeros(0, np.float32)}),
        pa.table({"id": ids, "ra": ra, "dec": dec}), pa.table({"id": ids, f"f_nu_{band}": light}),
    )  # fmt: skip


def _electrons(drawn: RenderedDetector) -> Float:
    """Return the electrons (ny, nx) of an image, after subtraction of each amplifier's overscan, by unchanged gains."""
    raw, scene = drawn.raw.astype(float), drawn.scene
    layout = amplifiers.layout(drawn.detector, resolve())
    assert layout is not None
    gains = np.broadcast_to(
        amplifiers.values("gain", "electron / adu", drawn.detector, resolve(), layout), len(layout.amplifiers)
    )
    planes = raw if raw.ndim == 3 else raw[None]
    overscan = planes[:, :, layout.prescan + layout.width :]
    levels = np.median(overscan, axis=(1, 2)) if overscan.size else np.zeros(len(planes))
    frame = layout.assemble((planes - levels[:, None, None]) * gains[:, None, None])
    assert frame.shape == (scene.ny, scene.nx)
    return np.asarray(frame)


def _flux_of_middle(drawn: RenderedDetector) -> float:
    """Return the electrons of the star in the middle, at the place of its position in the header."""
    frame, detector = _electrons(drawn), drawn.detector
    (ra, dec), side = _middle_position(drawn), detector.nx
    column, row = (float(axis[0]) for axis in astrometry.pixel_of_sky(drawn.wcs, [ra], [dec]))
    y, x = np.mgrid[:side, :side]
    distance = np.hypot(x - column, y - row) * detector.pixel_scale
    sky_pixels = frame[(distance > 1.5 * _APERTURE) & (distance < 2.5 * _APERTURE)]
    return float((frame[distance <= _APERTURE] - np.median(sky_pixels)).sum())


def _middle_position(drawn: RenderedDetector) -> tuple[float, float]:
    stars = _stars(drawn.exposure.camera, drawn.exposure.band, drawn.detector).stars
    return float(stars["ra"][-1].as_py()), float(stars["dec"][-1].as_py())


def identity(parameter: Parameter) -> tuple[str, str, str, str]:
    """Return name, value, changed value and unit of a number as texts: the first columns of the table."""
    return parameter.key, f"{parameter.value:.10g}", f"{changed_value(parameter):.10g}", parameter.unit


def rows(parameters: Sequence[Parameter]) -> Iterator[tuple[str, ...]]:
    """Yield the row of the table, as texts, for each of some numbers."""
    for parameter in parameters:
        effect = measure(parameter)
        numbers = (
            [f"{number + 0.0:.3g}" for number in (effect.noise, effect.level, effect.flux)]
            if effect.image
            else [""] * 3
        )
        yield *identity(parameter), effect.image, *numbers


def read_ranking() -> list[dict[str, str]]:
    """Return the rows of docs/assumed_numbers.csv."""
    with RANKING.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def main() -> None:
    """Write the table of all assumed numbers."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("--all", action="store_true", help="measure all numbers again")
    measured: dict[tuple[str, ...], tuple[str, ...]] = {}
    if not parser.parse_args().all:
        measured = {tuple(row[name] for name in COLUMNS[:4]): tuple(row.values()) for row in read_ranking()}
    with RANKING.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(COLUMNS)
        for parameter in assumed_parameters(resolve()):
            writer.writerow(measured.get(identity(parameter)) or next(rows([parameter])))
            stream.flush()


if __name__ == "__main__":
    main()
