"""Find the raw frames in a lake (a folder of simulated tables and images), and read their pixels and headers.

Each frame comes with the planned exposure and with the mission parameters (of telescope, camera and detector) that were
used to simulate it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lake_schema.arrays import Bool, Float
from lake_schema.errors import BadInput
from lake_schema.fits import images
from lake_schema.fits.images import Card
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.mission.published import read_back as mission_of
from lake_schema.store import read
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes.inputs import passband_from_facts
from truesky.reduction import amplifiers
from truesky.render.camera import detectors
from truesky.render.effects.readout import quadrants
from truesky.render.effects.scene import Scene
from truesky.render.exposure import scene_factory
from truesky.render.planning import variants
from truesky.render.planning.exposure_chunks import rows_of_exposures
from truesky.render.products import read_back, sidecar_files
from truesky.request.accuracy import Accuracy


@dataclass(frozen=True, slots=True)
class Frame:
    """A raw frame of one detector.

    Attributes
    ----------
    path : Path
        FITS file with the raw pixels.
    exposure : ExposureRow
        Row of the table `exposures`: time, pointing, filter and settings of the exposure.
    scene : Scene
        Exposure of this detector with all parameters of the simulated effects (gain, noise, readout mode, ...).
    applied : frozenset of str
        Names of the optical and detector effects that were simulated in the frame, from its header.
    cards : tuple of Card
        Primary header as (keyword, value, comment). The WCS is for the pixels without prescan and overscan.
    psf : Path, optional
        PSF file that was written with the frame; None if the lake does not contain it.
    """

    path: Path
    exposure: ExposureRow
    scene: Scene
    applied: frozenset[str]
    cards: tuple[Card, ...]
    psf: Path | None = None

    @property
    def detector(self) -> str:
        """Return the name of the detector, for example "3-4" or "DET22"."""
        assert self.scene.detector is not None
        return self.scene.detector.name

    @property
    def stem(self) -> str:
        """Return the file name without suffix for products of this frame: exposure number, channel, band, detector."""
        return f"{self.exposure.exposure_id:06d}_{self.exposure.channel}_{self.exposure.band}_{self.detector}"

    @property
    def mean_gain(self) -> float:
        """Return the gain in electrons per ADU, averaged over the amplifiers of the detector."""
        return float(np.mean(self.scene.amplifier_values("gain", "electron / adu")))

    def card(self, keyword: str) -> Any:
        """Return the value of a keyword in the primary header, or None if the header does not have it."""
        return next((value for key, value, _ in self.cards if key == keyword), None)

    def electrons(self) -> Float:
        """Read the pixels and return them in electrons above the overscan level of their amplifier, float64[ny, nx]."""
        return np.asarray(read_back.electrons(self.path).data, np.float64)

    def saturated_pixels(self) -> Bool:
        """Return a mask that is True for pixels at or above the saturation level of their amplifier, bool[ny, nx]."""
        levels = self._amplifier_values("SATURATE")
        adu = np.asarray(read_back.frame(self.path).data)
        return amplifiers.pixels_at_least(adu, levels, self.scene)

    @property
    def ramp(self) -> tuple[int, int, int]:
        """Return the readout mode of an infrared ramp: groups, reads per group, and dropped reads between groups."""
        groups, reads, drops = (int(self.card(key)) for key in ("NG", "NR", "ND"))
        return groups, reads, drops

    def misfit_pixels(self) -> Bool:
        """Return a mask, bool[ny, nx], of pixels whose infrared ramp is not well fitted by a straight line.

        A fit is bad if its chi^2 exceeds the header value QUALLIM, or if the file marks it as bad. The mask is False
        everywhere if the file has no quality extension. Ramps of two groups have no chi^2, so their mask is also False.
        """
        units = images.read_images(self.path)
        if len(units) < 3:
            return np.zeros((self.scene.ny, self.scene.nx), bool)
        border, quality = int(self.card("REFPIX")), np.asarray(units[2].data)
        quality = quality[border : len(quality) - border, border : quality.shape[1] - border]
        # The quality extension contains either one bit (the header then has QUALFLAG) or chi^2 of the fit.
        flagged = any(key == "QUALFLAG" for key, _, _ in units[2].cards)
        return np.asarray(quality > (0 if flagged else float(self.card("QUALLIM"))))

    def _amplifier_values(self, keyword: str) -> float | Float:
        """Return the value of a keyword from the primary header, or else one value per amplifier.

        Values of amplifiers are read from the headers of the image extensions. Raises KeyError if one does not have the
        keyword.
        """
        if (value := self.card(keyword)) is not None:
            return float(value)
        extensions = quadrants.in_plane_order(images.read_images(self.path)[1:])
        headers = (dict((key, value) for key, value, _ in unit.cards) for unit in extensions)
        return np.array([float(cards[keyword]) for cards in headers])


@dataclass(frozen=True, slots=True)
class FrameSource:
    """A version of the table `products`, with everything that its raw frames have in common.

    Attributes
    ----------
    root : Path
        Folder of the lake.
    products : Version
        Version of the table `products`.
    mission : MissionConfiguration
        Mission parameters with which the frames were simulated.
    flux_facts : mapping
        Facts of the fluxes from which the frames were simulated.
    """

    root: Path
    products: read.Version
    mission: MissionConfiguration
    flux_facts: Mapping[str, Any]

    @classmethod
    def from_products(cls, root: Path, products: read.Version) -> FrameSource:
        """Read what the frames of a version of the table `products` have in common; `root` is the lake's folder."""
        inputs = products.manifest["facts"]["inputs"]
        mission = mission_of(read.version(root, "mission", inputs["mission"]))
        fluxes = read.version(root, "galaxy_fluxes", inputs["galaxy_fluxes"])
        return cls(root, products, mission, fluxes.manifest["facts"])

    def read_exposures(self, numbers: Collection[int]) -> dict[int, ExposureRow]:
        """Return the rows of the table `exposures` from which frames were rendered, by the numbers of exposures."""
        exposures = read.version(self.root, "exposures", self.products.manifest["facts"]["inputs"]["exposures"])
        rows = rows_of_exposures(exposures, numbers).to_pylist()
        return {row.exposure_id: row for row in map(ExposureRow.from_row, rows)}

    def open_frame(self, row: Mapping[str, Any], exposure: ExposureRow) -> Frame:
        """Open a raw frame after comparing the sha256 of its files, and read its header.

        Parameters
        ----------
        row : mapping
            Row of the table `products` of a science image.
        exposure : ExposureRow
            Exposure of the frame.

        Returns
        -------
        Frame
            The frame.

        Raises
        ------
        Damaged
            If a file is missing or differs from the manifest.
        """
        request = self.products.manifest["facts"]["request"]
        forced = dict.fromkeys(request["effects"]["on"], True) | dict.fromkeys(request["effects"]["off"], False)
        variant = variants.variant(exposure.settings, self.mission, Accuracy(**request["accuracy"]), forced)
        detector = detectors.detector(exposure.camera, row["detector"], variant.mission)
        scene = scene_factory.from_exposure(exposure, detector, variant.mission, variant.accuracy)
        band = passband_from_facts(self.root, self.flux_facts, exposure.band)
        scene = replace(scene, band=band, forced=variant.forced)
        path = read_back.image_file(self.products, row["path"])
        cards = read_back.header(path)
        psf_name = sidecar_files.psf_file(exposure.exposure_id, exposure.channel, exposure.band, row["detector"])
        psf = self.products.sidecar_path(psf_name) if self.products.has_file(psf_name) else None
        return Frame(path, exposure, scene, _applied_effects(cards), cards, psf)


