"""Messages of errors are one line each and name the key, column, file or argument with the problem."""

import ast
import re
from pathlib import Path

import pytest

from scripts.plain_words import constant_text

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted(path for package in ("lake_schema", "truesky") for path in (ROOT / package).rglob("*.py"))
# Errors whose text is shown to users. The text of OutOfRange is made of its arguments.
ERRORS = {"BadInput", "Damaged", "LakeError", "Superseded", "TasksFailed", "VersionMismatch", "Busy", "Closed"}
# Without a value, a message names an option, a key, a keyword of FITS, a table or the like.
PLACE = re.compile(r"\{\}|--\w|[a-z]+[._][a-z_]+|[A-Z]{3,}|^\w+:|^\w+ = |\b(table|column|request|accuracy|file)\b")
# The caller adds the place, or the subject of the message is the place.
SUBJECT_IS_PLACE = {
    "a polygon must be convex, with no repeated vertex and no angle of 180 deg",
    "a chart has one to three axes, each with a span and a number of bins",
    "package speclite is not installed: its passbands are required",
    "package GalSim is not installed: its spectra of galaxies and Vega are required",
    "content keys do not support arrays of Python objects",
    "sql must be a string",
    "dec must be in [-90, 90] and radius in (0, 180]",
    "push requires the package boto3: pip install 'truesky[s3]', or boto3 alone",
    "the lake has been opened again",
    "x, y must be finite and below 1e6 pixels",
    "parameters can be changed only before a job is started",
    "no frames to combine",
    "the distortion is so strong that some sky positions appear on several pixels or on none",
    "its wavelengths must increase",
    "contains values that are not finite numbers",
    "sources must have galaxies or stars",
}


def messages(tree: ast.AST) -> list[tuple[int, str]]:
    """Return line and text of each message that is written at its `raise`, with {} for values."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and node.exc.args:
            text = constant_text(node.exc.args[0])
            if ast.unparse(node.exc.func) in ERRORS and text:
                found.append((node.lineno, text))
    return found


def faults_of(text: str) -> list[str]:
    """Return what is wrong with a message."""
    faults = []
    if "\n" in text:
        faults.append("has more than one line")
    if text.endswith(".") and not text.endswith(".."):
        faults.append("ends with a full stop")
    if re.match(r"[A-Z][a-z]+ (?!uses|did|has)[a-z]", text):
        faults.append("begins like a sentence")
    if not PLACE.search(text) and text not in SUBJECT_IS_PLACE:
        faults.append("names no place")
    return faults


@pytest.mark.parametrize("package", ["lake_schema", "truesky"])
def test_messages_name_the_place_and_are_one_line(package):
    found, number = [], 0
    for path in SOURCES:
        if path.is_relative_to(ROOT / package):
            for line, text in messages(ast.parse(path.read_text())):
                number += 1
                found += [f"{path.relative_to(ROOT)}:{line}: {text!r} {fault}" for fault in faults_of(text)]
    assert number > 100
    assert found == []


def test_faults_are_found():
    text = 'raise BadInput("wrong")\nraise ValueError("wrong")\nraise Damaged(f"{path}: {fault}")'
    assert messages(ast.parse(text)) == [(1, "wrong"), (3, "{}: {}")]
    assert faults_of("wrong") == ["names no place"]
    assert faults_of("{}: two\nlines.") == ["has more than one line", "ends with a full stop"]
    assert faults_of("Please give a table") == ["begins like a sentence"]
    assert faults_of("{} must be a table, got {}") == []
