"""A rendered detector -> FITS files and rows of the table `products`.

products   rows, and a writer for each file
truth      rows of the table `rendered_truth`
science_cards, noise_free_cards
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from jobs.render import focal_plane
from jobs.render.exposure import Rendered
from lake_schema import __version__, fits
from lake_schema.fits import Card
from lake_schema.tables.products import PRODUCTS
from lake_schema.tables.rendered_truth import RENDERED_TRUTH

# Codes of `method` in the table `rendered_truth`.
POINT, PROFILE = 0, 1
_MJD_ZERO = datetime(1858, 11, 17)

Writer = Callable[[Path], None]


def products(rendered: Rendered, truth: Sequence[str] = ("noise_free",)) -> tuple[pa.Table, dict[str, Writer]]:
    """Rows of `products` and, by path, what writes each file.

    truth : truth maps that are wanted beside the science image
    """
    images: dict[str, tuple[npt.NDArray[Any], tuple[Card, ...]]] = {
        "science": (rendered.science, science_cards(rendered))
    }
    if "noise_free" in truth:
        images["noise_free"] = (rendered.noise_free, noise_free_cards(rendered))
    exposure, detector = rendered.exposure, rendered.detector
    stem = f"images/{int(exposure['exposure_id']):06d}/{exposure['channel']}_{exposure['band']}_{detector.name}"
    paths = {content: f"{stem}_{content}.fits" for content in images}
    ra, dec = focal_plane.centre(detector, rendered.wcs)
    n = len(images)
    rows = PRODUCTS.build(
        {
            "path": list(paths.values()),
            "content": list(images),
            "exposure_id": [int(exposure["exposure_id"])] * n,
            "detector": [detector.name] * n,
            "channel": [str(exposure["channel"])] * n,
            "band": [str(exposure["band"])] * n,
            "ra": [ra] * n,
            "dec": [dec] * n,
            "s_region": [focal_plane.s_region(detector, rendered.wcs)] * n,
            "mission": [rendered.scene.mission.fingerprint] * n,
            "sources": [len(rendered.sources)] * n,
        }
    )
    writers: dict[str, Writer] = {
        paths[content]: partial(_write, data, cards) for content, (data, cards) in images.items()
    }
    return rows, writers


def truth(rendered: Rendered) -> pa.Table:
    """One row a source that was drawn, ascending id."""
    sources, n = rendered.sources, len(rendered.sources)
    return RENDERED_TRUTH.build(
        {
            "exposure_id": np.full(n, int(rendered.exposure["exposure_id"]), np.int64),
            "detector": [rendered.detector.name] * n,
            "id": sources.ids,
            "x": sources.column,
            "y": sources.row,
            "expected": sources.electrons,
            "drawn": rendered.drawn,
            "stamp": rendered.sizes,
            "method": np.where(sources.shape < 0, POINT, PROFILE),
        }
    )


def _write(data: npt.NDArray[Any], cards: tuple[Card, ...], path: Path) -> None:
    fits.write_images(path, [fits.Image(data, cards)])


def science_cards(rendered: Rendered) -> tuple[Card, ...]:
    """Header of the science image: what an astronomer needs to calibrate it, and what made it."""
    scene = rendered.scene
    gain = scene.value("gain", "electron / adu")
    dark = scene.value("dark_current", "electron / (s pix)")
    applied = {decision.name: decision.applied for decision in rendered.decisions}
    return (
        *_common(rendered),
        ("BUNIT", "adu", "unit of the pixels"),
        ("GAIN", gain, "[electron/adu]"),
        (
            "RDNOISE",
            applied["read_noise"] * scene.value("read_noise", "electron"),
            "[electron] rms in the image",
        ),
        ("BIAS", scene.value("bias", "adu"), "[adu] added to every pixel"),
        ("SATURATE", _saturation(rendered, gain), "[adu] largest value"),
        ("SKYRATE", applied["background"] * scene.sky_rate, "[electron/s/pix] mean sky in the image"),
        ("DARKRATE", applied["dark_current"] * dark, "[electron/s/pix] mean dark current in the image"),
        *_effect_cards(rendered),
    )


def noise_free_cards(rendered: Rendered) -> tuple[Card, ...]:
    """Header of the truth image: expected electrons of the sources in the exposure, no sky, no detector."""
    return (*_common(rendered), ("BUNIT", "electron", "unit of the pixels: expected, sources alone"))


def _common(rendered: Rendered) -> tuple[Card, ...]:
    exposure, scene, accuracy = rendered.exposure, rendered.scene, rendered.accuracy
    return (
        ("INSTRUME", str(exposure["camera"]), "camera"),
        ("CHANNEL", str(exposure["channel"]), "channel"),
        ("DETECTOR", rendered.detector.name, "detector"),
        ("FILTER", str(exposure["band"]), "passband"),
        ("IMAGETYP", str(exposure["image_type"]), "image type"),
        ("EXPOSURE", int(exposure["exposure_id"]), "identifier of the exposure"),
        ("EXPTIME", scene.exposure_time_s, "[s] effective exposure time"),
        ("DATE-OBS", _date(float(exposure["mjd"])), "start of the exposure"),
        ("MJD-OBS", float(exposure["mjd"]), "[d] start of the exposure"),
        ("TIMESYS", "UTC", "time scale of DATE-OBS and MJD-OBS"),
        *focal_plane.cards(rendered.wcs),
        ("PIXSCALE", rendered.detector.pixel_scale, "[arcsec/pix] at the boresight"),
        ("ZEROPNT", rendered.zero_point, "[mag] AB of 1 electron/s"),
        ("PSFFWHM", rendered.psf.fwhm, "[arcsec] of a point source, pixel included"),
        ("SEEING", float(exposure["seeing"]), "[arcsec] FWHM of the atmosphere"),
        ("NSOURCES", len(rendered.sources), "number of sources drawn"),
        ("SRCREACH", rendered.complete, "[arcsec] beyond the detector: sources complete"),
        ("SEED", str(rendered.seed), "of the random numbers"),
        ("MISSION", rendered.scene.mission.fingerprint, ""),
        ("TRUESKY", __version__, "version of the simulator"),
        ("ACCFLUX", accuracy.flux, "allowed error: fraction of a source's flux"),
        ("ACCBACK", accuracy.background, "allowed error: fraction of a pixel's noise"),
    )


def _date(mjd: float) -> str:
    """ISO 8601, milliseconds."""
    return (_MJD_ZERO + timedelta(days=mjd)).isoformat(timespec="milliseconds")


def _saturation(rendered: Rendered, gain: float) -> float:
    scene = rendered.scene
    full_well = scene.value("full_well", "electron") / gain + scene.value("bias", "adu")
    return float(np.floor(min(full_well, scene.value("adc_max", "adu"))))


def _effect_cards(rendered: Rendered) -> tuple[Card, ...]:
    """EFFECTn = name, whether it was applied, and its contribution over what would be noticed (margin)."""
    cards: list[Card] = []
    for number, decision in enumerate(rendered.decisions, start=1):
        state = ("on" if decision.applied else "off") + (" (forced)" if decision.forced else "")
        cards.append((f"EFFECT{number}", f"{decision.name}: {state}, margin {decision.margin:.3g}", "needed above 1"))
    return tuple(cards)
