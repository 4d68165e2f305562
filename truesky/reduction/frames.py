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
from truesky.fluxes.inputs import passband_of
from truesky.randomness import rng
from truesky.reduction import amplifiers
from truesky.render.camera import detectors
from truesky.render.effects.light import fringes, pixel_area
from truesky.render.effects.scene import Scene
from truesky.render.exposure import scene_of
from truesky.render.exposure.rendered import numbers_of
from truesky.render.planning import variants
from truesky.render.planning.parts import of_exposures
from truesky.render.products import beside, read_back
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
        return float(np.mean(self.scene.of_amplifiers("gain", "electron / adu")))

    def card(self, keyword: str) -> Any:
        """The value of a card of the common header."""
        return next((value for key, value, _ in self.cards if key == keyword), None)

    def electrons(self) -> Float:
        """e- [ny, nx] above the level of each amplifier's overscan."""
        return np.asarray(read_back.electrons(self.path).data, np.float64)

    def full(self) -> Bool:
        """Pixels [ny, nx] that read no less than a saturated one."""
        levels = self._of_amplifiers("SATURATE")
        adu = np.asarray(read_back.frame(self.path).data)
        return amplifiers.at_least(adu, levels, self.scene)

    def fringes(self) -> Float32 | None:
        """[ny, nx] over the sky that each pixel sees, as the mission declares them; None where there are none."""
        effect = fringes.EFFECT
        if effect.name not in self.applied:
            return None
        _, amplitude, period = effect.parameters(self.scene)
        own = rng.stream(*numbers_of(effect, self.exposure, self.detector, int(self.card("SEED"))))
        nothing = np.zeros((self.scene.ny, self.scene.nx))
        found = effect.apply(nothing, 1.0, amplitude, period, rng=own)
        if pixel_area.EFFECT.name in self.applied:
            found /= pixel_area.apply(np.ones_like(found), 1.0, *pixel_area.parameters(self.scene)[1:])
        return np.asarray(found, np.float32)

    @property
    def ramp(self) -> tuple[int, int, int]:
        """Groups, reads and drops of its ramp."""
        groups, reads, drops = (int(self.card(key)) for key in ("NG", "NR", "ND"))
        return groups, reads, drops

    def misfit(self) -> Bool:
        """Pixels [ny, nx] whose ramp does not fit; of two groups nothing is known."""
        units = images.read_images(self.path)
        if len(units) < 3:
            return np.zeros((self.scene.ny, self.scene.nx), bool)
        border, quality = int(self.card("REFPIX")), np.asarray(units[2].data)
        quality = quality[border : len(quality) - border, border : quality.shape[1] - border]
        # One bit, or chi^2 itself.
        flagged = any(key == "QUALFLAG" for key, _, _ in units[2].cards)
        return np.asarray(quality > (0 if flagged else float(self.card("QUALLIM"))))

    def _of_amplifiers(self, keyword: str) -> float | Float:
        """A card of the common header, else of the arrays' own, [q]."""
        if (value := self.card(keyword)) is not None:
            return float(value)
        found = (dict((key, value) for key, value, _ in unit.cards) for unit in images.read_images(self.path)[1:])
        return np.array([float(cards[keyword]) for cards in found])


def of_lake(
    root: Path, wanted: Sequence[str] = (), exposures: Iterable[int] = (), request: str | None = None
) -> dict[tuple[str, str], list[Frame]]:
    """(camera, detector) -> its frames, by exposure; only those that are named where some are.

    root      : of the lake;  wanted : names of detectors
    exposures : their numbers
    request   : whose frames, where a lake has those of several
    Errors    : BadInput where the lake has no such frames
    """
    version = read.version(root, "products", request=request)
    inputs = version.manifest["facts"]["inputs"]
    made = version.rows()
    held = of_exposures(read.version(root, "exposures", inputs["exposures"]), made["exposure_id"].unique().to_pylist())
    planned = {row.exposure_id: row for row in map(ExposureRow.of, held.to_pylist())}
    mission = mission_of(read.version(root, "mission", inputs["mission"]))
    fluxes = read.version(root, "galaxy_fluxes", inputs["galaxy_fluxes"]).manifest["facts"]
    own_request, only = version.manifest["facts"]["request"], set(exposures)
    forced = dict.fromkeys(own_request["effects"]["on"], True) | dict.fromkeys(own_request["effects"]["off"], False)
    found: dict[tuple[str, str], list[Frame]] = {}
    rows = sorted(made.to_pylist(), key=lambda row: (row["exposure_id"], row["detector"]))
    for row in rows:
        if row["content"] != "science" or (wanted and row["detector"] not in wanted):
            continue
        if only and row["exposure_id"] not in only:
            continue
        exposed = planned[row["exposure_id"]]
        own = variants.variant(exposed.settings, mission, Accuracy(**own_request["accuracy"]), forced)
        detector = detectors.detector(exposed.camera, row["detector"], own.mission)
        scene = scene_of.scene_of(exposed, detector, own.mission, own.accuracy)
        scene = replace(scene, band=passband_of(root, fluxes, exposed.band), forced=own.forced)
        path = version.file(row["path"])
        cards = read_back.header(path)
        key = (exposed.camera, row["detector"])
        model = beside.psf_file(exposed.exposure_id, exposed.channel, exposed.band, row["detector"])
        psf = version.file(model) if version.has(model) else None
        found.setdefault(key, []).append(Frame(path, exposed, scene, _applied(cards), cards, psf))
    for name in wanted:
        if not any(detector == name for _, detector in found):
            raise BadInput(f"table products: no image of detector {name!r}")
    for number in only:
        if not any(frame.exposure.exposure_id == number for frames in found.values() for frame in frames):
            raise BadInput(f"table products: no image of exposure {number}")
    return found


def _applied(cards: Iterable[Card]) -> frozenset[str]:
    """Names of the effects that a header has as `on`."""
    texts = [str(value) for keyword, value, _ in cards if keyword.startswith("EFFECT")]
    return frozenset(name for name, _, state in (text.partition(": ") for text in texts) if state.startswith("on"))


def of_types(frames: Sequence[Frame], kinds: Sequence[str]) -> list[Frame]:
    """Those of some image types."""
    return [frame for frame in frames if frame.exposure.image_type in kinds]


def common(frames: Sequence[Frame], keywords: Sequence[str]) -> Mapping[str, Any]:
    """Values of cards that all frames share; BadInput names one in which they differ."""
    for keyword in keywords:
        values = {str(frame.card(keyword)) for frame in frames}
        if len(values) > 1:
            raise BadInput(f"frames of {frames[0].detector} differ in {keyword}: {', '.join(sorted(values)[:3])}")
    return {keyword: frames[0].card(keyword) for keyword in keywords}
