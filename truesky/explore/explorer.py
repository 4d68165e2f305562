"""Query the tables of a lake (the folder with all tables of the simulator): SQL, circles, histograms and sky maps.

The versions of the tables are fixed when the lake is opened. New versions that are published later are not used.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lake_schema import arguments, sky, user_files
from lake_schema.arrays import Float, Int
from lake_schema.errors import BadInput, LakeError, VersionMismatch
from lake_schema.store import layout, read, request_links
from lake_schema.store.object_storage.s3 import Folder
from lake_schema.texts import spelling
from truesky.explore import results, shared_columns, suggestions
from truesky.explore.process import MEMORY, TIMEOUT, TIMEOUT_HI, Process

if TYPE_CHECKING:
    import pandas as pd

Range = tuple[float, float]

# Default HEALPix order of sky maps.
ORDER = 8
# Largest number of bins of an axis.
_MAX_BINS = 10_000
# Status of a table that cannot be opened, by type of the error. For all other errors the status is "damaged".
_UNREADABLE: dict[type[LakeError], str] = {VersionMismatch: "unreadable version"}


class Explorer:
    """Tables of a lake, with methods for queries, histograms and maps.

    Queries run in a separate process, which `close` or the end of a `with` block ends. BadInput is raised if the lake
    has no tables, the request does not exist, or a limit is out of range.

    Parameters
    ----------
    lake : str or Folder
        Folder of the lake, or s3://BUCKET/PREFIX.
    memory : float, optional
        Memory limit of a query and its result together, 1e7 to 1e15 bytes.
    timeout : float, optional
        Time limit of a query, 0 to 1e6 s.
    request : str, optional
        Name of the request whose tables have plain names such as "products". Without it, a table has its plain name
        only if all requests of the lake share the same version of it. Any table of a request is also available as
        "demo.products" (request, dot, table), in SQL too.

    Attributes
    ----------
    versions : dict of str to Version
        Versions of the tables that can be read, by name of the table.
    damaged : dict of str to LakeError
        Errors of the tables that cannot be opened, by name. All other tables can be used.
    """

    def __init__(
        self, lake: str | Folder, memory: float = MEMORY, timeout: float = TIMEOUT, request: str | None = None
    ) -> None:
        self.root = layout.open_lake(lake)
        self.versions: dict[str, read.Version] = {}
        self.damaged: dict[str, LakeError] = {}
        self._ambiguous: dict[str, LakeError] = {}
        requests = request_links.request_names(self.root)
        if request is not None:
            requests = [request_links.check_request(self.root, request)]
        for table in (
            read.table_names(self.root) if request is None else request_links.tables_of_request(self.root, request)
        ):
            self._open(table, request, table)
        for request_name in requests:
            for table in request_links.tables_of_request(self.root, request_name):
                self._open(f"{request_name}.{table}", request_name, table)
        if not self.versions and not self.damaged:
            raise layout.missing_table(self.root)
        versions = [f"{name}={version.key}" for name, version in self.versions.items()]
        # Tables that could not be opened are also declared to the process that runs queries, so that a query that uses
        # one of them raises the reason.
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
        """Return a new query process for the same versions of the tables, so that queries can run in parallel.

        Parameters
        ----------
        extra_tables : sequence of str, optional
            Further tables, each a text NAME=@FILE, where FILE is the path of an Arrow file.

        Returns
        -------
        Process
            The process, which the caller must close.
        """
        return Process(self.root, [*self._table_arguments, *extra_tables], self._memory)

    def __enter__(self) -> Explorer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process that runs queries; a later query starts a new one."""
        self._process.close()

    def tables(self) -> pd.DataFrame:
        """Return a list of the tables as a DataFrame, indexed by name.

        Returns
        -------
        DataFrame
            Columns `rows`, `MB` (10^6 bytes), `files` (number of files), `version` (key of the version: a hash that
            identifies it) and `meaning`. If a table cannot be opened, `version` is "damaged" or "unreadable version",
            `meaning` is the error, and the numbers are missing.
        """
        import pandas as pd

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
        """Return True if the method `tables` lists a table under this name.

        A table is listed by its plain name, such as "products". If requests have different versions of it, each version
        is listed with the name of its request, such as "demo.products".

        Parameters
        ----------
        name : str
            Name with or without a request.

        Returns
        -------
        bool
            True if the name has the form under which the table is listed.
        """
        table = name.rpartition(".")[2]
        return name == table or table in self._ambiguous

    def describe(self, table: str) -> pd.DataFrame:
        """Return a list of the columns of a table as a DataFrame, indexed by name of the column.

        Parameters
        ----------
        table : str
            Name of the table.

        Returns
        -------
        DataFrame
            Columns `type`, `unit`, `range` (allowed values), `null` (True if values may be missing), `ucd` and
            `meaning`.

        Raises
        ------
        BadInput
            If the lake has no such table.
        LakeError
            If the table cannot be opened.
        """
        import pandas as pd

        rows = []
        for field in self._version(table).schema:
            facts = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
            span = f"{facts.get('min', '')} .. {facts.get('max', '')}" if {"min", "max"} & facts.keys() else ""
            meaning = facts.get("description", "") + (f" ({facts['codes']})" if "codes" in facts else "")
            details = {"type": str(field.type), "unit": facts.get("unit", ""), "range": span, "null": field.nullable}
            rows.append({"column": field.name, **details, "ucd": facts.get("ucd", ""), "meaning": meaning})
        return pd.DataFrame(rows).set_index("column")

    def _version(self, table: str) -> read.Version:
        if not isinstance(table, str):
            raise BadInput(f"the table must be a name such as {min(self.versions)!r}, got {table!r}")
        if error := self.damaged.get(table) or self._ambiguous.get(table):
            raise error
        if table not in self.versions:
            raise layout.missing_table(self.root, table, list(self.versions))
        return self.versions[table]

    def check_columns(self, table: str, columns: Sequence[str]) -> None:
        """Check that a table has columns.

        Parameters
        ----------
        table : str
            Name of the table.
        columns : sequence of str
            Names of the columns.

        Raises
        ------
        BadInput
            If it lacks one of them. The message has the same suggestions as in SQL.
        """
        existing = self._version(table).schema.names
        if missing := [name for name in dict.fromkeys(columns) if name not in existing]:
            request, unrelated = table.rpartition(".")[0], shared_columns.unrelated_fluxes([table])
            other_tables = {
                name: version.schema.names
                for name, version in self.versions.items()
                if name != table and name.rpartition(".")[0] == request and name.rpartition(".")[2] not in unrelated
            }
            raise BadInput(explain_columns(missing, table, existing, other_tables))

    def sql(self, text: str, /, into: str = "pandas", **parameters: object) -> Any:
        """Return the result of one SELECT over the tables of the lake.

        Parameters
        ----------
        text : str
            Query in DuckDB's SQL; $name is a parameter. Three functions are added: separation(ra1, dec1, ra2, dec2) is
            the angle between two positions in deg, mag_ab(f_nu) is the AB magnitude of a flux in microjansky, and
            in_area(ra, dec) is true in the area of the request.
        into : str, optional
            Type of the result: "pandas", "astropy" (a Table with units) or "arrow".
        **parameters : object
            Values of the parameters: numbers, texts, booleans or lists of them.

        Returns
        -------
        DataFrame, astropy Table or pyarrow.Table
            Rows of the result.

        Notes
        -----
        BadInput is raised if the text is not a single SELECT over tables of the lake, if it exceeds the limits of time
        or memory, or if `into` is another text. Damaged is raised if a file does not agree with its checksum.
        """
        return results.convert(self._process.ask(text, parameters, self.timeout), into)

    def cone(
        self, table: str, ra: float, dec: float, radius: float, columns: Sequence[str] | None = None,
        on: str = "observed", into: str = "pandas",
    ) -> Any:  # fmt: skip
        """Return the rows of a catalogue within a circle on the sky, including its edge.

        Parameters
        ----------
        table : str
            Name of the table.
        ra, dec, radius : float
            Centre (ICRS) and radius of the circle, deg; the radius is 0 to 180.
        columns : sequence of str, optional
            Names of the columns to return; by default all.
        on : str, optional
            Positions that are compared with the circle: "observed" (with gravitational lensing) or "true" (without).
        into : str, optional
            Type of the result: "pandas", "astropy" (a Table with units) or "arrow".

        Returns
        -------
        DataFrame, astropy Table or pyarrow.Table
            Rows inside the circle; none if the circle is empty.

        Notes
        -----
        BadInput is raised if the table or a column does not exist, or an argument is outside its bounds.
        """
        self.check_columns(table, columns or ())
        return results.convert(self._version(table).cone(ra, dec, radius, columns, on), into)

    def export(self, text: str, path: str | Path, /, **parameters: object) -> Path:
        """Write the result of a SELECT to a .csv, .parquet, .fits or .vot file, and return its path.

        Parameters
        ----------
        text : str
            Query in DuckDB's SQL, as for the method `sql`.
        path : str or Path
            File to write; an existing file is replaced. The type of the file follows from its ending.
        **parameters : object
            Values of the parameters of the query: numbers, texts, booleans or lists of them.

        Returns
        -------
        Path
            Path of the file.

        Raises
        ------
        BadInput
            As by `sql`, if the path has another ending, or if the file type cannot hold the result.
        """
        if Path(text.strip()).suffix.lower() in results.ENDINGS and " " not in text.strip():
            raise BadInput(f"the query comes before the file: write lake.export(query, {text.strip()!r})")
        target = user_files.expand_path(path)
        results.write(self._process.ask(text, parameters, self.timeout), target)
        return target

    def hist(
        self,
        table: str,
        x: str,
        bins: int = 100,
        span: Range | None = None,
        where: str = "true",
        weight: str | None = None,
    ) -> tuple[Float, Float]:
        """Return a histogram of an SQL expression with bins of equal width.

        Parameters
        ----------
        table : str
            Name of a table, or other SQL after FROM such as "galaxies JOIN galaxy_fluxes USING (id)".
        x : str
            SQL expression whose values are counted; NULL and values outside `span` are ignored.
        bins : int, optional
            Number of bins, 1 to 10,000.
        span : (float, float), optional
            Lower edge of the first bin and upper edge of the last bin, both included. By default the smallest and the
            largest value, or 0.5 below and above them if they are equal.
        where : str, optional
            SQL condition that selects rows; by default all rows.
        weight : str, optional
            SQL expression that is summed in each bin; by default rows are counted.

        Returns
        -------
        counts : float array, shape (bins,)
            Number of rows or sum of weights in each bin.
        edges : float array, shape (bins + 1,)
            Edges of the bins, ascending.

        Notes
        -----
        BadInput is raised if an argument is not allowed, or if `span` is missing and an expression has no values or not
        only finite ones.
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
        """Return a two-dimensional histogram of two SQL expressions with bins of equal width.

        Parameters
        ----------
        table : str
            Name of a table, or other SQL after FROM such as a join.
        x, y : str
            SQL expressions whose values are counted; rows with NULL or a value outside `span` are ignored.
        bins : (int, int), optional
            Number of bins in x and in y, 1 to 10,000 each.
        span : ((float, float), (float, float)), optional
            Lowest and highest edge of the bins in x, and in y, both included. By default the smallest and the largest
            value of each expression, or 0.5 below and above them if they are equal.
        where : str, optional
            SQL condition that selects rows; by default all rows.
        weight : str, optional
            SQL expression that is summed in each bin; by default rows are counted.

        Returns
        -------
        counts : float array, shape (y bins, x bins)
            Number of rows or sum of weights in each bin.
        x_edges, y_edges : float array, shape (x bins + 1,) and (y bins + 1,)
            Edges of the bins, ascending.

        Notes
        -----
        BadInput is raised if an argument is not allowed, or if `span` is missing and an expression has no values or not
        only finite ones.
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
        """Count the rows of a table in HEALPix cells of the sky.

        Parameters
        ----------
        table : str
            Name of a table with the column `_healpix_29`, or other SQL after FROM.
        order : int, optional
            HEALPix order of the cells, 0 to 29.
        where : str, optional
            SQL condition that selects rows; by default all rows.
        weight : str, optional
            SQL expression that is summed in each cell; by default rows are counted.

        Returns
        -------
        cells : int array, shape (n,)
            Nested indices of the cells that contain rows, ascending.
        counts : float array, shape (n,)
            Number of rows or sum of weights in each cell.

        Notes
        -----
        BadInput is raised if an argument is not allowed, or the rows have no column `_healpix_29`.
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
        # Near large numbers, a float cannot represent half a unit.
        half = max(0.5, 2.0 * float(np.spacing(abs(lo))))
        return (lo, hi) if hi > lo else (lo - half, hi + half)


def explain_columns(
    names: Sequence[str], table: str, columns: Collection[str], other_tables: Mapping[str, Collection[str]]
) -> str:
    """Return a message about names in an argument that are not columns of a table, as for a query.

    Parameters
    ----------
    names : sequence of str
        The names, as the user wrote them.
    table : str
        Name of the table.
    columns : collection of str
        Columns of the table.
    other_tables : mapping of str to collection of str
        Columns of the other tables of the lake that may be suggested.

    Returns
    -------
    str
        The message, one line.
    """
    texts, unknown = [], []
    for name in names:
        text = suggestions.explain_missing_column(name.lower(), {table: columns}, other_tables)
        _, mark, remedy = text.removeprefix(f"column {name.lower()} does not exist").partition(suggestions.LIST)
        if mark:
            unknown.append(name)
        else:
            remedy = text.removeprefix(f"column {name.lower()} does not exist")
            texts.append(f"{name}{remedy.replace('; add JOIN', '; in lake.sql add JOIN')}")
    if unknown:
        texts.append(f"{spelling.join_words(unknown, 'and')}; it has {', '.join(columns)}")
    return f"table {table} has no column {'; no column '.join(texts)}"


def _pair(name: str, value: Any) -> tuple[Any, Any]:
    try:
        first, second = value
    except (TypeError, ValueError):
        example = "(100, 100) for x and y" if name == "bins" else "(0.0, 1.0), from the lowest to the highest edge"
        raise BadInput(f"{name} = {value!r} is not a pair such as {example}") from None
    return first, second


def _check_span(span: Range) -> Range:
    lo, hi = (arguments.check_number("span", edge) for edge in _pair("span", span))
    if not (np.isfinite([lo, hi]).all() and lo < hi):
        raise BadInput(f"span must be from a finite number to a larger one, got {span}")
    return lo, hi


def _bin_sql(axis: str) -> str:
    """Return SQL for the index of the bin in which a value lies; the last bin includes its upper edge.

    `axis` is "x" or "y", the name of the column with the values. For "x" the query needs the parameters $x_lo and $x_hi
    (lowest and highest edge of the bins) and $x_bins (their number), and for "y" those that begin with $y.
    """
    return f"least(floor(({axis} - ${axis}_lo) / (${axis}_hi - ${axis}_lo) * ${axis}_bins), ${axis}_bins - 1)::INT"


def _weight_sql(weight: str | None) -> str:
    return "1 AS w" if weight is None else f"({weight}\n)::DOUBLE AS w"


def _count_sql(weight: str | None) -> str:
    # Rows whose weight is NULL add nothing. If this applies to all rows, the sum is NULL, which coalesce makes 0.
    return "count(*)" if weight is None else "coalesce(sum(w), 0)"
