"""Write FITS files atomically: to a temporary file in the same folder, which replaces the file in one rename."""

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

# Headers that promise more data are a mistake or an attack; the largest products are much smaller.
MAX_BYTES = 8 << 30
_BLOCK = 2880


def is_compressed(hdu: Any) -> bool:
    """Return True if a unit is a table with a compressed image."""
    return bool(hdu.header.get("ZIMAGE", False))


def write_atomically(path: Path, hdus: fits.HDUList) -> None:
    """Write units with checksums to a file, which is replaced in one rename."""
    for hdu in hdus:
        _add_checksums(hdu)
    with _open_atomically(path) as stream:
        _write_hdus(stream, hdus, path)


def write_one_by_one(path: Path, hdus: Iterable[Any]) -> None:
    """Write units as `write_atomically` does, but with only one in memory at a time; the first is the primary unit."""
    with _open_atomically(path) as stream:
        for number, hdu in enumerate(hdus):
            _add_checksums(hdu)
            single_file = io.BytesIO()
            _write_hdus(single_file, fits.HDUList([hdu] if number == 0 else [fits.PrimaryHDU(), hdu]), path)
            # An extension is written after an empty primary unit, which is one block long and is removed here.
            stream.write(single_file.getbuffer()[0 if number == 0 else _BLOCK :])


def _add_checksums(hdu: Any) -> None:
    # The default comments of astropy contain the time, so equal input would give different bytes.
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
        # mkstemp makes private files, but products get the usual permissions.
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def _write_hdus(stream: IO[bytes], hdus: fits.HDUList, path: Path) -> None:
    try:
        hdus.writeto(stream, output_verify="exception")
    except AttributeError as error:
        # astropy (up to 8.0) fails in its check of the free space; the original error is the context of this one.
        raise OSError(f"{path}: {error.__context__}") from None


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


# ------------------------------------------------------------------------------------------------ reading


@contextmanager
def errors_as_damaged(path: Path) -> Iterator[None]:
    """Turn all errors of astropy into Damaged, for files that truesky wrote."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", AstropyUserWarning)
            yield
    except LakeError:
        raise
    except Exception as error:
        raise Damaged(f"{path}: {' '.join(str(error).split())}") from None


def check_size(path: Path, hdus: fits.HDUList, max_bytes: int) -> None:
    """Compare the size of the data according to the headers with the size of the file and with a limit.

    Parameters
    ----------
    path : Path
        The file.
    hdus : HDUList
        Its units.
    max_bytes : int
        Largest number of bytes of the data, stored or decompressed.

    Raises
    ------
    BadInput
        If the data exceed `max_bytes`.
    Damaged
        If the file is cut short.
    """
    stored, unpacked = 0, 0
    for hdu in hdus:
        stored_size = _data_size(path, hdu.header, "") + max(int(hdu.header.get("PCOUNT", 0)), 0)
        stored += stored_size
        unpacked += _data_size(path, hdu.header, "Z") if is_compressed(hdu) else stored_size
        if max(stored, unpacked) > max_bytes:
            raise BadInput(f"{path}: holds more than {max_bytes} bytes")
    if stored > path.stat().st_size:
        size = path.stat().st_size
        raise Damaged(f"{path}: is cut short: its headers promise {stored} bytes, but it has {size}")


def _data_size(path: Path, header: Any, prefix: str) -> int:
    """Return the bytes of a unit's data; with the prefix Z, of the compressed image in it."""
    axes = [int(header[f"{prefix}NAXIS{i}"]) for i in range(1, int(header[f"{prefix}NAXIS"]) + 1)]
    if any(axis < 0 for axis in axes):
        raise Damaged(f"{path}: has a negative NAXIS")
    pixels = 1
    for axis in axes:
        pixels *= axis
    return (pixels if axes else 0) * abs(int(header[f"{prefix}BITPIX"])) // 8
