"""What a TAP service says of itself: capabilities, tables, availability; and of a question that waits.

Ref: IVOA Recommendations VOSI 1.1, VODataService 1.1, TAPRegExt 1.0, UWS 1.1
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import datetime
from xml.sax.saxutils import escape, quoteattr

from truesky.page.tap.tables import KEYS, SCHEMAS, Listed, columns_of

FORMATS = {
    "application/x-votable+xml": ("votable", "vot"),
    "text/csv": ("csv",),
    "application/vnd.apache.parquet": ("parquet",),
}
_HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n'
_XSI = 'xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance"'
_FEATURES = ("POINT", "CIRCLE", "POLYGON", "CONTAINS", "INTERSECTS", "DISTANCE", "COORD1", "COORD2")
_ADQL_GEO = "ivo://ivoa.net/std/TAPRegExt#features-adqlgeo"


def availability(since: datetime) -> str:
    """That it answers."""
    return (
        f'{_HEAD}<vosi:availability xmlns:vosi="http://www.ivoa.net/xml/VOSIAvailability/v1.0">'
        f"<vosi:available>true</vosi:available><vosi:upSince>{moment(since)}</vosi:upSince></vosi:availability>\n"
    )


def capabilities(address: str, most_rows: int, usual_rows: int, seconds: float) -> str:
    """What it can do, and where.

    address : of the service;  seconds : that a query may take
    most_rows, usual_rows : of an answer at most, and where nobody says
    """
    vosi = "".join(
        f'<capability standardID="ivo://ivoa.net/std/VOSI#{name}"><interface xsi:type="vs:ParamHTTP" role="std">'
        f'<accessURL use="full">{escape(address)}/{name}</accessURL></interface></capability>\n'
        for name in ("capabilities", "availability", "tables")
    )
    formats = "".join(
        f"<outputFormat><mime>{kind}</mime>{''.join(f'<alias>{name}</alias>' for name in names)}</outputFormat>\n"
        for kind, names in FORMATS.items()
    )
    features = "".join(f"<feature><form>{name}</form></feature>" for name in _FEATURES)
    return (
        f'{_HEAD}<vosi:capabilities xmlns:vosi="http://www.ivoa.net/xml/VOSICapabilities/v1.0" {_XSI} '
        f'xmlns:vs="http://www.ivoa.net/xml/VODataService/v1.1" xmlns:tr="http://www.ivoa.net/xml/TAPRegExt/v1.0">\n'
        f'{vosi}<capability standardID="ivo://ivoa.net/std/TAP" xsi:type="tr:TableAccess">'
        f'<interface xsi:type="vs:ParamHTTP" role="std" version="1.1">'
        f'<accessURL use="base">{escape(address)}</accessURL></interface>\n'
        f'<dataModel ivo-id="ivo://ivoa.net/std/ObsCore#core-1.1">ObsCore-1.1</dataModel>'
        f'<language><name>ADQL</name><version ivo-id="ivo://ivoa.net/std/ADQL#v2.0">2.0</version>'
        f'<version ivo-id="ivo://ivoa.net/std/ADQL#v2.1">2.1</version>'
        f"<description>Run by DuckDB: its own functions can be called, too.</description>"
        f'<languageFeatures type="{_ADQL_GEO}">{features}</languageFeatures></language>\n'
        f"{formats}<retentionPeriod><default>86400</default></retentionPeriod>"
        f"<executionDuration><default>{seconds:.0f}</default><hard>{seconds:.0f}</hard></executionDuration>"
        f'<outputLimit><default unit="row">{usual_rows}</default><hard unit="row">{most_rows}</hard></outputLimit>'
        f"</capability>\n</vosi:capabilities>\n"
    )


def tables(listed: Iterable[Listed]) -> str:
    """The tables with their columns and keys."""
    by_schema: dict[str, list[Listed]] = {}
    for table in listed:
        by_schema.setdefault(table.schema, []).append(table)
    schemas = "".join(
        f"<schema><name>{escape(name)}</name>"
        f"<description>{escape(SCHEMAS.get(name, f'Tables of request {name}.'))}</description>\n"
        f"{''.join(map(_table, own))}</schema>\n"
        for name, own in by_schema.items()
    )
    return (
        f'{_HEAD}<vosi:tableset xmlns:vosi="http://www.ivoa.net/xml/VOSITables/v1.0" {_XSI} '
        f'xmlns:vs="http://www.ivoa.net/xml/VODataService/v1.1">\n{schemas}</vosi:tableset>\n'
    )


def _table(table: Listed) -> str:
    columns = "".join(_column(column) for column in columns_of(table))
    keys = "".join(
        f"<foreignKey><targetTable>{target}</targetTable><fkColumn><fromColumn>{a}</fromColumn>"
        f"<targetColumn>{b}</targetColumn></fkColumn></foreignKey>"
        for _, own, a, target, b in KEYS
        if own == table.name
    )
    about = f"<description>{escape(table.description)}</description>" if table.description else ""
    return f'<table type="table"><name>{escape(table.name)}</name>{about}\n{columns}{keys}</table>\n'


def _column(column: Mapping[str, object]) -> str:
    texts = "".join(
        f"<{tag}>{escape(str(column[key]))}</{tag}>"
        for tag, key in (
            ("name", "column_name"),
            ("description", "description"),
            ("unit", "unit"),
            ("ucd", "ucd"),
            ("utype", "utype"),
        )
        if column[key]
    )
    shape = f" arraysize={quoteattr(str(column['arraysize']))}" if column["arraysize"] else ""
    shape += f" extendedType={quoteattr(str(column['xtype']))}" if column["xtype"] else ""
    flags = "<flag>indexed</flag>" if column["indexed"] else ""
    kind = f'<dataType xsi:type="vs:VOTableType"{shape}>{column["datatype"]}</dataType>'
    return f'<column std="{"true" if column["std"] else "false"}">{texts}{kind}{flags}</column>\n'


# ------------------------------------------------------------------------------------------------ jobs


_UWS = 'xmlns:uws="http://www.ivoa.net/xml/UWS/v1.0" xmlns:xlink="http://www.w3.org/1999/xlink" ' + _XSI


def job(facts: Mapping[str, object], parameters: Mapping[str, str], result: str | None, error: str) -> str:
    """A job of UWS.

    facts  : by UWS's names, None where there is none yet;  parameters : as they were given
    result : address of the result, None = none yet;  error : "" = none
    """
    return f'{_HEAD}<uws:job {_UWS} version="1.1">\n{_facts(facts)}{parameters_of(parameters, False)}' + (
        f"{results_of(result, False)}{_error(error)}</uws:job>\n"
    )


def parameters_of(parameters: Mapping[str, str], alone: bool = True) -> str:
    """The parameters of a job, as a document or as a part of one."""
    rows = "".join(
        f"<uws:parameter id={quoteattr(name)}>{escape(value)}</uws:parameter>" for name, value in parameters.items()
    )
    return _alone("parameters", rows, alone)


def results_of(result: str | None, alone: bool = True) -> str:
    """The results of a job, as a document or as a part of one."""
    row = f'<uws:result id="result" xlink:type="simple" xlink:href={quoteattr(result)}/>' if result else ""
    return _alone("results", row, alone)


def jobs(rows: Iterable[tuple[str, str, str, datetime]]) -> str:
    """A list of jobs: identifier, address, phase, creation time of each."""
    own = "".join(
        f'<uws:jobref id={quoteattr(name)} xlink:type="simple" xlink:href={quoteattr(address)}>'
        f"<uws:phase>{phase}</uws:phase><uws:creationTime>{moment(made)}</uws:creationTime></uws:jobref>\n"
        for name, address, phase, made in rows
    )
    return f'{_HEAD}<uws:jobs {_UWS} version="1.1">\n{own}</uws:jobs>\n'


def _alone(name: str, inner: str, alone: bool) -> str:
    head = f"{_HEAD}<uws:{name} {_UWS}>" if alone else f"<uws:{name}>"
    return f"{head}{inner}</uws:{name}>\n"


def _facts(facts: Mapping[str, object]) -> str:
    out = []
    for name, value in facts.items():
        if value is None:
            out.append(f'<uws:{name} xsi:nil="true"/>\n')
        else:
            shown = moment(value) if isinstance(value, datetime) else str(value)
            out.append(f"<uws:{name}>{escape(shown)}</uws:{name}>\n")
    return "".join(out)


def _error(error: str) -> str:
    if not error:
        return ""
    message = f"<uws:message>{escape(error)}</uws:message>"
    return f'<uws:errorSummary type="fatal" hasDetail="true">{message}</uws:errorSummary>\n'


def moment(when: datetime) -> str:
    """ISO 8601, ms, UTC."""
    return when.strftime("%Y-%m-%dT%H:%M:%S.%f")[:-3] + "Z"
