"""Check that rows agree with the declaration of their table: columns, types, units, ranges, codes and unique keys.

Rows are checked before they are written. Readers can check them again.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema.columns import Column, Table
from lake_schema.errors import BadInput


def find_violations(rows: pa.Table, table: Table) -> list[str]:
    """Return one sentence for each way in which rows differ from the declaration of their table, [] if they agree.

    If names, order, types, nullability or units of the columns differ, the values are not checked.
    """
    messages = _schema_violations(rows.schema, table)
    if messages:
        return messages
    for column in table.columns:
        messages += _content_violations(rows[column.name], column, table.name)
    return messages + _duplicates(rows, table)


def check_rows(rows: pa.Table, table: Table) -> None:
    """Raise BadInput if `rows` do not agree with the declaration of `table`.

    The message describes the first difference that `find_violations` finds, and gives the number of the others.
    """
    messages = find_violations(rows, table)
    if messages:
        suffix = f" (and {len(messages) - 1} more)" if len(messages) > 1 else ""
        raise BadInput(messages[0] + suffix)


def _schema_violations(schema: pa.Schema, table: Table) -> list[str]:
    declared = table.arrow_schema()
    messages = [f"table {table.name}: column {name} is missing" for name in declared.names if name not in schema.names]
    messages += [
        f"table {table.name}: column {name} is not declared" for name in schema.names if name not in declared.names
    ]
    if messages:
        return messages
    if schema.names != declared.names:
        return [f"table {table.name}: columns are in another order than declared"]
    for declared_field in declared:
        field = schema.field(declared_field.name)
        where = f"table {table.name}: column {declared_field.name}"
        if field.type != declared_field.type:
            messages.append(f"{where} is {field.type}, but must be {declared_field.type}")
        elif field.nullable != declared_field.nullable:
            messages.append(f"{where} is {'' if field.nullable else 'not '}nullable, unlike in the declaration")
        elif _unit(field) != _unit(declared_field):
            messages.append(f"{where} has unit {_unit(field)!r}, but must have {_unit(declared_field)!r}")
    return messages


def _unit(field: pa.Field) -> str:
    return str((field.metadata or {}).get(b"unit", b"").decode())


def _content_violations(values: pa.ChunkedArray, column: Column, table: str) -> list[str]:
    where = f"table {table}: column {column.name}"
    if values.null_count and not column.nullable:
        return [f"{where} has {values.null_count} missing values, the first in row {_first_true(pc.is_null(values))}"]
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
            place = _first_true(strange)
            return [f"{where} is {values[place].as_py()} in row {row_of(place)}, but must be finite"]
    messages = []
    for bound, compare in ((column.lo, pc.less), (column.hi, pc.greater)):
        if bound is None or len(values) == 0:
            continue
        # Round the bound to the type of the column before comparing: 0.02 as a float32 is slightly less than 0.02, so
        # a value that equals the bound would be refused.
        scalar = pa.scalar(np.dtype(values.type.to_pandas_dtype()).type(bound), values.type)
        out_of_range = compare(values, scalar)
        if pc.any(out_of_range).as_py():
            place = _first_true(out_of_range)
            bounds = f"[{column.lo}, {column.hi}]"
            messages.append(f"{where} is {values[place].as_py()} in row {row_of(place)}, outside {bounds}")
    return messages + ([] if messages else _code_violations(values, column, where))


def _code_violations(values: pa.ChunkedArray, column: Column, where: str) -> list[str]:
    if not column.codes:
        return []
    legal = pa.array([code for code, _ in column.codes], values.type)
    strange = pc.and_(pc.invert(pc.is_in(values, value_set=legal)), pc.is_valid(values))
    if not pc.any(strange).as_py():
        return []
    row = _first_true(strange)
    return [f"{where} is {values[row].as_py()!r} in row {row}, not one of {legal.to_pylist()}"]


def _duplicates(rows: pa.Table, table: Table) -> list[str]:
    if len(table.key) == 1 and pa.types.is_integer(rows.schema.field(table.key[0]).type):
        keys = np.sort(rows[table.key[0]].to_numpy())
        same = keys[1:] == keys[:-1]
        if not same.any():
            return []
        value = int(keys[1:][same][0])
        places = np.flatnonzero(rows[table.key[0]].to_numpy() == value)
        return [f"table {table.name}: {table.key[0]} {value} is in rows {places[0]} and {places[1]}"]
    if _is_ascending(rows.select(list(table.key))):
        return []
    if rows.group_by(list(table.key), use_threads=False).aggregate([]).num_rows == rows.num_rows:
        return []
    row_by_key: dict[tuple[object, ...], int] = {}
    for row, key in enumerate(zip(*(rows[k].to_pylist() for k in table.key), strict=True)):
        if key in row_by_key:
            return [f"table {table.name}: key {key} is in rows {row_by_key[key]} and {row}"]
        row_by_key[key] = row
    return []


def _is_ascending(keys: pa.Table) -> bool:
    """Return True if each row of keys is above the row before it, which proves that no key occurs twice.

    The first column decides, then the second one, and so on. The test is much faster than a search for
    duplicates.
    """
    earlier_rows, later_rows = keys.slice(0, max(keys.num_rows - 1, 0)), keys.slice(1)
    for name in keys.column_names:
        if pc.any(pc.greater(earlier_rows[name], later_rows[name])).as_py():
            return False
        equal = pc.equal(earlier_rows[name], later_rows[name])
        earlier_rows, later_rows = earlier_rows.filter(equal), later_rows.filter(equal)
    return bool(earlier_rows.num_rows == 0)


def _first_true(flags: pa.ChunkedArray) -> int:
    return int(pc.index(flags, pa.scalar(True)).as_py())
