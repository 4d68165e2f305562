"""Read the tables and images of a lake."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from lake_schema import arguments
from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.fits import images
from lake_schema.fits.images import Image
from truesky.api.tables import LakeTables

if TYPE_CHECKING:
    from astropy.wcs import WCS

# Numbers of exposures and sources are 64-bit integers.
_MAX_INT64 = 2**63 - 1


class Lake(LakeTables):
    """A lake, opened for reading.

    All methods use the tables as they were when the lake was opened, even if newer versions are published later. Use a
    `with` block, or call `close`, to end the process that answers queries.

    Several threads may use the same lake. One process answers its queries one after the other, so open the lake once
    per thread to run queries at the same time. `close` also ends queries that other threads are waiting for; these
    raise `BadInput`.

    Parameters
    ----------
    path : str or Path
        Folder of the lake, or its address on object storage, ``s3://BUCKET/PREFIX``.
    request : str, optional
        Name of a request. The lake then shows the tables of this request only. Without it, a table that all requests
        share is called by its name, and a table of one request by both names, for example ``demo.products``.
    memory : float, optional
        Bytes that a query and its result may take together.
    timeout : float, optional
        Seconds after which a query is stopped.

    Raises
    ------
    BadInput
        If the folder is not a lake, or has no table of this request.

    Examples
    --------
    >>> import truesky
    >>> lake = truesky.open("out/demo/lake")  # doctest: +SKIP
    >>> lake.sql("SELECT count(*) FROM galaxies WHERE z_obs > 1")  # doctest: +SKIP
    """

    def images(self, content: str | None = "science") -> pd.DataFrame:
        """List the image files.

        Parameters
        ----------
        content : str or None, optional
            What the files hold: ``science``, ``noise_free``, ``cosmic_rays`` and so on. None lists all files.

        Returns
        -------
        pandas.DataFrame
            One row per file: the columns of the table ``products``, and ``file``, its path relative to the lake.
        """
        version = self._explorer._version("products")
        files = version.rows().to_pandas()
        files["file"] = [f"products/v-{version.key}/{path}" for path in files["path"]]
        return files if content is None else files[files["content"] == content].reset_index(drop=True)

    def image(self, path: str, electrons: bool = False) -> Image:
        """Read one image as the pixels of its detector, without overscan and in one piece.

        The checksum of the file is verified first.

        Parameters
        ----------
        path : str
            The column ``path`` of `images`.
        electrons : bool, optional
            Convert to electrons above the bias level, instead of the stored units.

        Returns
        -------
        Image
            `data`, an array [ny, nx], and `cards`, the FITS header as (keyword, value, comment).

        Raises
        ------
        BadInput
            If the lake has no such file, or its pixels are not electrons.
        Damaged
            If the file is not as it was written.
        """
        from truesky.render.products import read_back

        file = self._explorer._version("products").sidecar_path(path)
        return read_back.electrons(file) if electrons else read_back.frame(file)

    def extensions(self, path: str) -> list[Image]:
        """Read all arrays of an image file as they are stored, with overscans and quality.

        Parameters
        ----------
        path : str
            The column ``path`` of `images`.

        Returns
        -------
        list of Image
            One per extension of the FITS file. The first has the header that applies to all. `data` is None if an
            extension has no array.
        """
        return images.read_images(self._explorer._version("products").sidecar_path(path))

    def wcs(self, path: str) -> WCS:
        """Return the world coordinate system of an image's pixels.

        Parameters
        ----------
        path : str
            The column ``path`` of `images`.

        Returns
        -------
        astropy.wcs.WCS
            Converts between ICRS positions and pixels of the array that `image` returns, counted from 0.
        """
        from astropy.wcs import WCS, FITSFixedWarning

        from truesky.render.products import read_back

        cards = read_back.header(self._explorer._version("products").sidecar_path(path))
        header = {keyword: value for keyword, value, _ in cards}
        with warnings.catch_warnings():
            # astropy warns even if it only normalises the date.
            warnings.simplefilter("ignore", FITSFixedWarning)
            return WCS(header)

    def models(
        self, exposure_id: int, detector: str, sources: Sequence[int] | None = None
    ) -> Iterator[tuple[int, Float]]:
        """Draw single sources of a published slitless image, each by itself and without noise.

        The expected electrons of all sources add up to the truth image ``noise_free``.

        Parameters
        ----------
        exposure_id : int
            Number of the exposure, one that a grism disperses.
        detector : str
            Name of the detector.
        sources : sequence of int, optional
            Identifiers of the sources. The default is all sources whose spectra may reach the detector.

        Yields
        ------
        source : int
            Identifier.
        electrons : ndarray of float64, shape (ny, nx)
            Expected electrons of this source, in all orders of the grism. They are 0 if its spectrum misses the
            detector by little.

        Raises
        ------
        BadInput
            If there is no such image, it is not dispersed, or the spectrum of a source cannot reach the detector. The
            error is raised by the call, before the first source is drawn.
        """
        from truesky.render import models

        version = self._explorer._version("products")
        number = arguments.check_integer("exposure_id", exposure_id, 0, _MAX_INT64)
        ids = None if sources is None else arguments.check_integers("sources", sources, 0, _MAX_INT64)
        source_models = models.models(self._explorer.root, version, number, str(detector), ids)
        return ((source_model.id, source_model.frame) for source_model in source_models)

    def truth(self, exposure_id: int, detector: str) -> pd.DataFrame:
        """List the sources that were drawn on one detector of an exposure.

        Parameters
        ----------
        exposure_id : int
            Number of the exposure.
        detector : str
            Name of the detector.

        Returns
        -------
        pandas.DataFrame
            The rows of the table ``rendered_truth``: identifier, pixel position, electrons, magnitude and so on.

        Raises
        ------
        BadInput
            If nothing was rendered for this detector.
        """
        files = self.images(content=None)
        if not np.any((files["exposure_id"] == exposure_id) & (files["detector"] == detector)):
            raise BadInput(
                f"lake {self._explorer.root}: nothing was rendered for detector {detector} of exposure {exposure_id}"
            )
        query = "SELECT * FROM rendered_truth WHERE exposure_id = $exposure AND detector = $detector"
        return self.sql(query, exposure=int(exposure_id), detector=str(detector))
