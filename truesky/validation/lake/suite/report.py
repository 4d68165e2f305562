"""Write the report of a validation: one HTML file with verdicts and plots, which a browser opens without a network."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from html import escape

from lake_schema import __version__
from truesky.validation.lake.measure.rows import Row
from truesky.validation.lake.suite import figures
from truesky.validation.lake.suite.running import LakeResults
from truesky.validation.verdicts import FAIL, NOT_APPLICABLE, PASS, UNDECIDED

# Order of the verdicts in the report.
_ORDER = (FAIL, UNDECIDED, PASS, NOT_APPLICABLE)
# Style sheet of the report.
_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 1150px; padding: 0 1em; color: #1a1a1a; }
table { border-collapse: collapse; margin: .6em 0 1.6em; } th, td { padding: .2em .7em; text-align: left; }
tr { border-bottom: 1px solid #ddd; } td.n { text-align: right; font-variant-numeric: tabular-nums; }
.pass { color: #176f2c; } .fail { color: #b00020; font-weight: 700; } .undecided { color: #8a5a00; }
.not_applicable { color: #666; } img { max-width: 100%; } figure { margin: 1em 0 2em; } figcaption { color: #444; }
details { margin-bottom: 1em; } summary { cursor: pointer; }
"""


def page(name: str, results: LakeResults) -> str:
    """Return the HTML text of the report for the results of a lake; `name` is the name of the lake in the title."""
    verdict_counts = Counter(row.verdict for row in results.rows)
    summary = ", ".join(f'<span class="{v}">{verdict_counts[v]} {v.replace("_", " ")}</span>' for v in _ORDER)
    parts = [
        f"<!DOCTYPE html><html lang='en'><head><meta charset='utf-8'><title>Validation of {escape(name)}</title>",
        f"<style>{_STYLE}</style></head><body><h1>Validation of {escape(name)}</h1>",
        f"<p>truesky {__version__}: {len(results.rows)} figures, {summary}.</p>",
        "<p>A figure fails if it is more than three standard errors beyond its tolerance; it is undecided if its "
        "error is too large for a decision.</p>",
        _summary(results.rows),
        *(
            f"<figure><img alt='{escape(text)}' src='data:image/png;base64,{image}'><figcaption>{escape(text)}"
            "</figcaption></figure>"
            for text, image in figures.draw_all(results)
        ),
        _details("Failed", [row for row in results.rows if row.verdict == FAIL], True),
        _details("Undecided", [row for row in results.rows if row.verdict == UNDECIDED], False),
        _details("Not applicable, with reasons", [row for row in results.rows if row.verdict == NOT_APPLICABLE], False),
        _details("Passed", [row for row in results.rows if row.verdict == PASS], False),
        "</body></html>",
    ]
    return "\n".join(parts)


def _summary(rows: Sequence[Row]) -> str:
    """Return an HTML table with the number of passed, failed and other rows for each check, channel and band."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.check, " ".join(filter(None, (row.place.channel, row.place.band)))), []).append(row)
    head = "<table><tr><th>check</th><th>channel and band</th>" + "".join(
        f"<th>{v.replace('_', ' ')}</th>" for v in _ORDER
    )
    lines = [f"{head}<th>source</th></tr>"]
    for (check, place), group in sorted(groups.items()):
        verdict_counts = Counter(row.verdict for row in group)
        cells = "".join(
            f"<td class='n {v if verdict_counts[v] else ''}'>{verdict_counts[v] or ''}</td>" for v in _ORDER
        )
        source = escape("; ".join(dict.fromkeys(row.source for row in group)))
        lines.append(f"<tr><td>{escape(check)}</td><td>{escape(place)}</td>{cells}<td>{source}</td></tr>")
    return "\n".join([*lines, "</table>"])


def _details(title: str, rows: Sequence[Row], unfolded: bool) -> str:
    if not rows:
        return ""
    head = "<tr><th>check</th><th>quantity</th><th>where</th><th>value</th><th>expected</th><th>note</th></tr>"
    lines = "\n".join(_line(row) for row in rows)
    return (
        f"<details{' open' if unfolded else ''}><summary>{title}: {len(rows)}</summary><table>{head}{lines}</table>"
        "</details>"
    )


def _line(row: Row) -> str:
    cells: Iterable[str] = (
        row.check,
        row.quantity,
        row.place.text,
        format_value(row),
        format_expected(row),
        _note_text(row),
    )
    first, *rest = (f"<td>{escape(cell)}</td>" for cell in cells)
    return f"<tr class='{row.verdict}'>{first}{''.join(rest)}</tr>"


def _note_text(row: Row) -> str:
    return "; ".join(filter(None, (row.note, row.known_failure and f"known to fail: {row.known_failure}")))


def format_value(row: Row) -> str:
    """Return the measured value of a row as text with its standard error and unit, "" if it was not measured.

    The error is left out if it is NaN or 0.
    """
    if row.value != row.value:
        return ""
    error = f" ± {row.error:.2g}" if row.error == row.error and row.error > 0.0 else ""
    return f"{row.value:.5g}{error} {row.unit}".strip()


def format_expected(row: Row) -> str:
    """Return the expected value of a row as text with its tolerance, "" if there was nothing to measure."""
    if not row.applies:
        return ""
    sign = {"around": "±", "least": "at least, −", "most": "at most, +"}[row.kind]
    return f"{row.expected:.5g} {sign} {row.tolerance:.3g}"
