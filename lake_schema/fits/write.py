"""Writing a FITS file whole or not at all: staged beside its place, checked, renamed."""

from __future__ import annotations

import io
import os
import tempfile
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from astropy.io import fits
from astropy.utils.exceptions import AstropyUserWarning

from lake_schema.errors import BadInput, Damaged, LakeError

# A header that promises more than this is a mistake or an attack; the largest product is far below.
MOST_BYTES = 8 << 30
_BLOCK = 2880


def is_packed(unit: Any) -> bool:
    return bool(unit.header.get("ZIMAGE", False))


def write_staged(path: Path, units: fits.HDUList) -> None:
    for unit in units:
        _seal(unit)
    with _staged(path) as stream:
        _write_units(stream, units, path)


def write_one_by_one(path: Path, units: Iterable[Any]) -> None:
    """As `write_staged`, of units that need not be in memory at the same time; the first is the primary one."""
    with _staged(path) as stream:
        for number, unit in enumerate(units):
            _seal(unit)
            alone = io.BytesIO()
            _write_units(alone, fits.HDUList([unit] if number == 0 else [fits.PrimaryHDU(), unit]), path)
            # An extension is written behind a primary unit without any pixels, a block long.
            stream.write(alone.getbuffer()[0 if number == 0 else _BLOCK :])


def _seal(unit: Any) -> None:
    # The comments that astropy would add hold the time of day.
    unit.add_datasum(when="checksum of the data")
    unit.add_checksum(when="checksum of header and data", override_datasum=True)


@contextmanager
def _staged(path: Path) -> Iterator[IO[bytes]]:
    handle, temporary = tempfile.mkstemp(suffix=".part", prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        # mkstemp makes files private; a product is as readable as anything else that is written here.
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def _write_units(stream: IO[bytes], units: fits.HDUList, path: Path) -> None:
    try:
        units.writeto(stream, output_verify="exception")
    except AttributeError as error:
        # astropy (to 8.0) trips over its own check of the free space; what it was called for is the context.
        raise OSError(f"{path}: {error.__context__}") from None


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


# ------------------------------------------------------------------------------------------------ reading


@contextmanager
def refusing(path: Path) -> Iterator[None]:
    """Whatever astropy trips over in a file of ours is damage of the file."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", AstropyUserWarning)
            yield
    except LakeError:
        raise
    except Exception as error:
        raise Damaged(f"{path}: {' '.join(str(error).split())}") from None


def check_size(path: Path, units: fits.HDUList, most_bytes: int) -> None:
    stored, unpacked = 0, 0
    for unit in units:
        here = _promised(path, unit.header, "") + max(int(unit.header.get("PCOUNT", 0)), 0)
        stored += here
        unpacked += _promised(path, unit.header, "Z") if is_packed(unit) else here
        if max(stored, unpacked) > most_bytes:
            raise BadInput(f"{path}: holds more than {most_bytes} bytes")
    if stored > path.stat().st_size:
        raise Damaged(f"{path}: is cut short, {stored} bytes promised, {path.stat().st_size} there")


def _promised(path: Path, header: Any, prefix: str) -> int:
    """Bytes of a unit's data, or with the prefix Z of what is packed in it."""
    axes = [int(header[f"{prefix}NAXIS{i}"]) for i in range(1, int(header[f"{prefix}NAXIS"]) + 1)]
    if any(axis < 0 for axis in axes):
        raise Damaged(f"{path}: a negative NAXIS")
    pixels = 1
    for axis in axes:
        pixels *= axis
    return (pixels if axes else 0) * abs(int(header[f"{prefix}BITPIX"])) // 8
