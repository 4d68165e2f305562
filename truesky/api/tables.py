"""Read the tables of a lake (the folder with all results of simulations): rows, SQL, histograms and maps."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from lake_schema import arguments, user_files
from lake_schema.arrays import Float, Int
from lake_schema.errors import BadInput, PartOfLake
from truesky.explore.explorer import ORDER, Explorer
from truesky.explore.process import MEMORY, TIMEOUT

if TYPE_CHECKING:
    # Needed for annotations only.
    import pandas as pd


class LakeTables:
    """Tables of a lake that is opened for reading: base class of `truesky.Lake`, which also reads images.

    Parameters
    ----------
    path : str or Path
        Folder of the lake, or its address on object storage, ``s3://BUCKET/PREFIX``.
    request : str, optional
        Name of a request (one of the simulations in the lake), to which the lake is then restricted.
    memory : float, optional
        Memory limit of a query and its result together, 1e7 to 1e15 bytes.
    timeout : float, optional
        Time in seconds after which a query is stopped, 0 to 1e6.
    """

    @arguments.refuse_missing('truesky.open("my_lake")')
    def __init__(
        self, path: str | Path, request: str | None = None, memory: float = MEMORY, timeout: float = TIMEOUT
    ) -> None:
        if str(path).endswith(".toml") and not os.path.isdir(path):
            name = user_files.format_path(path)
            raise BadInput(f'{name} is a request, not a lake: truesky.run("{name}", "my_lake") makes a lake from it')
        try:
            self._explorer = Explorer(str(path) if isinstance(path, Path) else path, memory, timeout, request)
        except PartOfLake as error:
            raise error.with_option('request="{}"') from None

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self._explorer.root}: {', '.join(self.tables().index)}>"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the process that answers queries; a later query starts a new one."""
        self._explorer.close()

    def tables(self) -> pd.DataFrame:
        """List the tables of the lake.

        Returns
        -------
        pandas.DataFrame
            One row per table, indexed by name. The columns are `rows`, `MB` (10^6 bytes), `files` (number of files),
            `version` (key of the version: a hash that identifies it) and `meaning`. If a table cannot be opened,
            `version` is "damaged" or "unreadable version", `meaning` is the error, and the numbers are missing.
        """
        return self._explorer.tables()

    @arguments.refuse_missing('lake.columns("galaxies"); lake.tables() lists the tables')
    def columns(self, table: str) -> pd.DataFrame:
        """List the columns of a table.

        Parameters
        ----------
        table : str
            Name of the table.

        Returns
        -------
        pandas.DataFrame
            One row per column of the table, indexed by name: `type`, `unit`, `range` (allowed values), `null` (True if
            values may be missing), `ucd` and `meaning`.

        Notes
        -----
        BadInput is raised if the lake has no such table.
        """
        return self._explorer.describe(table)

    @arguments.refuse_missing('lake.table("galaxies"); lake.tables() lists the tables')
    def table(self, name: str, columns: str | Sequence[str] | None = None, into: str = "pandas") -> Any:
        """Read all rows of a table into memory.

        Parameters
        ----------
        name : str
            Name of the table.
        columns : str or sequence of str, optional
            Names of the columns to read. The default is all columns.
        into : {"pandas", "arrow", "astropy"}, optional
            Type of the result. An astropy table has units.

        Returns
        -------
        pandas.DataFrame, pyarrow.Table or astropy.table.Table
            All rows of the table.

        Notes
        -----
        BadInput is raised if the lake has no such table or column, or if `into` is another text.
        """
        from truesky.explore import results

        names = _names(columns)
        self._explorer.check_columns(name, names or ())
        return results.convert(self._explorer._version(name).rows(names), into)

    @arguments.refuse_missing('lake.sql("SELECT count(*) FROM galaxies")')
    def sql(self, query: str, /, into: str = "pandas", **parameters: object) -> Any:
        """Run one SELECT over the tables of the lake.

        Parameters
        ----------
        query : str
            SQL in the dialect of DuckDB. Two functions are added: ``separation(ra1, dec1, ra2, dec2)`` is the angle
            between two positions in degrees, and ``mag_ab(f_nu)`` is the AB magnitude of a flux density in microjansky.
            ``$name`` stands for a parameter.
        into : {"pandas", "arrow", "astropy"}, optional
            Type of the result. An astropy table has units.
        **parameters
            Values of the parameters by name: numbers, strings, booleans, or lists, tuples and arrays of them.

        Returns
        -------
        pandas.DataFrame, pyarrow.Table or astropy.table.Table
            Rows of the result.

        Raises
        ------
        BadInput
            If the query is not a single SELECT over tables of the lake, exceeds the limits of time or memory, or `into`
            is another text.
        Damaged
            If the content of a file that the query reads has changed since it was written.
        """
        return self._explorer.sql(query, into, **parameters)

    @arguments.refuse_missing("lake.cone(table, ra, dec, radius), all angles in degrees")
    def cone(
        self,
        table: str,
        ra: float,
        dec: float,
        radius: float,
        columns: str | Sequence[str] | None = None,
        on: str = "observed",
        into: str = "pandas",
    ) -> Any:
        """Read the rows of a catalogue within a circle on the sky, including its edge.

        Parameters
        ----------
        table : str
            Name of a catalogue, such as ``galaxies``.
        ra, dec : float
            Centre of the circle, ICRS, in degrees.
        radius : float
            Radius of the circle in degrees, from 0 to 180.
        columns : str or sequence of str, optional
            Names of the columns to read. The default is all columns.
        on : {"observed", "true"}, optional
            Positions that are compared with the circle: observed ones, or true ones without gravitational lensing.
        into : {"pandas", "arrow", "astropy"}, optional
            Type of the result. An astropy table has units.

        Returns
        -------
        pandas.DataFrame, pyarrow.Table or astropy.table.Table
            Rows inside the circle; there are none if it is empty.

        Notes
        -----
        BadInput is raised if the table or a column does not exist, or an argument is outside its bounds.
        """
        return self._explorer.cone(table, ra, dec, radius, _names(columns), on, into)

    @arguments.refuse_missing('lake.export("SELECT id FROM galaxies", "galaxies.csv")')
    def export(self, query: str, path: str | Path, /, **parameters: object) -> Path:
        """Write the result of an SQL query to a file.

        Parameters
        ----------
        query : str
            One SELECT over tables of the lake, as for the method `sql`.
        path : str or Path
            File to write; ``~`` is the home folder. Its ending selects the format: ``.csv``, ``.parquet``, ``.fits``
            or ``.vot``. Units and UCDs are written if the format supports them. An existing file is replaced.
        **parameters
            Values of the parameters of the query by name.

        Returns
        -------
        Path
            Path of the file.

        Notes
        -----
        BadInput is raised if the query fails, the path has another ending, or the format cannot hold the result.
        """
        return self._explorer.export(query, path, **parameters)

    @arguments.refuse_missing('lake.hist("galaxies", "z_obs"), with a table and an SQL expression')
    def hist(
        self,
        table: str,
        x: str,
        bins: int = 100,
        span: tuple[float, float] | None = None,
        where: str = "true",
        weight: str | None = None,
    ) -> tuple[Float, Float]:
        """Return a histogram of an SQL expression, without reading the rows into this process.

        Parameters
        ----------
        table : str
            Name of a table, or the text of a FROM clause, such as ``galaxies JOIN galaxy_fluxes USING (id)``.
        x : str
            SQL expression of the table's columns. Rows for which it is NULL or outside `span` are not counted.
        bins : int, optional
            Number of bins of equal width, 1 to 10,000.
        span : tuple of float, optional
            Lower edge of the first bin and upper edge of the last bin, both included. The default is the smallest and
            the largest value, or 0.5 below and above them if they are equal.
        where : str, optional
            SQL condition that selects rows. The default is all rows.
        weight : str, optional
            SQL expression that is summed in each bin; rows for which it is NULL add 0. By default rows are counted.

        Returns
        -------
        counts : ndarray of float64, shape (bins,)
            Number of rows, or sum of weights, in each bin.
        edges : ndarray of float64, shape (bins + 1,)
            Edges of the bins, ascending. ``truesky.plots.hist(counts, edges)`` draws the result.

        Notes
        -----
        BadInput is raised if an argument is not allowed, or if `span` is missing and an expression has no values or not
        only finite ones.
        """
        return self._explorer.hist(table, x, bins, span, where, weight)

    @arguments.refuse_missing('lake.heatmap("galaxies", "ra", "dec"), with a table and two SQL expressions')
    def heatmap(
        self,
        table: str,
        x: str,
        y: str,
        bins: tuple[int, int] = (100, 100),
        span: tuple[tuple[float, float], tuple[float, float]] | None = None,
        where: str = "true",
        weight: str | None = None,
    ) -> tuple[Float, Float, Float]:
        """Return a two-dimensional histogram of two SQL expressions, without reading the rows into this process.

        Parameters
        ----------
        table : str
            Name of a table, or the text of a FROM clause, such as ``galaxies JOIN galaxy_fluxes USING (id)``.
        x, y : str
            SQL expressions of the table's columns. Rows for which one is NULL or outside its range are not counted.
        bins : tuple of int, optional
            Numbers of bins of equal width in x and in y, 1 to 10,000 each.
        span : tuple of tuple of float, optional
            Range of x and range of y, each (lowest, highest), both included. The default is the smallest and the
            largest value of each expression, or 0.5 below and above them if they are equal.
        where : str, optional
            SQL condition that selects rows. The default is all rows.
        weight : str, optional
            SQL expression that is summed in each bin; rows for which it is NULL add 0. By default rows are counted.

        Returns
        -------
        counts : ndarray of float64, shape (y bins, x bins)
            Number of rows, or sum of weights, in each bin.
        x_edges : ndarray of float64, shape (x bins + 1,)
            Edges of the bins in x, ascending.
        y_edges : ndarray of float64, shape (y bins + 1,)
            Edges of the bins in y, ascending. ``truesky.plots.heatmap(counts, x_edges, y_edges)`` draws the result.

        Notes
        -----
        BadInput is raised if an argument is not allowed, or if `span` is missing and an expression has no values or not
        only finite ones.
        """
        return self._explorer.heatmap(table, x, y, bins, span, where, weight)

    @arguments.refuse_missing('lake.skymap("galaxies")')
    def skymap(
        self, table: str, order: int = ORDER, where: str = "true", weight: str | None = None
    ) -> tuple[Int, Float]:
        """Count the rows of a catalogue in HEALPix cells of the sky.

        Parameters
        ----------
        table : str
            Name of a catalogue, or the text of a FROM clause with the column ``_healpix_29``.
        order : int, optional
            HEALPix order of the cells, 0 to 29; nside is 2**order.
        where : str, optional
            SQL condition that selects rows. The default is all rows.
        weight : str, optional
            SQL expression that is summed in each cell; rows for which it is NULL add 0. By default rows are counted.

        Returns
        -------
        cells : ndarray of int64, shape (n,)
            Nested indices of the cells that contain rows, ascending.
        counts : ndarray of float64, shape (n,)
            Number of rows, or sum of weights, in each cell. ``truesky.plots.skymap(cells, counts, order)`` draws the
            result.

        Notes
        -----
        BadInput is raised if an argument is not allowed, or the table has no positions.
        """
        return self._explorer.skymap(table, order, where, weight)


def _names(columns: str | Sequence[str] | None) -> Sequence[str] | None:
    return None if columns is None else arguments.check_names("columns", columns)
