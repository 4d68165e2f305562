"""XML documents of the TAP service: capabilities, list of tables, availability, and states of asynchronous jobs.

References
----------
IVOA Recommendations VOSI 1.1, VODataService 1.1, TAPRegExt 1.0, UWS 1.1
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import datetime

from truesky.explore.votables import escape, quote_attribute
from truesky.page.tap.tables import FOREIGN_KEYS, SCHEMA_DESCRIPTIONS, TableEntry, describe_columns

FORMATS = {
    "application/x-votable+xml": ("votable", "vot"),
    "text/csv": ("csv",),
    "application/vnd.apache.parquet": ("parquet",),
}
_XML_HEADER = '<?xml version="1.0" encoding="UTF-8"?>\n'
_XSI = 'xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance"'
_FEATURES = ("POINT", "CIRCLE", "POLYGON", "CONTAINS", "INTERSECTS", "DISTANCE", "COORD1", "COORD2")
_ADQL_GEO = "ivo://ivoa.net/std/TAPRegExt#features-adqlgeo"


def availability(up_since: datetime) -> str:
    """Return the VOSI document (XML) which states that the service has been available since a time (UTC)."""
    return (
        f'{_XML_HEADER}<vosi:availability xmlns:vosi="http://www.ivoa.net/xml/VOSIAvailability/v1.0">'
        f"<vosi:available>true</vosi:available><vosi:upSince>{format_time(up_since)}</vosi:upSince></vosi:availability>\n"
    )


def capabilities(address: str, max_rows: int, default_rows: int, seconds: float) -> str:
    """Return the VOSI document (XML) with the addresses, languages, formats and limits of the TAP service.

    Parameters
    ----------
    address : str
        URL of the service.
    max_rows : int
        Largest number of rows of an answer.
    default_rows : int
        Largest number of rows if a query has no parameter MAXREC.
    seconds : float
        Time limit of a query in seconds.

    Returns
    -------
    str
        The XML document.
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
        f'{_XML_HEADER}<vosi:capabilities xmlns:vosi="http://www.ivoa.net/xml/VOSICapabilities/v1.0" {_XSI} '
        f'xmlns:vs="http://www.ivoa.net/xml/VODataService/v1.1" xmlns:tr="http://www.ivoa.net/xml/TAPRegExt/v1.0">\n'
        f'{vosi}<capability standardID="ivo://ivoa.net/std/TAP" xsi:type="tr:TableAccess">'
        f'<interface xsi:type="vs:ParamHTTP" role="std" version="1.1">'
        f'<accessURL use="base">{escape(address)}</accessURL></interface>\n'
        f'<dataModel ivo-id="ivo://ivoa.net/std/ObsCore#core-1.1">ObsCore-1.1</dataModel>'
        f'<language><name>ADQL</name><version ivo-id="ivo://ivoa.net/std/ADQL#v2.0">2.0</version>'
        f'<version ivo-id="ivo://ivoa.net/std/ADQL#v2.1">2.1</version>'
        f"<description>DuckDB runs the queries. They may also call its functions.</description>"
        f'<languageFeatures type="{_ADQL_GEO}">{features}</languageFeatures></language>\n'
        f"{formats}<retentionPeriod><default>86400</default></retentionPeriod>"
        f"<executionDuration><default>{seconds:.0f}</default><hard>{seconds:.0f}</hard></executionDuration>"
        f'<outputLimit><default unit="row">{default_rows}</default><hard unit="row">{max_rows}</hard></outputLimit>'
        f"</capability>\n</vosi:capabilities>\n"
    )


def describe_tables(entries: Iterable[TableEntry]) -> str:
    """Return the VOSI document (XML) of tables, with their columns and foreign keys, grouped by schema."""
    by_schema: dict[str, list[TableEntry]] = {}
    for table in entries:
        by_schema.setdefault(table.schema, []).append(table)
    schemas = "".join(
        f"<schema><name>{escape(name)}</name>"
        f"<description>{escape(SCHEMA_DESCRIPTIONS.get(name, f'Tables of request {name}.'))}</description>\n"
        f"{''.join(map(_table, schema_entries))}</schema>\n"
        for name, schema_entries in by_schema.items()
    )
    return (
        f'{_XML_HEADER}<vosi:tableset xmlns:vosi="http://www.ivoa.net/xml/VOSITables/v1.0" {_XSI} '
        f'xmlns:vs="http://www.ivoa.net/xml/VODataService/v1.1">\n{schemas}</vosi:tableset>\n'
    )


