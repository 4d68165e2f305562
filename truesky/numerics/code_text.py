"""Reduce Python source code to its code, without docstrings, comments and blank lines, so that hashes ignore these."""

from __future__ import annotations

import ast
import bisect
from typing import TypeGuard


def code_text(source: str, tree: ast.Module | None = None) -> str:
    """Return source code without docstrings, comments, blank lines and spaces at the ends of lines.

    The result is not valid Python: it serves to compare sources. It does not depend on the version of Python.

    Parameters
    ----------
    source : str
        Text of a Python file.
    tree : ast.Module, optional
        Syntax tree of the source, if the caller has parsed it already.

    Returns
    -------
    str
        The lines that contain code, with line ends between them. Strings stay unchanged.

    Raises
    ------
    SyntaxError
        If the source is not valid Python and no tree is given.
    """
    tree = ast.parse(source) if tree is None else tree
    lines = [line.encode() for line in source.split("\n")]
    # Find the spans of all strings: index of the first line, first byte in it, index of the last line, byte after its
    # end. Indices begin with 0.
    nodes = list(ast.walk(tree))
    docstrings = {_span(node.body[0]) for node in nodes if _has_docstring(node)}
    strings = sorted({_span(node) for node in nodes if _is_text(node)} - docstrings)
    for first, start, last, end in sorted(docstrings, reverse=True):
        lines[first : last + 1] = [lines[first][:start] + lines[last][end:]] + [b""] * (last - first)
    # Indices of the lines that end inside a string. The blanks at the end of these lines belong to the string.
    open_end = {number for first, _, last, _ in strings for number in range(first, last)}
    code_lines = []
    for number, whole in enumerate(lines):
        line = _without_comment(number, whole, strings)
        line = line if number in open_end else line.rstrip()
        if line or number in open_end or number - 1 in open_end:
            code_lines.append(line.decode())
    return "\n".join(code_lines)


def _span(node: ast.AST) -> tuple[int, int, int, int]:
    assert isinstance(node, ast.expr | ast.stmt)
    assert node.end_lineno is not None
    assert node.end_col_offset is not None
    return node.lineno - 1, node.col_offset, node.end_lineno - 1, node.end_col_offset


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str | bytes))


def _has_docstring(node: ast.AST) -> TypeGuard[ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef]:
    if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) or not node.body:
        return False
    first = node.body[0]
    return isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and isinstance(first.value.value, str)


def _without_comment(number: int, line: bytes, strings: list[tuple[int, int, int, int]]) -> bytes:
    """Return line `number` of the source without its comment, that is, cut at the first # outside all strings.

    `strings` has the spans of all strings (first line, first byte, last line, last byte), sorted. A span may contain
    others, as in f-strings.
    """
    start = line.find(b"#")
    while start >= 0:
        candidates = strings[: bisect.bisect_right(strings, (number, start + 1))]
        if not any((first, begin) <= (number, start) < (last, end) for first, begin, last, end in candidates):
            return line[:start]
        start = line.find(b"#", start + 1)
    return line
