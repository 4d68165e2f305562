"""Read the tables and images of a lake."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pandas as pd

from lake_schema.errors import BadInput
from lake_schema.fits.images import Image
from truesky.explore.explorer import Explorer
from truesky.explore.process import MEMORY, TIMEOUT


class Lake:
    """A lake, opened for reading.

    All methods see the tables as they were when the lake was opened, whatever is published later. Use a `with` block,
    or call `close`, to end the process that answers queries.

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

    def __init__(
        self, path: str | Path, request: str | None = None, memory: float = MEMORY, timeout: float = TIMEOUT
    ) -> None:
        self._explorer = Explorer(str(path) if isinstance(path, Path) else path, memory, timeout, request)

    def __repr__(self) -> str:
        return f"<Lake {self._explorer.root}: {', '.join(self.tables().index)}>"

    def __enter__(self) -> Lake:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the process that answers queries. A later query starts another."""
        self._explorer.close()

    # ------------------------------------------------------------------------------------------------ tables

    def tables(self) -> pd.DataFrame:
        """List the tables.

        Returns
        -------
        pandas.DataFrame
            One row per table, indexed by name: rows, MB, files, version and meaning.
        """
        return self._explorer.tables()

    def columns(self, table: str) -> pd.DataFrame:
        """List the columns of a table.

        Parameters
        ----------
        table : str
            Name of the table.

        Returns
        -------
        pandas.DataFrame
            One row per column, indexed by name: type, unit, range, whether it can be null, UCD and meaning.
        """
        return self._explorer.describe(table)

    def table(self, name: str, columns: str | Sequence[str] | None = None, into: str = "arrow") -> Any:
        """Read a table.

        Parameters
        ----------
        name : str
            Name of the table.
        columns : str or sequence of str, optional
            Names of the columns to read. The default is all columns.
        into : {"arrow", "pandas", "astropy"}, optional
            Kind of the result. An astropy table has units.

        Returns
        -------
        pyarrow.Table, pandas.DataFrame or astropy.table.Table
        """
        from truesky.explore import results

        return results.converted(self._explorer._version(name).rows(_names(columns)), into)

    def sql(self, query: str, /, into: str = "pandas", **parameters: object) -> Any:
        """Run one SELECT over the tables of the lake.

        Parameters
        ----------
        query : str
            SQL in the dialect of DuckDB. Two functions are added: ``separation(ra1, dec1, ra2, dec2)`` in degrees and
            ``mag_ab(f_nu)`` for flux densities in microjansky. ``$name`` stands for a parameter.
        into : {"pandas", "arrow", "astropy"}, optional
            Kind of the result.
        **parameters
            Values of the parameters: numbers, strings, booleans or lists of them.

        Returns
        -------
        pandas.DataFrame, pyarrow.Table or astropy.table.Table

        Raises
        ------
        BadInput
            If the query is not a single SELECT over tables of the lake, or exceeds the limits of time or memory.
        Damaged
            If a file that the query reads is not as it was written.
        """
        return self._explorer.sql(query, into, **parameters)

    def cone(
        self,
        table: str,
        ra: float,
        dec: float,
        radius: float,
        columns: str | Sequence[str] | None = None,
        on: str = "observed",
        into: str = "arrow",
    ) -> Any:
        """Read the rows of a catalogue within a circle on the sky.

        Parameters
        ----------
        table : str
            Name of a catalogue, such as ``galaxies``.
        ra, dec : float
            Centre of the circle, ICRS, in degrees.
        radius : float
            Radius of the circle in degrees.
        columns : str or sequence of str, optional
            Names of the columns to read. The default is all columns.
        on : {"observed", "true"}, optional
            Select by observed positions, or by the true ones without gravitational lensing.
        into : {"arrow", "pandas", "astropy"}, optional
            Kind of the result.

        Returns
        -------
        pyarrow.Table, pandas.DataFrame or astropy.table.Table
        """
        return self._explorer.cone(table, ra, dec, radius, _names(columns), on, into)

    # ------------------------------------------------------------------------------------------------ images

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
        found = version.rows().to_pandas()
        found["file"] = [f"products/v-{version.key}/{path}" for path in found["path"]]
        return found if content is None else found[found["content"] == content].reset_index(drop=True)

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

        file = self._explorer._version("products").file(path)
        return read_back.electrons(file) if electrons else read_back.frame(file)

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
        known = self.images(content=None)
        if not np.any((known["exposure_id"] == exposure_id) & (known["detector"] == detector)):
            raise BadInput(
                f"lake {self._explorer.root}: nothing was rendered for detector {detector} of exposure {exposure_id}"
            )
        query = "SELECT * FROM rendered_truth WHERE exposure_id = $exposure AND detector = $detector"
        return self.sql(query, exposure=int(exposure_id), detector=str(detector))


def _names(columns: str | Sequence[str] | None) -> Sequence[str] | None:
    return [columns] if isinstance(columns, str) else columns
