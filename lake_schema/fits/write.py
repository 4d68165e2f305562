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
MAX_BYTES = 8 << 30
_BLOCK = 2880


def is_compressed(hdu: Any) -> bool:
    return bool(hdu.header.get("ZIMAGE", False))


def write_atomically(path: Path, hdus: fits.HDUList) -> None:
    for hdu in hdus:
        _add_checksums(hdu)
    with _open_atomically(path) as stream:
        _write_hdus(stream, hdus, path)


def write_one_by_one(path: Path, hdus: Iterable[Any]) -> None:
    """As `write_staged`, of units that need not be in memory at the same time; the first is the primary one."""
    with _open_atomically(path) as stream:
        for number, hdu in enumerate(hdus):
            _add_checksums(hdu)
            single_file = io.BytesIO()
            _write_hdus(single_file, fits.HDUList([hdu] if number == 0 else [fits.PrimaryHDU(), hdu]), path)
            # An extension is written behind a primary unit without any pixels, a block long.
            stream.write(single_file.getbuffer()[0 if number == 0 else _BLOCK :])


def _add_checksums(hdu: Any) -> None:
    # The comments that astropy would add hold the time of day.
    hdu.add_datasum(when="checksum of the data")
    hdu.add_checksum(when="checksum of header and data", override_datasum=True)


@contextmanager
def _open_atomically(path: Path) -> Iterator[IO[bytes]]:
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


def _write_hdus(stream: IO[bytes], hdus: fits.HDUList, path: Path) -> None:
    try:
        hdus.writeto(stream, output_verify="exception")
    except AttributeError as error:
        # astropy (to 8.0) trips over its own check of the free space; what it was called for is the context.
        raise OSError(f"{path}: {error.__context__}") from None


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


# ------------------------------------------------------------------------------------------------ reading


@contextmanager
def errors_as_damaged(path: Path) -> Iterator[None]:
    """Whatever astropy trips over in a file of ours is damage of the file."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", AstropyUserWarning)
            yield
    except LakeError:
        raise
    except Exception as error:
        raise Damaged(f"{path}: {' '.join(str(error).split())}") from None


def check_size(path: Path, hdus: fits.HDUList, max_bytes: int) -> None:
    stored, unpacked = 0, 0
    for hdu in hdus:
        stored_size = _data_size(path, hdu.header, "") + max(int(hdu.header.get("PCOUNT", 0)), 0)
        stored += stored_size
        unpacked += _data_size(path, hdu.header, "Z") if is_compressed(hdu) else stored_size
        if max(stored, unpacked) > max_bytes:
            raise BadInput(f"{path}: holds more than {max_bytes} bytes")
    if stored > path.stat().st_size:
        raise Damaged(f"{path}: is cut short, {stored} bytes promised, {path.stat().st_size} there")


def _data_size(path: Path, header: Any, prefix: str) -> int:
    """Bytes of a unit's data, or with the prefix Z of what is packed in it."""
    axes = [int(header[f"{prefix}NAXIS{i}"]) for i in range(1, int(header[f"{prefix}NAXIS"]) + 1)]
    if any(axis < 0 for axis in axes):
        raise Damaged(f"{path}: a negative NAXIS")
    pixels = 1
    for axis in axes:
        pixels *= axis
    return (pixels if axes else 0) * abs(int(header[f"{prefix}BITPIX"])) // 8
