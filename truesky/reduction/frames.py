"""Frames of a lake: which there are of a detector, what is known of each, and their electrons.

Frame         one raw file of a detector, and what its exposure and its header say
of_lake       those of the table `products`, by detector
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lake_schema.arrays import Bool, Float, Float32
from lake_schema.errors import BadInput
from lake_schema.fits import images
from lake_schema.fits.images import Card
from lake_schema.mission.published import read_back as mission_of
from lake_schema.store import read
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes.inputs import passband_from_facts
from truesky.randomness import rng
from truesky.reduction import amplifiers
from truesky.render.camera import detectors
from truesky.render.effects.light import fringes, pixel_area
from truesky.render.effects.scene import Scene
from truesky.render.exposure import scene_factory
from truesky.render.exposure.rendered_detector import random_identity
from truesky.render.planning import variants
from truesky.render.planning.exposure_chunks import rows_of_exposures
from truesky.render.products import read_back, sidecar_files
from truesky.request.accuracy import Accuracy


@dataclass(frozen=True, slots=True)
class Frame:
    """A raw file.

    scene   : what effects may know of it, from the lake's plan and mission
    applied : names of the effects that are in it, from its header
    cards   : of the header that holds for all arrays; the WCS is that of the detector's pixels
    psf     : the file of its PSF beside it; None: the lake has none
    """

    path: Path
    exposure: ExposureRow
    scene: Scene
    applied: frozenset[str]
    cards: tuple[Card, ...]
    psf: Path | None = None

    @property
    def detector(self) -> str:
        """Its name."""
        assert self.scene.detector is not None
        return self.scene.detector.name

    @property
    def stem(self) -> str:
        """Of files made from it."""
        return f"{self.exposure.exposure_id:06d}_{self.exposure.channel}_{self.exposure.band}_{self.detector}"

    @property
    def mean_gain(self) -> float:
        """Of its amplifiers, electrons an ADU."""
        return float(np.mean(self.scene.amplifier_values("gain", "electron / adu")))

    def card(self, keyword: str) -> Any:
        """The value of a card of the common header."""
        return next((value for key, value, _ in self.cards if key == keyword), None)

    def electrons(self) -> Float:
        """e- [ny, nx] above the level of each amplifier's overscan."""
        return np.asarray(read_back.electrons(self.path).data, np.float64)

    def saturated_pixels(self) -> Bool:
        """Pixels [ny, nx] that read no less than a saturated one."""
        levels = self._amplifier_values("SATURATE")
        adu = np.asarray(read_back.frame(self.path).data)
        return amplifiers.pixels_at_least(adu, levels, self.scene)

    def fringes(self) -> Float32 | None:
        """[ny, nx] over the sky that each pixel sees, as the mission declares them; None where there are none."""
        effect = fringes.EFFECT
        if effect.name not in self.applied:
            return None
        _, amplitude, period = effect.parameters(self.scene)
        generator = rng.stream(*random_identity(effect, self.exposure, self.detector, int(self.card("SEED"))))
        zeros = np.zeros((self.scene.ny, self.scene.nx))
        pattern = effect.apply(zeros, 1.0, amplitude, period, rng=generator)
        if pixel_area.EFFECT.name in self.applied:
            pattern /= pixel_area.apply(np.ones_like(pattern), 1.0, *pixel_area.parameters(self.scene)[1:])
        return np.asarray(pattern, np.float32)

    @property
    def ramp(self) -> tuple[int, int, int]:
        """Groups, reads and drops of its ramp."""
        groups, reads, drops = (int(self.card(key)) for key in ("NG", "NR", "ND"))
        return groups, reads, drops

    def misfit_pixels(self) -> Bool:
        """Pixels [ny, nx] whose ramp does not fit; of two groups nothing is known."""
        units = images.read_images(self.path)
        if len(units) < 3:
            return np.zeros((self.scene.ny, self.scene.nx), bool)
        border, quality = int(self.card("REFPIX")), np.asarray(units[2].data)
        quality = quality[border : len(quality) - border, border : quality.shape[1] - border]
        # One bit, or chi^2 itself.
        flagged = any(key == "QUALFLAG" for key, _, _ in units[2].cards)
        return np.asarray(quality > (0 if flagged else float(self.card("QUALLIM"))))

    def _amplifier_values(self, keyword: str) -> float | Float:
        """A card of the common header, else of the arrays' own, [q]."""
        if (value := self.card(keyword)) is not None:
            return float(value)
        headers = (dict((key, value) for key, value, _ in unit.cards) for unit in images.read_images(self.path)[1:])
        return np.array([float(cards[keyword]) for cards in headers])


