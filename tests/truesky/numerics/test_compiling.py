"""Compiled functions give the same bytes, whether a process compiles them or finds them in the cache."""

import ast
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import truesky
from truesky.numerics import cache, compiling, machine_code

# A kernel whose inner function sums in any order.
SCRIPT = """
import hashlib
import numpy as np
from truesky.render.effects.readout.traps import Sweeps, Traps, shift_charge
frame = np.random.default_rng(1).poisson(100, (2000, 300)).astype(float)
moved, held = shift_charge(frame, Traps((0.02, 0.03, 0.95), (0.8, 3.5, 20.0), 2e5, 0.0, 0.58), Sweeps(1, 2), -2)
print(hashlib.sha256(moved.tobytes()).hexdigest(), held.hex())
"""


def test_machine_code_is_kept_in_the_cache(tmp_path):
    """Next to the sources its key would be the function's file only, not the files that are compiled into it."""
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    code = "from truesky.numerics import cache, machine_code; import numba; "
    code += "print(cache.machine_code_dir(), numba.config.CACHE_DIR)"
    command = [sys.executable, "-c", code]
    environment["TRUESKY_CACHE"] = str(tmp_path)
    wanted, used = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.split()
    assert used == wanted
    assert Path(used).is_relative_to(tmp_path)


@pytest.mark.nightly
def test_compiled_here_or_found_in_the_cache(tmp_path):
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    environment["TRUESKY_CACHE"] = str(tmp_path)
    command = [sys.executable, "-c", SCRIPT]
    first, second = (
        subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout for _ in range(2)
    )
    assert list(tmp_path.glob("numba/**/*.nbc"))
    assert first == second
    assert len(first.split()) == 2


def test_code_of_the_package_is_named_by_its_module():
    """Another clone has the same names; a user's own functions go where numba puts them."""
    sources = Path(truesky.__file__).parent
    locate = machine_code.PackageCacheLocator.from_function
    locator = locate(_plus_one, str(sources / "render" / "drawing" / "stamps.py"))
    assert locator.get_cache_path() == str(cache.machine_code_dir() / "render.drawing")
    assert locate(_plus_one, __file__) is None
    compiled = compiling.exact_jit(_plus_one)
    assert compiled(1) == 2
    assert "truesky" not in machine_code.numba.config.CACHE_LOCATOR_CLASSES


def test_numba_is_imported_by_the_first_call(tmp_path):
    """Compiled functions call each other with the results of Python, and keep their names."""
    (tmp_path / "functions.py").write_text("""
import sys
from truesky.numerics import compiling, compiled_products

@compiling.exact_jit
def twice(x):
    return 2 * x

@compiling.jit
def twice_and_one(x):
    return twice(x) + 1

print("numba" in sys.modules, compiled_products.multiply_rows.__name__, compiled_products.multiply_rows.__module__)
print(twice_and_one(20), twice_and_one(x=0.5), "numba" in sys.modules)
""")
    command = [sys.executable, str(tmp_path / "functions.py")]
    environment = {**os.environ, "PYTHONPATH": str(Path(truesky.__file__).parents[1])}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [
        "False", "multiply_rows", "truesky.numerics.compiled_products", "41", "2.0", "True"
    ]  # fmt: skip


def test_several_threads_share_one_compiled_function():
    function = compiling.exact_jit(_plus_one)
    with ThreadPoolExecutor(8) as pool:
        loaded = list(pool.map(lambda _: function.load(), range(64)))
    assert len({id(one) for one in loaded}) == 1


def _plus_one(number):
    return number + 1


@pytest.mark.nightly
def test_two_copies_of_the_package_share_their_machine_code(tmp_path):
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    environment["TRUESKY_CACHE"] = str(tmp_path / "cache")
    sources, stored, told = Path(truesky.__file__).parents[1], [], []
    for name in ("one", "two"):
        for package in ("truesky", "lake_schema"):
            shutil.copytree(sources / package, tmp_path / name / package)
        command = [sys.executable, "-c", SCRIPT]
        environment["PYTHONPATH"] = str(tmp_path / name)
        done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=True)
        told.append(done.stdout)
        stored.append({path: path.stat().st_mtime_ns for path in tmp_path.glob("cache/numba/**/*.nb?")})
    assert stored[0] == stored[1] != {}
    assert told[0] == told[1]


def test_machine_code_is_of_the_sources_as_they_are(tmp_path):
    """Functions are also compiled again if functions that are compiled into them change."""
    assert cache.machine_code_dir().name == cache.sources_key()[:16]
    (tmp_path / "effects").mkdir()
    inner, plain = tmp_path / "effects" / "pixel_random.py", tmp_path / "units.py"
    inner.write_text("from truesky.numerics.compiling import jit\n")
    plain.write_text("")
    first = cache.sources_key(tmp_path)
    plain.write_text("MILE = 1609.344\n")
    assert cache.sources_key(tmp_path) == first
    inner.write_text("from truesky.numerics.compiling import jit\n\n")
    assert cache.sources_key(tmp_path) != first


def test_constants_of_kernels_are_in_the_key_of_the_machine_code():
    """A constant of another module is compiled into a kernel, so its file must be part of the key."""
    root, checked = Path(truesky.__file__).parents[1], 0
    for path in sorted((root / "truesky").rglob("*.py")):
        source = path.read_text()
        if "from truesky.numerics.compiling import" not in source:
            continue
        tree = ast.parse(source)
        imported = dict(_imports(tree))
        for name in sorted(_names_in_kernels(tree) & imported.keys()):
            folder = root.joinpath(*imported[name].split("."))
            file = folder / f"{name}.py" if folder.is_dir() else folder.with_suffix(".py")
            assert "truesky.numerics.compiling" in file.read_text(), f"{path}: {name} of {file}"
            checked += 1
    assert checked > 5


def _imports(tree):
    """Yield the name of each import from our packages, and its package or module."""
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] in ("truesky", "lake_schema"):
            yield from ((alias.name, node.module) for alias in node.names)


def _names_in_kernels(tree):
    """Return the names that compiled functions use, and the names in module-level assignments of such names."""
    kernels = [
        node
        for node in tree.body
        if isinstance(node, ast.FunctionDef)
        and any(isinstance(d, ast.Name) and d.id in ("jit", "exact_jit") for d in node.decorator_list)
    ]
    used = set().union(*(_global_names(kernel) for kernel in kernels))
    assigned = {
        target.id: {n.id for n in ast.walk(node.value) if isinstance(n, ast.Name)}
        for node in tree.body
        if isinstance(node, ast.Assign)
        for whole in node.targets
        for target in ast.walk(whole)
        if isinstance(target, ast.Name)
    }
    while more := {n for name in used for n in assigned.get(name, ())} - used:
        used |= more
    return used


def _global_names(kernel):
    names = [node for part in kernel.body for node in ast.walk(part) if isinstance(node, ast.Name)]
    local = {node.id for node in names if isinstance(node.ctx, ast.Store)} | {a.arg for a in kernel.args.args}
    return {node.id for node in names} - local