def _table(entry: TableEntry) -> str:
    columns = "".join(_column(column) for column in describe_columns(entry))
    keys = "".join(
        f"<foreignKey><targetTable>{target_table}</targetTable><fkColumn><fromColumn>{from_column}</fromColumn>"
        f"<targetColumn>{target_column}</targetColumn></fkColumn></foreignKey>"
        for _, from_table, from_column, target_table, target_column in FOREIGN_KEYS
        if from_table == entry.name
    )
    description = f"<description>{escape(entry.description)}</description>" if entry.description else ""
    return f'<table type="table"><name>{escape(entry.name)}</name>{description}\n{columns}{keys}</table>\n'


def _column(column: Mapping[str, object]) -> str:
    text_elements = "".join(
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
    shape_attributes = f" arraysize={quote_attribute(str(column['arraysize']))}" if column["arraysize"] else ""
    shape_attributes += f" extendedType={quote_attribute(str(column['xtype']))}" if column["xtype"] else ""
    flags = "<flag>indexed</flag>" if column["indexed"] else ""
    type_element = f'<dataType xsi:type="vs:VOTableType"{shape_attributes}>{column["datatype"]}</dataType>'
    return f'<column std="{"true" if column["std"] else "false"}">{text_elements}{type_element}{flags}</column>\n'


_UWS = 'xmlns:uws="http://www.ivoa.net/xml/UWS/v1.0" xmlns:xlink="http://www.w3.org/1999/xlink" ' + _XSI


def describe_job(facts: Mapping[str, object], parameters: Mapping[str, str], result: str | None, error: str) -> str:
    """Return the UWS document (XML) that describes an asynchronous job.

    Parameters
    ----------
    facts : mapping of str to object
        Properties of the job by their names in UWS, such as "phase"; None if a property has no value yet.
    parameters : mapping of str to str
        Parameters of the query by name, such as QUERY.
    result : str or None
        URL of the result; None if there is no result yet.
    error : str
        Error message; "" if the job has not failed.

    Returns
    -------
    str
        The XML document.
    """
    return (
        f'{_XML_HEADER}<uws:job {_UWS} version="1.1">\n{_job_elements(facts)}{describe_parameters(parameters, False)}'
        + (f"{describe_results(result, False)}{_error_element(error)}</uws:job>\n")
    )


def describe_parameters(parameters: Mapping[str, str], is_document: bool = True) -> str:
    """Return the parameters of a UWS job as an XML document, or as an element of one if `is_document` is False."""
    rows = "".join(
        f"<uws:parameter id={quote_attribute(name)}>{escape(value)}</uws:parameter>"
        for name, value in parameters.items()
    )
    return _wrap_element("parameters", rows, is_document)


def describe_results(result: str | None, is_document: bool = True) -> str:
    """Return the list of results of a UWS job as an XML document, or as an element of one if `is_document` is False.

    `result` is the URL of the only result; None makes an empty list.
    """
    row = f'<uws:result id="result" xlink:type="simple" xlink:href={quote_attribute(result)}/>' if result else ""
    return _wrap_element("results", row, is_document)


def list_jobs(rows: Iterable[tuple[str, str, str, datetime]]) -> str:
    """Return the UWS document (XML) that lists jobs; each row is (identifier, URL, phase, creation time in UTC)."""
    references = "".join(
        f'<uws:jobref id={quote_attribute(name)} xlink:type="simple" xlink:href={quote_attribute(address)}>'
        f"<uws:phase>{phase}</uws:phase><uws:creationTime>{format_time(creation_time)}</uws:creationTime></uws:jobref>\n"
        for name, address, phase, creation_time in rows
    )
    return f'{_XML_HEADER}<uws:jobs {_UWS} version="1.1">\n{references}</uws:jobs>\n'


def _wrap_element(name: str, content: str, is_document: bool) -> str:
    start_tag = f"{_XML_HEADER}<uws:{name} {_UWS}>" if is_document else f"<uws:{name}>"
    return f"{start_tag}{content}</uws:{name}>\n"


def _job_elements(facts: Mapping[str, object]) -> str:
    out = []
    for name, value in facts.items():
        if value is None:
            out.append(f'<uws:{name} xsi:nil="true"/>\n')
        else:
            text = format_time(value) if isinstance(value, datetime) else str(value)
            out.append(f"<uws:{name}>{escape(text)}</uws:{name}>\n")
    return "".join(out)


def _error_element(error: str) -> str:
    if not error:
        return ""
    message = f"<uws:message>{escape(error)}</uws:message>"
    return f'<uws:errorSummary type="fatal" hasDetail="true">{message}</uws:errorSummary>\n'


def format_time(time: datetime) -> str:
    """Format a UTC time by ISO 8601 with milliseconds, such as 2024-07-01T12:00:00.000Z."""
    return time.strftime("%Y-%m-%dT%H:%M:%S.%f")[:-3] + "Z"
