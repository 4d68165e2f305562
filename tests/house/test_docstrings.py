"""Docstrings of public functions follow numpydoc: their sections agree with the signature and the body."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted(path for package in ("lake_schema", "truesky") for path in (ROOT / package).rglob("*.py"))
# Public functions with at least this number of parameters describe each of them.
MIN_PARAMETERS = 3


def public_functions(node: ast.AST, prefix: str = "") -> Iterator[tuple[str, ast.FunctionDef]]:
    """Yield (qualified name, function) of public functions and of public methods of public classes."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ClassDef) and not child.name.startswith("_"):
            yield from public_functions(child, f"{prefix}{child.name}.")
        elif isinstance(child, ast.FunctionDef) and not child.name.startswith("_"):
            yield prefix + child.name, child


def parameters_of(function: ast.FunctionDef) -> list[str]:
    """Return the names of the parameters without self and cls, with the stars of *args and **kwargs."""
    given = function.args
    names = [one.arg for one in (*given.posonlyargs, *given.args)]
    names += [f"*{given.vararg.arg}"] if given.vararg else []
    names += [one.arg for one in given.kwonlyargs]
    names += [f"**{given.kwarg.arg}"] if given.kwarg else []
    return [name for name in names if name not in ("self", "cls")]


def sections_of(docstring: str) -> dict[str, list[str]]:
    """Return the lines of each numpydoc section by its title."""
    sections, title = dict[str, list[str]](), ""
    lines = docstring.splitlines()
    for number, line in enumerate(lines):
        underlined = number + 1 < len(lines) and re.fullmatch(r"-{3,}", lines[number + 1].strip())
        if underlined and len(lines[number + 1].strip()) == len(line.strip()):
            title = line.strip()
            sections[title] = []
        elif title:
            sections[title].append(line)
    return sections


def entries_of(lines: list[str]) -> list[str]:
    """Return the names that a section describes: `a, b : float` describes two."""
    heads = [line for line in lines if line.strip() and not line.startswith(" ") and not re.fullmatch(r"-+", line)]
    return [name.strip() for head in heads for name in head.partition(" : ")[0].split(",")]


def _body(function: ast.FunctionDef) -> Iterator[ast.AST]:
    """Yield the nodes of a function without those of functions and classes in it."""
    pending: list[ast.AST] = list(function.body)
    while pending:
        node = pending.pop()
        yield node
        if not isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Lambda):
            pending.extend(ast.iter_child_nodes(node))


def faults_of(function: ast.FunctionDef) -> list[str]:
    """Return what is wrong with a docstring that has a section `Parameters`."""
    sections, faults = sections_of(ast.get_docstring(function) or ""), []
    entries, parameters = entries_of(sections["Parameters"]), parameters_of(function)
    if entries != parameters:
        faults.append(f"describes {entries}, but the parameters are {parameters}")
    returns = ast.unparse(function.returns) if function.returns else "None"
    nothing = returns in ("None", "NoReturn") or any("setter" in ast.unparse(d) for d in function.decorator_list)
    generator = any(isinstance(node, ast.Yield | ast.YieldFrom) for node in _body(function))
    if not nothing and not {"Returns", "Yields"} & sections.keys():
        faults.append("has no section Returns")
    if (
        generator
        and "Yields" not in sections
        and "contextmanager" not in ast.unparse(function.decorator_list or ast.Pass())
    ):
        faults.append("has no section Yields")
    raises = any(isinstance(node, ast.Raise) and node.exc is not None for node in _body(function))
    if raises and "Raises" not in sections:
        faults.append("has no section Raises")
    return faults


def test_sections_agree_with_functions() -> None:
    faults = []
    for path in SOURCES:
        for name, function in public_functions(ast.parse(path.read_text())):
            place = f"{path.relative_to(ROOT)}:{function.lineno}: {name}"
            if "Parameters" in sections_of(ast.get_docstring(function) or ""):
                faults += [f"{place} {fault}" for fault in faults_of(function)]
            elif len(parameters_of(function)) >= MIN_PARAMETERS:
                faults.append(f"{place} has no section Parameters")
    assert faults == []


GOOD = '''
def scale(image, factor, *others, dtype=None, **options) -> Frame:
    """Scale an image.

    Parameters
    ----------
    image, factor : float array
        An image and its factor.
    *others : float
        More factors.
    dtype : type, optional
        Type of the result.
    **options
        Ignored.

    Returns
    -------
    float array
        The product.

    Raises
    ------
    BadInput
        If the factor is 0.
    """
    raise BadInput("factor must not be 0")
'''


def faults_in(text: str) -> list[str]:
    ((_, function),) = public_functions(ast.parse(text))
    return faults_of(function)


def test_faults_are_found() -> None:
    assert faults_in(GOOD) == []
    assert "describes" in faults_in(GOOD.replace("image, factor :", "factor, image :"))[0]
    assert "describes" in faults_in(GOOD.replace("    **options\n        Ignored.\n", ""))[0]
    assert faults_in(GOOD.replace("Returns\n    -------", "Notes\n    -----")) == ["has no section Returns"]
    assert faults_in(GOOD.replace("Raises\n    ------", "Notes\n    -----")) == ["has no section Raises"]
    assert faults_in(GOOD.replace("raise BadInput", "yield x; raise BadInput")) == ["has no section Yields"]


def test_public_functions_are_found() -> None:
    text = "def a(): pass\ndef _b(): pass\nclass C:\n    def d(self): pass\n    def _e(self): pass\n"
    text += "class _F:\n    def g(self): pass\n"
    assert [name for name, _ in public_functions(ast.parse(text))] == ["a", "C.d"]
