"""Check that published numbers do not use BLAS or LAPACK, whose sums depend on threads and processor.

The validation and the reduction measure what is published; their results are the same up to rounding.
"""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MEASURE = [ROOT / "truesky" / folder for folder in ("reduction", "validation")]
SOURCES = sorted(
    path
    for folder in ("lake_schema", "truesky")
    for path in (ROOT / folder).rglob("*.py")
    if not any(path.is_relative_to(folder) for folder in MEASURE)
)
# Functions of numpy, scipy and galsim that use BLAS or LAPACK.
NAMES = {
    "dot", "vdot", "matmul", "matvec", "vecmat", "tensordot", "linalg", "convolve", "correlate", "cov", "corrcoef",
    "polyfit", "leggauss", "hermgauss", "laggauss", "roots_legendre", "lstsq", "pinv", "eigh", "svd", "cholesky",
    "Zernike",
}  # fmt: skip


# A file with none of these contains no such product, so it is not parsed.
WORDS = re.compile(rf"(?m){'|'.join(NAMES)}|\S *@|^ +@ |optimize|parallel")


def faults(tree):
    for node in ast.walk(tree):
        operator = isinstance(node, ast.BinOp | ast.AugAssign) and isinstance(node.op, ast.MatMult)
        named = isinstance(node, ast.Attribute) and node.attr in NAMES and ast.unparse(node.value) != "matrices"
        imported = isinstance(node, ast.ImportFrom) and bool(
            {*(node.module or "").split("."), *(n.name for n in node.names)} & NAMES
        )
        optimised = isinstance(node, ast.Call) and any(k.arg == "optimize" for k in node.keywords)
        parallel = isinstance(node, ast.keyword) and node.arg == "parallel"
        if operator or named or imported or optimised or parallel:
            yield getattr(node, "lineno", 0)


@pytest.mark.parametrize(
    "text",
    ["a @ b", "a @= b", "(a\n    @ b)", "(a @\n    b)", "np.matmul(a, b)", "np.dot(a, b)", "a.dot(b)",
     "np.linalg.inv(a)", "from numpy.linalg import inv", "np.einsum('i,i', a, b, optimize=True)",
     "from scipy.linalg import svd", "numba.njit(parallel=True)", "galsim.zernike.Zernike(nm)(x, y)"],
)  # fmt: skip
def test_forbidden_products_are_detected(text):
    assert WORDS.search(text)
    assert list(faults(ast.parse(text)))


def test_only_reproducible_products_are_used():
    texts = {path: text for path in SOURCES if WORDS.search(text := path.read_text())}
    found = [f"{p.relative_to(ROOT)}:{line}" for p, text in texts.items() for line in faults(ast.parse(text))]
    assert found == [], "truesky/numerics/matrices.py has products and solutions whose last bit is the same everywhere"
