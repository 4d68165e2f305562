"""Read the tables of a lake."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pandas as pd

from lake_schema import arguments
from lake_schema.arrays import Float, Int
from truesky.explore.explorer import ORDER, Explorer
from truesky.explore.process import MEMORY, TIMEOUT


class LakeTables:
    """Tables of a lake that is opened for reading: queries, rows, counts and files. See `truesky.open`."""

    def __init__(
        self, path: str | Path, request: str | None = None, memory: float = MEMORY, timeout: float = TIMEOUT
    ) -> None:
        self._explorer = Explorer(str(path) if isinstance(path, Path) else path, memory, timeout, request)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self._explorer.root}: {', '.join(self.tables().index)}>"

    def __enter__(self) -> Self:
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

    def table(self, name: str, columns: str | Sequence[str] | None = None, into: str = "pandas") -> Any:
        """Read a table.

        Parameters
        ----------
        name : str
            Name of the table.
        columns : str or sequence of str, optional
            Names of the columns to read. The default is all columns.
        into : {"pandas", "arrow", "astropy"}, optional
            Kind of the result. An astropy table has units.

        Returns
        -------
        pandas.DataFrame, pyarrow.Table or astropy.table.Table
        """
        from truesky.explore import results

        return results.convert(self._explorer._version(name).rows(_names(columns)), into)

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
            Values of the parameters: numbers, strings, booleans, or lists, tuples and arrays of them.

        Returns
        -------
        pandas.DataFrame, pyarrow.Table or astropy.table.Table

        Raises
        ------
        BadInput
            If the query is not a single SELECT over tables of the lake, or exceeds the limits of time or memory.
        Damaged
            If the content of a file that the query reads has changed since it was written.
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
        into: str = "pandas",
    ) -> Any:
        """Read the rows of a catalogue within a circle on the sky.

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
            Select by observed positions, or by the true ones without gravitational lensing.
        into : {"pandas", "arrow", "astropy"}, optional
            Kind of the result.

        Returns
        -------
        pandas.DataFrame, pyarrow.Table or astropy.table.Table
        """
        return self._explorer.cone(table, ra, dec, radius, _names(columns), on, into)

    def export(self, query: str, path: str | Path, /, **parameters: object) -> Path:
        """Write the result of a query to a file.

        Parameters
        ----------
        query : str
            One SELECT, as for `sql`.
        path : str or Path
            File to write; ``~`` is the home folder. Its ending selects the format: ``.csv``, ``.parquet``, ``.fits``
            or ``.vot``. Units and UCDs are written if the format supports them.
        **parameters
            Values of the parameters of the query.

        Returns
        -------
        Path
            The file.
        """
        return self._explorer.export(query, path, **parameters)

    # ------------------------------------------------------------------------------------------------ distributions

    def hist(
        self,
        table: str,
        x: str,
        bins: int = 100,
        span: tuple[float, float] | None = None,
        where: str = "true",
        weight: str | None = None,
    ) -> tuple[Float, Float]:
        """Count rows in equal bins of an expression, without reading the rows into this process.

        Parameters
        ----------
        table : str
            Name of a table, or the text of a FROM clause, such as ``galaxies JOIN galaxy_fluxes USING (id)``.
        x : str
            SQL expression of the table's columns.
        bins : int, optional
            Number of bins.
        span : tuple of float, optional
            Lower edge of the first bin and upper edge of the last. The default is the range of the values.
        where : str, optional
            SQL condition that selects rows.
        weight : str, optional
            SQL expression that is summed instead of 1. Rows without a value count as 0.

        Returns
        -------
        counts : ndarray of float64, shape (bins,)
        edges : ndarray of float64, shape (bins + 1,)
            Arguments for ``truesky.plots.hist``.
        """
        return self._explorer.hist(table, x, bins, span, where, weight)

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
        """Count rows in a grid of equal bins of two expressions.

        Parameters
        ----------
        table : str
            Name of a table, or the text of a FROM clause.
        x, y : str
            SQL expressions of the table's columns.
        bins : tuple of int, optional
            Numbers of bins of x and y.
        span : tuple of tuple of float, optional
            Ranges of x and y. The default is the ranges of the values.
        where : str, optional
            SQL condition that selects rows.
        weight : str, optional
            SQL expression that is summed instead of 1. Rows without a value count as 0.

        Returns
        -------
        counts : ndarray of float64, shape (y bins, x bins)
        x_edges : ndarray of float64, shape (x bins + 1,)
        y_edges : ndarray of float64, shape (y bins + 1,)
            Arguments for ``truesky.plots.heatmap``.
        """
        return self._explorer.heatmap(table, x, y, bins, span, where, weight)

    def skymap(
        self, table: str, order: int = ORDER, where: str = "true", weight: str | None = None
    ) -> tuple[Int, Float]:
        """Count the rows of a catalogue in nested HEALPix cells.

        Parameters
        ----------
        table : str
            Name of a catalogue.
        order : int, optional
            Order of the cells; nside is 2**order.
        where : str, optional
            SQL condition that selects rows.
        weight : str, optional
            SQL expression that is summed instead of 1. Rows without a value count as 0.

        Returns
        -------
        cells : ndarray of int64, shape (n,)
            Cells that contain rows, ascending.
        counts : ndarray of float64, shape (n,)
            Arguments for ``truesky.plots.skymap``, together with the order if it is not 8.
        """
        return self._explorer.skymap(table, order, where, weight)


def _names(columns: str | Sequence[str] | None) -> Sequence[str] | None:
    return None if columns is None else arguments.check_names("columns", columns)
