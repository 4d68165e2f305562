"""A lake, opened for looking: its tables as they were at that moment, whatever is published meanwhile."""

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

# Order of the cells of a map of the sky if none is given.
ORDER = 8
_MAX_BINS = 10_000
# How a table that cannot be read is listed, by its error; all others are damaged.
_UNREADABLE: dict[type[LakeError], str] = {VersionMismatch: "unreadable version"}


class Explorer:
    """Tables of a lake, and the process that answers questions about them; ends with `close` or a `with` block.

    memory  : bytes that a query and its result may take together
    timeout : s after which a query is stopped
    request : whose tables; without it every table that all requests share goes by its name, and any table of a
              request by both: "demo.products", in SQL too
    damaged : tables that cannot be opened, and why; the others can be looked at
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
        # Whoever asks for one of these is told what is wrong with it.
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
        """Another process that answers queries of these versions, for who asks several questions at a time.

        more : NAME=@FILE of Arrow files that are tables, too
        """
        return Process(self.root, [*self._table_arguments, *extra_tables], self._memory)

    def __enter__(self) -> Explorer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process; a later query starts another."""
        self._process.close()

    # ------------------------------------------------------------------------------------------------ what there is

    def tables(self) -> pd.DataFrame:
        """The tables: rows, megabytes, files, version and meaning."""
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
        """Whether a table is listed by this name: by its own; where requests have versions of their own, by both."""
        table = name.rpartition(".")[2]
        return name == table or table in self._ambiguous

    def describe(self, table: str) -> pd.DataFrame:
        """The columns of a table: type, unit, range, UCD, meaning."""
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
        """The result of one SELECT over the lake's tables.

        text       : DuckDB's SQL, with separation(ra1, dec1, ra2, dec2) in deg and mag_ab(f_nu) of microjansky beside
                     its own functions; $name stands for a parameter
        into       : "pandas", "astropy" (a Table with units) or "arrow"
        parameters : numbers, texts, booleans or lists of them
        Errors     : BadInput for what is no SELECT of ours, or takes too long or too much; Damaged for a changed byte
        """
        return results.convert(self._process.ask(text, parameters, self.timeout), into)

    def cone(
        self, table: str, ra: float, dec: float, radius: float, columns: Sequence[str] | None = None,
        on: str = "observed", into: str = "pandas",
    ) -> Any:  # fmt: skip
        """Rows of a catalogue within a circle.

        ra, dec, radius : deg;  on : "observed" or "true" positions
        table, columns  : names; columns None: all of them;  into : kind of the result, as of `sql`
        """
        return results.convert(self._version(table).cone(ra, dec, radius, columns, on), into)

    def export(self, text: str, path: str | Path, /, **parameters: object) -> Path:
        """Write the result of a SELECT to a .csv, .parquet, .fits or .vot file; returns its path."""
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
        """Counts of an expression in equal bins.

        table            : name, or what may follow FROM, such as "galaxies JOIN galaxy_fluxes USING (id)"
        x, where, weight : SQL of the table's columns;  span : lowest and highest value, None = all
        returns          : counts[bins], edges[bins + 1]
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
        """Counts of two expressions in a grid of equal bins.

        table   : as of `hist`;  where : SQL condition of the rows that count;  weight : SQL that is summed, None = 1
        x, y    : SQL expressions;  bins, span : of each of the two; span None: from least to largest
        returns : counts[y bins, x bins], edges of x, edges of y
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
        """Counts in nested HEALPix cells of an order: int64[n] cells that hold any, ascending, and their counts [n].

        table  : as of `hist`;  order : of the cells
        where  : SQL condition of the rows that count;  weight : SQL that is summed, None = 1
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
        raise BadInput(f"span = {span} is not from a finite number to a larger one")
    return lo, hi


def _bin_sql(axis: str) -> str:
    """Number of the bin of a column `x` or `y`; the last bin includes its upper edge."""
    return f"least(floor(({axis} - ${axis}_lo) / (${axis}_hi - ${axis}_lo) * ${axis}_bins), ${axis}_bins - 1)::INT"


def _weight_sql(weight: str | None) -> str:
    return "1 AS w" if weight is None else f"({weight}\n)::DOUBLE AS w"


def _count_sql(weight: str | None) -> str:
    # The sum is NULL if all rows lack a weight; a row without one counts nothing.
    return "count(*)" if weight is None else "coalesce(sum(w), 0)"
