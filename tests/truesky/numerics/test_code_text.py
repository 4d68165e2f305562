"""Docstrings, comments and blank lines are no part of the text that caches are keyed by; everything else is."""

import ast
import io
import tokenize
from pathlib import Path

import pytest

from truesky.numerics.code_text import code_text

ROOT = Path(__file__).resolve().parents[3]
# Spaces at the end of a line inside a string are part of the string.
SPACES = "   "
SOURCE = f'''"""A module."""

# A comment.
TEXT = "# no comment"  # a comment with a "quote"
HTML = """
  # no comment{SPACES}

body {{ color: #fff }}"""
LINE = f"{{TEXT:#>4}}"  # another


class Star:
    """A star."""

    def flux(self, pixel): return self.table["#"]  # unit: electrons

    def name(self):
        """Return the name."""
        return "star"
'''
CODE = f'''TEXT = "# no comment"
HTML = """
  # no comment{SPACES}

body {{ color: #fff }}"""
LINE = f"{{TEXT:#>4}}"
class Star:
    def flux(self, pixel): return self.table["#"]
    def name(self):
        return "star"'''


def test_only_code_is_left():
    assert code_text(SOURCE) == CODE


@pytest.mark.parametrize(
    ("old", "new"),
    [("A star.", "One star\n\n    of many."), ("# A comment.\n", ""), ("electrons", "e-"), ("\n\n\n", "\n")],
)
def test_prose_does_not_count(old, new):
    assert code_text(SOURCE.replace(old, new)) == CODE


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (f"# no comment{SPACES}", "# no comment"),
        ("\n\nbody", "\nbody"),
        ("#fff", "#ff0"),
        ('"star"', '"stars"'),
        (">4", ">5"),
    ],
)
def test_strings_and_code_count(old, new):
    assert code_text(SOURCE.replace(old, new)) != CODE


@pytest.mark.parametrize("path", sorted((ROOT / "truesky" / "render").rglob("*.py"))[::5], ids=lambda path: path.name)
def test_comments_are_those_that_python_finds(path):
    source = path.read_text()
    comments = [t.string for t in tokenize.generate_tokens(io.StringIO(source).readline) if t.type == tokenize.COMMENT]
    docstrings = [
        ast.get_docstring(node, clean=False) or ""
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
    ]
    assert code_text(source).count("#") == source.count("#") - sum(text.count("#") for text in (*comments, *docstrings))