def from_lake(
    root: Path, detector_names: Sequence[str] = (), exposures: Iterable[int] = (), request: str | None = None
) -> dict[tuple[str, str], list[Frame]]:
    """Return the raw frames of all image types (science, bias, flat, ...) in a lake, by camera and detector.

    Files with other contents, such as maps of the true sky, are left out.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    detector_names : sequence of str, optional
        Names of the detectors; all detectors by default.
    exposures : iterable of int, optional
        Numbers of the exposures; all exposures by default.
    request : str, optional
        Name of the request (simulation job) whose frames are returned. It is required if requests have different
        frames.

    Returns
    -------
    dict of (str, str) to list of Frame
        Frames by (camera, detector), each list sorted by exposure number. Empty if the table `products` lists no raw
        frame and no detector or exposure was given.

    Raises
    ------
    BadInput
        If the lake has no table `products` of the request, or no frame of one of the given detectors or exposures.
    """
    version = read.version(root, "products", request=request)
    source = FrameSource.from_products(root, version)
    products = version.rows()
    planned, exposure_numbers = source.read_exposures(products["exposure_id"].unique().to_pylist()), set(exposures)
    by_detector: dict[tuple[str, str], list[Frame]] = {}
    rows = sorted(products.to_pylist(), key=lambda row: (row["exposure_id"], row["detector"]))
    for row in rows:
        if row["content"] != "science" or (detector_names and row["detector"] not in detector_names):
            continue
        if exposure_numbers and row["exposure_id"] not in exposure_numbers:
            continue
        frame = source.open_frame(row, planned[row["exposure_id"]])
        by_detector.setdefault((frame.exposure.camera, row["detector"]), []).append(frame)
    for name in detector_names:
        if not any(detector == name for _, detector in by_detector):
            raise BadInput(f"table products: no image of detector {name!r}")
    for number in exposure_numbers:
        if not any(frame.exposure.exposure_id == number for frames in by_detector.values() for frame in frames):
            raise BadInput(f"table products: no image of exposure {number}")
    return by_detector


def _applied_effects(cards: Iterable[Card]) -> frozenset[str]:
    """Return the names of the effects that a header lists as applied: cards EFFECT<n> with the value "name: on..."."""
    texts = [str(value) for keyword, value, _ in cards if keyword.startswith("EFFECT")]
    return frozenset(name for name, _, state in (text.partition(": ") for text in texts) if state.startswith("on"))


def select_types(frames: Sequence[Frame], image_types: Sequence[str]) -> list[Frame]:
    """Return the frames whose image type (such as "bias" or "flat") is in `image_types`, in the same order."""
    return [frame for frame in frames if frame.exposure.image_type in image_types]


def common_values(frames: Sequence[Frame], keywords: Sequence[str]) -> Mapping[str, Any]:
    """Return the values of header keywords that all frames must share, by keyword; None for a missing keyword.

    Raises BadInput if two frames have different values. `frames` must not be empty.
    """
    for keyword in keywords:
        values = {str(frame.card(keyword)) for frame in frames}
        if len(values) > 1:
            raise BadInput(f"frames of {frames[0].detector} differ in {keyword}: {', '.join(sorted(values)[:3])}")
    return {keyword: frames[0].card(keyword) for keyword in keywords}
