"""Models of the mission database: parts of an instrument's description that are files (tables), not numbers.

Examples are the layout of the detectors, a throughput curve or a wavefront. A model is identified by its sha256.
"""

from __future__ import annotations

import csv
import hashlib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType

from lake_schema.errors import BadInput, Damaged
from lake_schema.mission.parameter import Identity, check_record, read_records, record_identity

_COLUMNS = ("key", "status", "file", "sha256", "version", "valid_from", "confidence", "source")
_FOLDER = "models"
_SHA256 = re.compile(r"[0-9a-f]{64}")
_FILE = re.compile(r"\w[\w.-]*|[a-z_]+(\.[a-z_]+)*:\w[\w./-]*", re.ASCII)


@dataclass(frozen=True, slots=True)
class Model:
    """A record of the mission database for a model that is a file, such as a throughput curve.

    BadInput is raised if an attribute has a value that is not allowed.

    Attributes
    ----------
    key : str
        Name of the model, such as vis.throughput.
    status : str
        REQ (required), DES (designed), BLT (built), CBE (current best estimate) or SIM (simulated).
    file : str
        Name in the package's folder of models, or `package:path` for a data file of another library.
    sha256 : str
        Checksum of the file, 64 hexadecimal digits.
    version : int
        Version number of the record. If several records have the same status and date, the highest version is chosen.
    valid_from : float or None
        Date (MJD) from which the record is valid, None for always.
    confidence : str
        How far the record can be trusted: published, quoted, derived or assumed.
    source : str
        Reference for the file, not empty.
    """

    key: str
    status: str
    file: str
    sha256: str
    version: int = 1
    valid_from: float | None = None
    confidence: str = "assumed"
    source: str = "assumed"

    def __post_init__(self) -> None:
        where = f"mission model {self.key} ({self.status})"
        check_record(self, where)
        if _SHA256.fullmatch(self.sha256) is None:
            raise BadInput(f"{where}: sha256 = {self.sha256!r} is not 64 hexadecimal digits")
        if _FILE.fullmatch(self.file) is None or ".." in self.file:
            raise BadInput(f"{where}: file {self.file!r} is neither a name nor package:path")

    @property
    def identity(self) -> Identity:
        """Name, status, version and date of the record; no two records may have the same four values."""
        return record_identity(self)


def read(file: Traversable) -> tuple[Model, ...]:
    """Read the records of models in a CSV file.

    Its columns must be key, status, file, sha256, version, valid_from, confidence and source, in this order. BadInput
    is raised for other columns or a wrong line.
    """

    def make_model(row: Mapping[str, str], version: int, valid_from: float | None) -> Model:
        file, sha256, confidence = row["file"], row["sha256"], row["confidence"]
        return Model(row["key"], row["status"], file, sha256, version, valid_from, confidence, row["source"] or "")

    return tuple(read_records(file, _COLUMNS, make_model))


@cache
def read_models() -> tuple[Model, ...]:
    """Return the records of all models (files) in the mission database of the package, with every status and date."""
    return read(files("lake_schema.mission") / "models.csv")


def read_content(model: Model, folder: Path | None = None) -> bytes:
    """Return the bytes of a model's file.

    Parameters
    ----------
    model : Model
        Record of the model: name and sha256 of the file.
    folder : Path, optional
        Folder with copies of model files that an earlier run used, named by their sha256. It is searched if the
        installed file is missing or has another sha256.

    Returns
    -------
    bytes
        Contents of the file, with the sha256 of the record.

    Raises
    ------
    Damaged
        If neither place has a file with this sha256. The message names the model and the sha256 of the installed file.
    """
    data = _read_installed(model.file)
    if data is not None and hashlib.sha256(data).hexdigest() == model.sha256:
        return data
    published_file = folder / model.sha256 if folder is not None else None
    if published_file is not None and published_file.is_file():
        published_data = published_file.read_bytes()
        if hashlib.sha256(published_data).hexdigest() == model.sha256:
            return published_data
    problem = "is missing" if data is None else f"has sha256 {hashlib.sha256(data).hexdigest()}, not {model.sha256}"
    raise Damaged(f"mission model {model.key} ({model.status}): file {model.file} {problem}")


@cache
def _read_installed(file: str) -> bytes | None:
    package, _, path = file.rpartition(":")
    if not package:
        return _read_or_none(files("lake_schema.mission") / _FOLDER / path)
    try:
        # Find the package without importing it, because the import of a library takes longer than reading the file.
        spec = find_spec(package)
    except ModuleNotFoundError:
        return None
    folders = [] if spec is None else spec.submodule_search_locations or []
    contents = (_read_or_none(Path(folder) / path) for folder in folders)
    return next((data for data in contents if data is not None), None)


def _read_or_none(file: Traversable) -> bytes | None:
    try:
        return file.read_bytes()
    except OSError:
        return None


@lru_cache(maxsize=256)
def parse_numbers(data: bytes) -> tuple[tuple[float, ...], ...]:
    """Parse a CSV table of numbers in UTF-8, and return its rows without the line of column names.

    Lines that begin with '#' are comments, and a blank entry is NaN. ValueError is raised for any other text.
    """
    table = list(csv.reader(_lines(data)))
    return tuple(tuple(float(entry) if entry else math.nan for entry in row) for row in table[1:])


@lru_cache(maxsize=256)
def parse_rows(data: bytes) -> tuple[Mapping[str, str], ...]:
    """Parse a CSV table in UTF-8, and return one mapping from column name to text per row.

    Lines that begin with '#' are comments. The mappings cannot be changed, because they are cached.
    """
    return tuple(MappingProxyType(row) for row in csv.DictReader(_lines(data)))


def _lines(data: bytes) -> list[str]:
    return [line for line in data.decode("utf-8").splitlines() if not line.startswith("#")]
