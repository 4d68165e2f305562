"""Explore the tables of a lake as they were when it was opened, whatever is published later."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lake_schema import arguments, sky, user_files
from lake_schema.arrays import Float, Int
from lake_schema.errors import BadInput, LakeError, VersionMismatch
from lake_schema.store import layout, read, request_links
from lake_schema.store.object_storage.s3 import Folder
from truesky.explore import results
from truesky.explore.process import MEMORY, TIMEOUT, TIMEOUT_HI, Process

Range = tuple[float, float]

# Default HEALPix order of sky maps.
ORDER = 8
_MAX_BINS = 10_000
# Status in the list of tables that cannot be read, by error; other errors mean "damaged".
_UNREADABLE: dict[type[LakeError], str] = {VersionMismatch: "unreadable version"}


class Explorer:
    """Tables of a lake, and a process that answers queries about them. It ends with `close` or a `with` block.

    Parameters
    ----------
    lake : str or Folder
        Folder of the lake.
    memory : float
        Memory limit of a query and its result together, bytes.
    timeout : float
        Time limit of a query, s.
    request : str, optional
        Name of the request whose tables are used. Without it, tables that all requests share have their plain names.
        Any table of a request is also available as "demo.products", in SQL too.

    Attributes
    ----------
    versions : dict of str to Version
        Tables that can be read, by name.
    damaged : dict of str to LakeError
        Tables that cannot be opened, and the reasons; the other tables remain usable.
    """

    def __init__(
        self, lake: str | Folder, memory: float = MEMORY, timeout: float = TIMEOUT, request: str | None = None
    ) -> None:
        self.root = layout.open_lake(lake)
        self.versions: dict[str, read.Version] = {}
        self.damaged: dict[str, LakeError] = {}
        self._ambiguous: dict[str, LakeError] = {}
        for table in (
            read.table_names(self.root) if request is None else request_links.tables_of_request(self.root, request)
        ):
            self._open(table, request, table)
        for request_name in (
            request_links.request_names(self.root)
            if request is None
            else [request_links.check_request(self.root, request)]
        ):
            for table in request_links.tables_of_request(self.root, request_name):
                self._open(f"{request_name}.{table}", request_name, table)
        if not self.versions and not self.damaged:
            raise BadInput(f"lake {self.root} holds no table")
        versions = [f"{name}={version.key}" for name, version in self.versions.items()]
        # The worker raises the error of these tables again if a query uses them.
        versions += [f"{name}=?{request or name.rpartition('.')[0]}" for name in (*self.damaged, *self._ambiguous)]
        self._table_arguments, self._memory = versions, memory
        self._process = self.process()
        self.timeout = arguments.check_number("timeout", timeout, 0.0, TIMEOUT_HI)

    def _open(self, name: str, request: str | None, table: str) -> None:
        try:
            self.versions[name] = read.version(self.root, table, request=request)
        except BadInput as error:
            self._ambiguous[name] = error
        except LakeError as error:
            self.damaged[name] = error

    def process(self, extra_tables: Sequence[str] = ()) -> Process:
        """Return a new process for the same versions, for use in parallel.

        `extra_tables` are entries NAME=@FILE of further tables in Arrow files.
        """
        return Process(self.root, [*self._table_arguments, *extra_tables], self._memory)

    def __enter__(self) -> Explorer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process; a later query starts it again."""
        self._process.close()

    # ------------------------------------------------------------------------------------------------ what there is

    def tables(self) -> pd.DataFrame:
        """Return a list of the tables: rows, megabytes, files, version and meaning."""
        rows = [
            {
                "table": name,
                "rows": version.num_rows,
                "MB": sum(entry["bytes"] for entry in version.manifest["files"]) / 1e6,
                "files": len(version.partitions),
                "version": version.key,
                "meaning": (version.schema.metadata or {}).get(b"description", b"").decode(),
            }
            for name, version in self.versions.items()
            if self.is_listed(name)
        ]
        rows += [
            {"table": name, "version": _UNREADABLE.get(type(error), "damaged"), "meaning": str(error)}
            for name, error in self.damaged.items()
            if self.is_listed(name)
        ]
        columns = ["table", "rows", "MB", "files", "version", "meaning"]
        frame = pd.DataFrame(rows, columns=columns).astype({"rows": "Int64", "files": "Int64"})
        return frame.set_index("table").sort_index()

    def is_listed(self, name: str) -> bool:
        """Return True if `tables` lists a table by this name.

        A table is listed by its plain name. If requests have different versions, it is also listed by the name with the
        request.
        """
        table = name.rpartition(".")[2]
        return name == table or table in self._ambiguous

    def describe(self, table: str) -> pd.DataFrame:
        """Return a list of the columns of a table: type, unit, range, UCD and meaning."""
        rows = []
        for field in self._version(table).schema:
            facts = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
            span = f"{facts.get('min', '')} .. {facts.get('max', '')}" if {"min", "max"} & facts.keys() else ""
            meaning = facts.get("description", "") + (f" ({facts['codes']})" if "codes" in facts else "")
            details = {"type": str(field.type), "unit": facts.get("unit", ""), "range": span, "null": field.nullable}
            rows.append({"column": field.name, **details, "ucd": facts.get("ucd", ""), "meaning": meaning})
        return pd.DataFrame(rows).set_index("column")

    def _version(self, table: str) -> read.Version:
        if error := self.damaged.get(table) or self._ambiguous.get(table):
            raise error
        if table not in self.versions:
            raise BadInput(f"lake {self.root} has no table {table}; it has {', '.join(self.versions)}")
        return self.versions[table]

    # ------------------------------------------------------------------------------------------------ rows

    def sql(self, text: str, /, into: str = "pandas", **parameters: object) -> Any:
        """Return the result of one SELECT over the tables of the lake.

        Parameters
        ----------
        text : str
            Query in DuckDB's SQL; $name is a parameter. Additional functions are separation(ra1, dec1, ra2, dec2) in
            deg and mag_ab(f_nu) for f_nu in microjansky.
        into : str
            "pandas", "astropy" (a Table with units) or "arrow".
        **parameters : object
            Numbers, texts, booleans or lists of them.

        Returns
        -------
        DataFrame or Table
            Rows of the result.

        Notes
        -----
        BadInput is raised if the text is not an allowed SELECT or exceeds the limits of time or memory. Damaged is
        raised if a file does not agree with its checksum.
        """
        return results.convert(self._process.ask(text, parameters, self.timeout), into)

    def cone(
        self, table: str, ra: float, dec: float, radius: float, columns: Sequence[str] | None = None,
        on: str = "observed", into: str = "pandas",
    ) -> Any:  # fmt: skip
        """Return the rows of a catalogue within a circle.

        Parameters
        ----------
        table : str
            Name of the table.
        ra, dec, radius : float
            Centre and radius of the circle, deg.
        columns : sequence of str, optional
            Columns to return; by default all.
        on : str
            "observed" or "true" positions.
        into : str
            "pandas", "astropy" or "arrow".

        Returns
        -------
        DataFrame or Table
            Rows inside the circle.
        """
        return results.convert(self._version(table).cone(ra, dec, radius, columns, on), into)

    def export(self, text: str, path: str | Path, /, **parameters: object) -> Path:
        """Write the result of a SELECT to a .csv, .parquet, .fits or .vot file, and return its path.

        Parameters
        ----------
        text : str
            Query as for `sql`.
        path : str or Path
            File to write.
        **parameters : object
            Numbers, texts, booleans or lists of them.

        Returns
        -------
        Path
            The file.
        """
        target = user_files.expand_path(path)
        results.write(self._process.ask(text, parameters, self.timeout), target)
        return target

    # ------------------------------------------------------------------------------------------------ distributions

    def hist(
        self,
        table: str,
        x: str,
        bins: int = 100,
        span: Range | None = None,
        where: str = "true",
        weight: str | None = None,
    ) -> tuple[Float, Float]:
        """Count the values of an expression in equal bins.

        Parameters
        ----------
        table : str
            Name of a table, or SQL after FROM such as "galaxies JOIN galaxy_fluxes USING (id)".
        x : str
            SQL expression.
        bins : int
            Number of bins.
        span : (float, float), optional
            Lowest and highest value; by default the range of the values.
        where : str
            SQL condition of the rows.
        weight : str, optional
            SQL expression to sum instead of counting rows.

        Returns
        -------
        counts : float array, shape (bins,)
            Number of rows or sum of weights in each bin.
        edges : float array, shape (bins + 1,)
            Edges of the bins.
        """
        bins = arguments.check_integer("bins", bins, 1, _MAX_BINS)
        lo, hi = self._span(table, x, where) if span is None else _check_span(span)
        text = f"""
            SELECT {_bin_sql("x")} AS i, {_count_sql(weight)} AS n
            FROM (SELECT ({x}\n)::DOUBLE AS x, {_weight_sql(weight)} FROM {table}
            WHERE ({where}\n)) WHERE x BETWEEN $x_lo AND $x_hi GROUP BY i"""
        rows = self.sql(text, into="arrow", x_lo=lo, x_hi=hi, x_bins=bins)
        counts = np.zeros(bins)
        counts[rows["i"].to_numpy()] = rows["n"].to_numpy()
        return counts, np.linspace(lo, hi, bins + 1)

    def heatmap(
        self, table: str, x: str, y: str, bins: tuple[int, int] = (100, 100),
        span: tuple[Range, Range] | None = None, where: str = "true", weight: str | None = None,
    ) -> tuple[Float, Float, Float]:  # fmt: skip
        """Count the values of two expressions in a grid of equal bins.

        Parameters
        ----------
        table : str
            Name of a table, or SQL after FROM.
        x, y : str
            SQL expressions.
        bins : (int, int)
            Number of bins in x and y.
        span : ((float, float), (float, float)), optional
            Lowest and highest value of x and y; by default the range of the values.
        where : str
            SQL condition of the rows.
        weight : str, optional
            SQL expression to sum instead of counting rows.

        Returns
        -------
        counts : float array, shape (y bins, x bins)
            Number of rows or sum of weights in each bin.
        x_edges, y_edges : float array, shape (x bins + 1,) and (y bins + 1,)
            Edges of the bins.
        """
        x_bins, y_bins = (arguments.check_integer("bins", axis, 1, _MAX_BINS) for axis in _pair("bins", bins))
        if span is None:
            spans = [self._span(table, axis, where) for axis in (x, y)]
        else:
            spans = [_check_span(axis) for axis in _pair("span", span)]
        (x_lo, x_hi), (y_lo, y_hi) = spans
        text = f"""
            SELECT {_bin_sql("x")} AS i, {_bin_sql("y")} AS j, {_count_sql(weight)} AS n
            FROM (SELECT ({x}\n)::DOUBLE AS x, ({y}\n)::DOUBLE AS y, {_weight_sql(weight)} FROM {table}
            WHERE ({where}\n)) WHERE x BETWEEN $x_lo AND $x_hi AND y BETWEEN $y_lo AND $y_hi GROUP BY i, j"""
        limits = {"x_lo": x_lo, "x_hi": x_hi, "x_bins": x_bins, "y_lo": y_lo, "y_hi": y_hi, "y_bins": y_bins}
        rows = self.sql(text, into="arrow", **limits)
        counts = np.zeros((y_bins, x_bins))
        counts[rows["j"].to_numpy(), rows["i"].to_numpy()] = rows["n"].to_numpy()
        return counts, np.linspace(x_lo, x_hi, x_bins + 1), np.linspace(y_lo, y_hi, y_bins + 1)

    def skymap(
        self, table: str, order: int = ORDER, where: str = "true", weight: str | None = None
    ) -> tuple[Int, Float]:
        """Count rows in nested HEALPix cells.

        Parameters
        ----------
        table : str
            Name of a table, or SQL after FROM.
        order : int
            HEALPix order of the cells.
        where : str
            SQL condition of the rows.
        weight : str, optional
            SQL expression to sum instead of counting rows.

        Returns
        -------
        cells : int array, shape (n,)
            Cells with rows, ascending.
        counts : float array, shape (n,)
            Number of rows or sum of weights in each cell.
        """
        order = arguments.check_integer("order", order, 0, sky.MAX_ORDER)
        text = f"""
            SELECT cell, {_count_sql(weight)} AS n
            FROM (SELECT _healpix_29 >> $shift::INT AS cell, {_weight_sql(weight)} FROM {table}
            WHERE ({where}\n)) GROUP BY cell ORDER BY cell"""
        rows = self.sql(text, into="arrow", shift=2 * (sky.MAX_ORDER - order))
        return rows["cell"].to_numpy(), rows["n"].to_numpy().astype(float)

    def _span(self, table: str, x: str, where: str) -> Range:
        rows = f"SELECT ({x}\n) AS x FROM {table}\nWHERE ({where}\n)"
        text = f"SELECT min(x)::DOUBLE AS lo, max(x)::DOUBLE AS hi FROM ({rows})"
        extremes = self.sql(text, into="arrow")
        lo, hi = extremes["lo"][0].as_py(), extremes["hi"][0].as_py()
        if lo is None or not np.isfinite([lo, hi]).all():
            raise BadInput(f"table {table}: {x} has no finite values here")
        return (lo, hi) if hi > lo else (lo - 0.5, hi + 0.5)


def _pair(name: str, value: Any) -> tuple[Any, Any]:
    try:
        first, second = value
    except (TypeError, ValueError):
        raise BadInput(f"{name} = {value!r} is not a pair") from None
    return first, second


def _check_span(span: Range) -> Range:
    lo, hi = (arguments.check_number("span", edge) for edge in _pair("span", span))
    if not (np.isfinite([lo, hi]).all() and lo < hi):
        raise BadInput(f"span must be from a finite number to a larger one, got {span}")
    return lo, hi


def _bin_sql(axis: str) -> str:
    """SQL for the number of the bin of column `x` or `y`; the last bin includes its upper edge."""
    return f"least(floor(({axis} - ${axis}_lo) / (${axis}_hi - ${axis}_lo) * ${axis}_bins), ${axis}_bins - 1)::INT"


def _weight_sql(weight: str | None) -> str:
    return "1 AS w" if weight is None else f"({weight}\n)::DOUBLE AS w"


def _count_sql(weight: str | None) -> str:
    # The sum is NULL if no row has a weight; rows without a weight add nothing.
    return "count(*)" if weight is None else "coalesce(sum(w), 0)"
