"""Read the tables and images of a lake (the folder with all results of simulations): class `Lake`."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from lake_schema import arguments
from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.fits import images
from lake_schema.fits.images import Image
from lake_schema.tables import products
from lake_schema.texts import spelling
from truesky.api.tables import LakeTables

if TYPE_CHECKING:
    import pandas as pd
    from astropy.wcs import WCS

    from truesky.api.image_options import ImageOptions
    from truesky.api.lake_frames import LakeFrame
    from truesky.api.sky_images import SkyImage, SkyPainter

# Largest number of an exposure and largest identifier of a source, which are signed 64-bit integers.
_MAX_INT64 = 2**63 - 1
# Largest number of processes that draw images.
_MAX_PROCESSES = 1024


class Lake(LakeTables):
    """A lake (the folder with all tables and images of simulations), opened for reading.

    All methods use the tables as they were when the lake was opened, even if newer versions are published later. SQL
    queries run in a separate process. Use a `with` block, or call `close`, to end this process.

    Several threads may use the same object, but its process answers one query after the other. Open the lake once per
    thread to run queries at the same time. If a thread calls `close`, queries of other threads raise `BadInput`.

    Parameters
    ----------
    path : str or Path
        Folder of the lake, or its address on object storage, ``s3://BUCKET/PREFIX``.
    request : str, optional
        Name of a request (one of the simulations in the lake). The lake then shows the tables of this request only.
        Without it, a table that all requests share is called by its name, and a table of one request by both names,
        for example ``demo.products``.
    memory : float, optional
        Memory limit of a query and its result together, 1e7 to 1e15 bytes.
    timeout : float, optional
        Time in seconds after which a query is stopped, 0 to 1e6.

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
        """List the image files of the lake.

        Parameters
        ----------
        content : str or None, optional
            Content of the files to list: ``science`` (simulated raw images), ``noise_free``, ``cosmic_rays`` and so on.
            None lists all files.

        Returns
        -------
        pandas.DataFrame
            One row per file: the columns of the table ``products``, and ``file``, the path of the file relative to the
            folder of the lake. There are no rows if no file has this content.

        Raises
        ------
        BadInput
            If there is no such content, the lake has no table ``products``, or requests have different versions of it
            and no request was chosen.
        """
        version = self._explorer._version("products")
        contents = [name for name, _ in products.CONTENTS]
        if content is not None and content not in contents:
            raise BadInput(f"content = {content!r}: {spelling.choices(str(content), contents)}")
        files = version.rows().to_pandas()
        files["file"] = [f"products/v-{version.key}/{path}" for path in files["path"]]
        return files if content is None else files[files["content"] == content].reset_index(drop=True)

    @arguments.refuse_missing("lake.image(path); lake.images() lists the paths")
    def image(self, path: str, electrons: bool = False) -> Image:
        """Read an image file as one array with all pixels of the detector, without overscan.

        The checksum of the file is verified first.

        Parameters
        ----------
        path : str
            Path of the file, as in the column ``path`` of the result of `images`.
        electrons : bool, optional
            If True, convert pixels to electrons above the bias level. By default they have the stored unit.

        Returns
        -------
        Image
            `data`, an array of shape (ny, nx), and `cards`, the FITS header as (keyword, value, comment).

        Raises
        ------
        BadInput
            If the lake has no such file, or `electrons` is True and the pixels cannot be converted to electrons.
        Damaged
            If the checksum of the file is wrong.
        """
        from truesky.render.products import read_back

        file = self._image_file(path)
        return read_back.electrons(file) if electrons else read_back.frame(file)

    @arguments.refuse_missing("lake.extensions(path); lake.images() lists the paths")
    def extensions(self, path: str) -> list[Image]:
        """Read all extensions of an image file as they are stored, with overscans and arrays of quality flags.

        Parameters
        ----------
        path : str
            Path of the file, as in the column ``path`` of the result of `images`.

        Returns
        -------
        list of Image
            One entry per extension of the FITS file. The first entry has the primary header, which applies to all.
            `data` is None if an extension has no array.

        Raises
        ------
        BadInput
            If the lake has no such file.
        Damaged
            If the checksum of the file is wrong.
        """
        return images.read_images(self._image_file(path))

    @arguments.refuse_missing("lake.wcs(path); lake.images() lists the paths")
    def wcs(self, path: str) -> WCS:
        """Return the world coordinate system of the pixels of an image.

        Parameters
        ----------
        path : str
            Path of the file, as in the column ``path`` of the result of `images`.

        Returns
        -------
        astropy.wcs.WCS
            Converts between ICRS positions and pixels of the array that `image` returns. The centre of its first pixel
            is (0, 0) if methods with 0-based pixels are used.

        Raises
        ------
        BadInput
            If the lake has no such file.
        Damaged
            If the checksum of the file is wrong.
        """
        from astropy.wcs import WCS, FITSFixedWarning

        from truesky.render.products import read_back

        cards = read_back.header(self._image_file(path))
        header = {keyword: value for keyword, value, _ in cards}
        with warnings.catch_warnings():
            # astropy would warn even if it only changes the format of the date.
            warnings.simplefilter("ignore", FITSFixedWarning)
            return WCS(header)

    @arguments.refuse_missing("lake.models(exposure_id, detector); lake.images() lists both")
    def models(
        self, exposure_id: int, detector: str, sources: Sequence[int] | None = None
    ) -> Iterator[tuple[int, Float]]:
        """Draw each source of a slitless image that is in the lake on a separate frame, without noise.

        The frames of all sources add up to the truth image ``noise_free`` (expected electrons of the sources alone).

        Parameters
        ----------
        exposure_id : int
            Number of an exposure with a grism.
        detector : str
            Name of the detector.
        sources : sequence of int, optional
            Identifiers of the sources. The default is all sources whose spectra may reach the detector.

        Returns
        -------
        iterator of (int, ndarray of float64)
            Identifier of each source, and its expected electrons per pixel in all orders of the grism, shape (ny, nx).
            All are 0 if the spectrum just misses the detector.

        Raises
        ------
        BadInput
            If there is no such image, the exposure has no grism, or a source of `sources` is unknown or too far from
            the detector. The error is raised by the call itself, before the first source is drawn.
        """
        from truesky.render import models

        version = self._explorer._version("products")
        number = arguments.check_integer("exposure_id", exposure_id, 0, _MAX_INT64)
        ids = None if sources is None else arguments.check_integers("sources", sources, 0, _MAX_INT64)
        source_models = models.models(self._explorer.root, version, number, str(detector), ids)
        return ((source_model.id, source_model.frame) for source_model in source_models)

    @arguments.refuse_missing("lake.render(ra, dec), in degrees")
    def render(
        self,
        ra: float | str,
        dec: float | str,
        size: float = 64.0,
        band: str = "euclid_vis",
        **options: Unpack[ImageOptions],
    ) -> SkyImage:
        """Draw an image of one place on the sky from the catalogues of the lake.

        No Spark is needed, and nothing is written. Slitless spectra cannot be drawn.

        Parameters
        ----------
        ra, dec : float or str
            Position of the middle of the image, in degrees or sexagesimal. An image at the edge of a detector is
            moved onto the detector.
        size : float, optional
            Side of the image in arcsec, at most that of a detector.
        band : str, optional
            Name of the passband, such as ``euclid_vis`` or ``lsst_r``. The lake must have fluxes in this band.
        **options : ImageOptions
            The exposure, the accuracy, the noise, and sources to add or to leave out: see `ImageOptions`.

        Returns
        -------
        SkyImage
            The image and its truth.

        Raises
        ------
        BadInput
            If an option is not valid, the place is outside the catalogues or on none of the detectors of the exposure,
            or the lake has no fluxes in the band.
        """
        from truesky.api import image_options

        return self._painter.draw(image_options.check_request((ra, dec), size, band, options), refuse_unknown=True)

    @arguments.refuse_missing('lake.stamps({"ra": [53.1], "dec": [-27.8]}), in degrees')
    def stamps(
        self,
        table: Any,
        size: float = 64.0,
        band: str = "euclid_vis",
        processes: int | None = None,
        **options: Unpack[ImageOptions],
    ) -> Iterator[SkyImage]:
        """Draw images of many places, in several processes.

        Each image is the same as that of `render`, whatever the number of processes and the order of the places.
        Neighbouring places share the rows of the catalogues and the PSF, so a table that is sorted by position is
        drawn fastest.

        Parameters
        ----------
        table : table, str, Path or mapping
            Places: a table with the columns ``ra`` and ``dec`` (deg), or the path of one (Parquet, FITS, CSV or HDF5).
            The columns ``size``, ``exposure``, ``seed`` and ``date`` (MJD) may replace the arguments of the same name;
            an empty value stands for the argument. Other columns are ignored.
        size : float, optional
            Side of the images in arcsec.
        band : str, optional
            Name of the passband.
        processes : int, optional
            Number of processes, by default one per processor core that this process may use.
        **options : ImageOptions
            As for `render`; they are the same for all images.

        Returns
        -------
        iterator of SkyImage
            The images, in the order of the table. Only some of them are in memory at the same time. Call its method
            ``close`` to end the processes before the last image.

        Raises
        ------
        BadInput
            If the table or an option is not valid, or a place is outside the catalogue; this is raised before the first
            image. Later, if an image cannot be drawn. The message names the row.
        """
        from truesky.api import stamp_series

        count = (os.cpu_count() or 1) if processes is None else processes
        number = arguments.check_integer("processes", count, 1, _MAX_PROCESSES)
        requests = stamp_series.read_places(table, size, band, options)
        stamp_series.check_places(self._painter, requests)
        return stamp_series.draw_all(self._painter, requests, number)

    @arguments.refuse_missing("lake.frame(exposure, detector); lake.images() lists both")
    def frame(self, exposure: int, detector: str) -> LakeFrame:
        """Return the raw image of a detector in the lake, to which sources can be added.

        Parameters
        ----------
        exposure : int
            Number of an exposure of which the lake has an image.
        detector : str
            Name of the detector.

        Returns
        -------
        LakeFrame
            The image. Its method `with_sources` renders the detector again with additional sources.

        Raises
        ------
        BadInput
            If the lake has no image of this detector and exposure.
        """
        from truesky.api import lake_frames

        number = arguments.check_integer("exposure", exposure, 0, _MAX_INT64)
        return lake_frames.LakeFrame(self._explorer.root, self._explorer._version("products"), number, str(detector))

    def _image_file(self, path: str) -> Path:
        from truesky.render.products import read_back

        try:
            return read_back.image_file(self._explorer._version("products"), path)
        except BadInput as error:
            raise BadInput(f"{error}; Lake.images() lists the paths of the images") from None

    @arguments.refuse_missing("lake.light_curve(id, band, mjd)")
    def light_curve(self, id: int | Sequence[int], band: str, mjd: float | Sequence[float]) -> pd.DataFrame:
        """Compute the fluxes of sources at any dates: supernovae, stars, galaxies, quasars and lensed images.

        Parameters
        ----------
        id : int or sequence of int
            Identifiers of sources in the tables ``transients``, ``stars``, ``galaxies`` and ``lensed_images``, or
            ``point_id`` of the table ``active_nuclei`` for a nucleus without its galaxy. A source that does not vary
            has the same flux at all dates.
        band : str
            Name of a passband; for stars and galaxies, one in which the lake has fluxes.
        mjd : float or sequence of float
            Dates, MJD.

        Returns
        -------
        pandas.DataFrame
            One row per source and date, with the columns id, band, mjd, f_nu (microjansky) and mag (AB; infinite
            without light). Magnification and the Milky Way's dust are included.

        Raises
        ------
        BadInput
            If there is no such source, the passband is unknown, or a date is not a number.

        Examples
        --------
        >>> import numpy as np
        >>> lake = truesky.open("out/demo/lake")  # doctest: +SKIP
        >>> lake.light_curve(id, "lsst_r", np.arange(60900.0, 61000.0))  # doctest: +SKIP
        """
        from truesky.api import light_curves

        return light_curves.light_curves(self._explorer.root, self._explorer.versions, id, band, mjd)

    @cached_property
    def _painter(self) -> SkyPainter:
        from truesky.api import sky_images

        return sky_images.painter(sky_images.find_tables(self._explorer.versions, self._explorer.root))

    @arguments.refuse_missing("lake.truth(exposure_id, detector); lake.images() lists both")
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
            One row per source, from the table ``rendered_truth``: identifier, pixel position, electrons, magnitude and
            so on. There are no rows if no source was drawn.

        Raises
        ------
        BadInput
            If the lake has no image of this detector and exposure.
        """
        from truesky.api import lake_frames

        files = self.images(content=None)
        if not np.any((files["exposure_id"] == exposure_id) & (files["detector"] == detector)):
            rendered = zip(files["exposure_id"], files["detector"], strict=True)
            raise lake_frames.no_image(self._explorer.root, exposure_id, detector, rendered)
        query = "SELECT * FROM rendered_truth WHERE exposure_id = $exposure AND detector = $detector"
        return self.sql(query, exposure=int(exposure_id), detector=str(detector))
