"""Add sources to the raw image of a detector that is in a lake, exactly as if they had been in the catalogues."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lake_schema import arguments
from lake_schema.arrays import Array, Float32
from lake_schema.errors import BadInput
from lake_schema.store import read
from lake_schema.store.object_storage.s3 import Folder
from lake_schema.tables.exposures import SELECTION_BANDS
from truesky.api import added
from truesky.cosmology import from_facts
from truesky.render import detector_inputs
from truesky.render.channels.aim import Aim
from truesky.render.drawing.stored_drawing import DrawingStore
from truesky.render.exposure import render
from truesky.render.exposure.records import Rows, Variant
from truesky.render.exposure.rendered_detector import RenderedDetector
from truesky.render.previous_exposures import ChargeMaps
from truesky.render.products import fits_files, truth_table

if TYPE_CHECKING:
    # Needed for annotations only.
    import pandas as pd

# Largest number of images that an error message lists.
_MAX_LISTED = 8


@dataclass(slots=True)
class _Shared:
    """Inputs, drawings and charge maps that an image without and with additional sources shares."""

    drawings: DrawingStore
    charge_maps: ChargeMaps
    inputs: tuple[Aim, Rows, Variant] | None = None


class LakeFrame:
    """Raw image of a detector in a lake, with additional sources. `Lake.frame` returns it.

    All pixels are simulated again, so that the image is the same, bit by bit, as if the sources had been in the
    catalogues: their photon noise, saturation, charge transfer and all other effects are included. The random numbers
    of everything else do not change.

    Parameters
    ----------
    root : Folder
        The lake.
    version : Version
        Version of the table `products`.
    exposure : int
        Number of the exposure.
    detector : str
        Name of the detector.

    """

    def __init__(self, root: Folder, version: read.Version, exposure: int, detector: str) -> None:
        image_facts = {"exposure_id": exposure, "detector": detector}
        parts = [part["facts"] for part in version.manifest["parts"] if image_facts.items() <= part["facts"].items()]
        if not parts:
            facts = [part["facts"] for part in version.manifest["parts"]]
            raise no_image(root, exposure, detector, ((part["exposure_id"], part["detector"]) for part in facts))
        self._root, self._facts = root, {**version.manifest["facts"], **parts[0]}
        self._extra: Any = None
        self._shared = _Shared(DrawingStore(added.is_added), ChargeMaps.from_environment())
        self._rendered: RenderedDetector | None = None
        self._has_maps = False

    @arguments.refuse_missing('frame.with_sources({"ra": [53.1], "dec": [-27.8], "mag": [21.0]})')
    def with_sources(self, rows: Any) -> LakeFrame:
        """Return the image with additional sources.

        Parameters
        ----------
        rows : table or mapping
            Sources with the columns of the section ``[sources]`` of a request, as for `Lake.render`. ``mag`` is in the
            band of the exposure; for slitless images, in H of Euclid.

        Returns
        -------
        LakeFrame
            The new image. It is computed when its pixels are first used.

        Raises
        ------
        BadInput
            If the image has additional sources already.
        """
        if self._extra is not None:
            raise BadInput("rows: this image has additional sources already, give all of them in one call")
        new = object.__new__(LakeFrame)
        new._root, new._facts, new._extra, new._rendered = self._root, self._facts, rows, None
        new._shared, new._has_maps = self._shared, False
        return new

    def _result(self, with_maps: bool = False) -> RenderedDetector:
        if self._rendered is None or (with_maps and not self._has_maps):
            request = self._facts["request"]
            if self._shared.inputs is None:
                self._shared.inputs = detector_inputs.load_inputs(self._root, self._facts, self._shared.charge_maps)
            aim, rows, variant = self._shared.inputs
            # The file of a PSF is read again for each image.
            detector_inputs.check_psf_files(aim.exposure, rows.previous_exposures, self._facts)
            if self._extra is not None:
                band = SELECTION_BANDS.get(aim.exposure.channel, aim.exposure.band)
                galaxies = read.version(self._root, "galaxies", self._facts["inputs"]["galaxies"])
                rows = added.add_sources(rows, self._extra, band, from_facts(galaxies.manifest["facts"]))
            self._rendered = render.render(
                aim, rows, variant, request["seed"], request["truth"] if with_maps else (),
                noise_seed=request["noise_seed"], drawings=self._shared.drawings,
            )  # fmt: skip
            self._has_maps = with_maps
        return self._rendered

    @property
    def raw(self) -> Array:
        """Raw pixels of the detector without prescan and overscan, ADU, shape (ny, nx)."""
        return self._result().science

    @property
    def noise_free(self) -> Float32:
        """Expected electrons of the sources alone, float32[ny, nx]."""
        return self._result().noise_free

    @property
    def maps(self) -> Mapping[str, Array]:
        """Truth maps (ny, nx) that the request asks for, by name."""
        return self._result(with_maps=True).maps

    @property
    def truth(self) -> pd.DataFrame:
        """Drawn sources: the columns of the table ``rendered_truth``."""
        frame: pd.DataFrame = truth_table.truth(self._result()).to_pandas()
        return frame

    @property
    def added_rows(self) -> pd.DataFrame:
        """Rows of `truth` of the additional sources. The last digits of their identifiers count the user's rows."""
        truth = self.truth
        return truth[added.is_added(truth["id"].to_numpy())].reset_index(drop=True)

    @arguments.refuse_missing('frame.write("image.fits")')
    def write(self, path: str | Path) -> Path:
        """Write the raw image in the format of the images of the lake; an existing file is replaced.

        Parameters
        ----------
        path : str or Path
            The FITS file.

        Returns
        -------
        Path
            The file.
        """
        request, file = self._facts["request"], Path(path)
        rows, writers = fits_files.products(self._result(), (), request["compression"] == "rice", request["wcs"])
        writers[rows["path"][0].as_py()](file)
        return file


def no_image(root: Folder, exposure: int, detector: str, rendered: Iterable[tuple[int, str]]) -> BadInput:
    """Return the error for an image that a lake does not have.

    Parameters
    ----------
    root : Folder
        The lake.
    exposure : int
        Number of the exposure.
    detector : str
        Name of the detector.
    rendered : iterable of (int, str)
        Exposure and detector of the images in the lake.

    Returns
    -------
    BadInput
        The error, which lists the first images of the lake.
    """
    listed = [f"{name} of exposure {number}" for number, name in sorted(dict.fromkeys(rendered))]
    rest = ", .." if len(listed) > _MAX_LISTED else ""
    existing = f"{', '.join(listed[:_MAX_LISTED])}{rest}" if listed else "no images"
    problem = f"nothing was rendered for detector {detector} of exposure {exposure}"
    return BadInput(f"lake {root}: {problem}; it has {existing}")