def from_lake(
    root: Path, detector_names: Sequence[str] = (), exposures: Iterable[int] = (), request: str | None = None
) -> dict[tuple[str, str], list[Frame]]:
    """(camera, detector) -> its frames, by exposure; only those that are named where some are.

    root      : of the lake;  wanted : names of detectors
    exposures : their numbers
    request   : whose frames, where a lake has those of several
    Errors    : BadInput where the lake has no such frames
    """
    version = read.version(root, "products", request=request)
    inputs = version.manifest["facts"]["inputs"]
    products = version.rows()
    planned_rows = rows_of_exposures(
        read.version(root, "exposures", inputs["exposures"]), products["exposure_id"].unique().to_pylist()
    )
    planned = {row.exposure_id: row for row in map(ExposureRow.from_row, planned_rows.to_pylist())}
    mission = mission_of(read.version(root, "mission", inputs["mission"]))
    flux_facts = read.version(root, "galaxy_fluxes", inputs["galaxy_fluxes"]).manifest["facts"]
    request_facts, exposure_numbers = version.manifest["facts"]["request"], set(exposures)
    forced = dict.fromkeys(request_facts["effects"]["on"], True) | dict.fromkeys(request_facts["effects"]["off"], False)
    by_detector: dict[tuple[str, str], list[Frame]] = {}
    rows = sorted(products.to_pylist(), key=lambda row: (row["exposure_id"], row["detector"]))
    for row in rows:
        if row["content"] != "science" or (detector_names and row["detector"] not in detector_names):
            continue
        if exposure_numbers and row["exposure_id"] not in exposure_numbers:
            continue
        exposure = planned[row["exposure_id"]]
        variant = variants.variant(exposure.settings, mission, Accuracy(**request_facts["accuracy"]), forced)
        detector = detectors.detector(exposure.camera, row["detector"], variant.mission)
        scene = scene_factory.from_exposure(exposure, detector, variant.mission, variant.accuracy)
        scene = replace(scene, band=passband_from_facts(root, flux_facts, exposure.band), forced=variant.forced)
        path = version.sidecar_path(row["path"])
        cards = read_back.header(path)
        key = (exposure.camera, row["detector"])
        psf_name = sidecar_files.psf_file(exposure.exposure_id, exposure.channel, exposure.band, row["detector"])
        psf = version.sidecar_path(psf_name) if version.has_file(psf_name) else None
        by_detector.setdefault(key, []).append(Frame(path, exposure, scene, _applied_effects(cards), cards, psf))
    for name in detector_names:
        if not any(detector == name for _, detector in by_detector):
            raise BadInput(f"table products: no image of detector {name!r}")
    for number in exposure_numbers:
        if not any(frame.exposure.exposure_id == number for frames in by_detector.values() for frame in frames):
            raise BadInput(f"table products: no image of exposure {number}")
    return by_detector


def _applied_effects(cards: Iterable[Card]) -> frozenset[str]:
    """Names of the effects that a header has as `on`."""
    texts = [str(value) for keyword, value, _ in cards if keyword.startswith("EFFECT")]
    return frozenset(name for name, _, state in (text.partition(": ") for text in texts) if state.startswith("on"))


def select_types(frames: Sequence[Frame], image_types: Sequence[str]) -> list[Frame]:
    """Those of some image types."""
    return [frame for frame in frames if frame.exposure.image_type in image_types]


def common_values(frames: Sequence[Frame], keywords: Sequence[str]) -> Mapping[str, Any]:
    """Values of cards that all frames share; BadInput names one in which they differ."""
    for keyword in keywords:
        values = {str(frame.card(keyword)) for frame in frames}
        if len(values) > 1:
            raise BadInput(f"frames of {frames[0].detector} differ in {keyword}: {', '.join(sorted(values)[:3])}")
    return {keyword: frames[0].card(keyword) for keyword in keywords}
