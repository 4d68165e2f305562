"""Do rows keep what their table declares?  Every task asks before it writes, and a reader can ask again.

violations(rows, table)     list of sentences, each naming table, column, what was found and what was wanted
check(rows, table)          raises BadInput with the first of them
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema.columns import Column, Table
from lake_schema.errors import BadInput


def violations(rows: pa.Table, table: Table) -> list[str]:
    """What is wrong with `rows` as `table`: schema first; contents only where the schema is right."""
    found = _schema_violations(rows.schema, table)
    if found:
        return found
    for column in table.columns:
        found += _content_violations(rows[column.name], column, table.name)
    return found + _duplicates(rows, table)


def check(rows: pa.Table, table: Table) -> None:
    """Raise BadInput, one line, where `rows` are not what `table` declares."""
    found = violations(rows, table)
    if found:
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        raise BadInput(found[0] + more)


def _schema_violations(schema: pa.Schema, table: Table) -> list[str]:
    wanted = table.arrow()
    found = [f"table {table.name}: column {n} is missing" for n in wanted.names if n not in schema.names]
    found += [f"table {table.name}: column {n} is not declared" for n in schema.names if n not in wanted.names]
    if found:
        return found
    if schema.names != wanted.names:
        return [f"table {table.name}: columns are in another order than declared"]
    for want in wanted:
        have = schema.field(want.name)
        where = f"table {table.name}: column {want.name}"
        if have.type != want.type:
            found.append(f"{where} is {have.type}, wanted {want.type}")
        elif have.nullable != want.nullable:
            found.append(f"{where} is {'' if have.nullable else 'not '}nullable, wanted the opposite")
        elif _unit(have) != _unit(want):
            found.append(f"{where} has unit {_unit(have)!r}, wanted {_unit(want)!r}")
    return found


def _unit(field: pa.Field) -> str:
    return str((field.metadata or {}).get(b"unit", b"").decode())


def _content_violations(values: pa.ChunkedArray, column: Column, table: str) -> list[str]:
    where = f"table {table}: column {column.name}"
    if values.null_count and not column.nullable:
        return [f"{where} has {values.null_count} missing values, the first in row {_first(pc.is_null(values))}"]
    if column.type == "string":
        return _code_violations(values, column, where)
    if column.type == "bool":
        return []
    if column.type.startswith("list"):
        owners = pc.list_parent_indices(values)
        return _number_violations(pc.list_flatten(values), column, where, lambda place: int(owners[place].as_py()))
    return _number_violations(values, column, where, int)


def _number_violations(values: pa.ChunkedArray, column: Column, where: str, row_of: Callable[[int], int]) -> list[str]:
    if pa.types.is_floating(values.type):
        strange = pc.invert(pc.is_finite(values))
        if pc.any(strange).as_py():
            place = _first(strange)
            return [f"{where} is {values[place].as_py()} in row {row_of(place)}, wanted a finite number"]
    found = []
    for bound, outside in ((column.lo, pc.less), (column.hi, pc.greater)):
        if bound is None or len(values) == 0:
            continue
        # The bound as the column holds it: 0.02 in float32 is a little less than 0.02.
        scalar = pa.scalar(np.dtype(values.type.to_pandas_dtype()).type(bound), values.type)
        beyond = outside(values, scalar)
        if pc.any(beyond).as_py():
            place = _first(beyond)
            bounds = f"[{column.lo}, {column.hi}]"
            found.append(f"{where} is {values[place].as_py()} in row {row_of(place)}, outside {bounds}")
    return found + ([] if found else _code_violations(values, column, where))


def _code_violations(values: pa.ChunkedArray, column: Column, where: str) -> list[str]:
    if not column.codes:
        return []
    legal = pa.array([code for code, _ in column.codes], values.type)
    strange = pc.and_(pc.invert(pc.is_in(values, value_set=legal)), pc.is_valid(values))
    if not pc.any(strange).as_py():
        return []
    row = _first(strange)
    return [f"{where} is {values[row].as_py()!r} in row {row}, not one of {legal.to_pylist()}"]


def _duplicates(rows: pa.Table, table: Table) -> list[str]:
    if len(table.key) == 1 and pa.types.is_integer(rows.schema.field(table.key[0]).type):
        keys = np.sort(rows[table.key[0]].to_numpy())
        same = keys[1:] == keys[:-1]
        if not same.any():
            return []
        value = int(keys[1:][same][0])
        places = np.flatnonzero(rows[table.key[0]].to_numpy() == value)
        return [f"table {table.name}: {table.key[0]} {value} stands in rows {places[0]} and {places[1]}"]
    if rows.group_by(list(table.key), use_threads=False).aggregate([]).num_rows == rows.num_rows:
        return []
    seen: dict[tuple[object, ...], int] = {}
    for row, key in enumerate(zip(*(rows[k].to_pylist() for k in table.key), strict=True)):
        if key in seen:
            return [f"table {table.name}: key {key} stands in rows {seen[key]} and {row}"]
        seen[key] = row
    return []


def _first(flags: pa.ChunkedArray) -> int:
    return int(pc.index(flags, pa.scalar(True)).as_py())
