"""Write FITS files atomically, and check the files when they are read again.

A file is written under a temporary name in the same folder and renamed at the end, so that it is never incomplete.
"""

from __future__ import annotations

import io
import os
import tempfile
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from lake_schema.errors import BadInput, Damaged, LakeError
from lake_schema.fits import headers

if TYPE_CHECKING:
    # Imported in the functions that use it, because its import takes half a second.
    from astropy.io import fits

# Largest number of bytes of the data of a file that is read. truesky writes much smaller files, so a header that gives
# more is a mistake or an attack.
MAX_BYTES = 8 << 30
# Number of bytes of a block of a FITS file; headers and data end at a multiple of it.
_BLOCK = 2880


def is_compressed(hdu: Any) -> bool:
    """Return True if a header-data unit is a binary table that contains a compressed image (ZIMAGE)."""
    return bool(hdu.header.get("ZIMAGE", False))


def write_atomically(path: Path, hdus: fits.HDUList) -> None:
    """Add checksums to header-data units and write them to a file, which is replaced in one rename.

    If writing fails, an existing file stays as it is, and OSError or the error of astropy is raised.
    """
    for hdu in hdus:
        _add_checksums(hdu)
    with _open_atomically(path) as stream:
        _write_hdus(stream, hdus, path)


def write_one_by_one(path: Path, hdus: Iterable[Any]) -> None:
    """Write header-data units with checksums to a file, with only one unit in memory at a time.

    `hdus` may be a generator; its first element must be the primary unit. The file is replaced in one rename.
    """
    from astropy.io import fits

    with _open_atomically(path) as stream:
        for number, hdu in enumerate(hdus):
            _add_checksums(hdu)
            single_file = io.BytesIO()
            _write_hdus(single_file, fits.HDUList([hdu] if number == 0 else [fits.PrimaryHDU(), hdu]), path)
            # astropy cannot write an extension without a primary unit. Write the extension after an empty primary unit,
            # which is one block long, and leave this block out.
            stream.write(single_file.getbuffer()[0 if number == 0 else _BLOCK :])


def _add_checksums(hdu: Any) -> None:
    # Replace astropy's default comments, which contain the current time, so that equal input gives equal bytes.
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
        # Give the file the usual permissions; `mkstemp` makes it readable for its owner only.
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def _write_hdus(stream: IO[bytes], hdus: fits.HDUList, path: Path) -> None:
    try:
        hdus.writeto(stream, output_verify="exception")
    except AttributeError as error:
        # After an error of the file system, astropy (up to 8.0) checks the free space, which raises an AttributeError.
        # Its context is the original error.
        raise OSError(f"{path}: {error.__context__}") from None


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


# ------------------------------------- checks of files that truesky wrote


@contextmanager
def errors_as_damaged(path: Path) -> Iterator[None]:
    """Raise Damaged in place of any error or warning of astropy in the body of a `with` statement that reads a file.

    Use it for files that truesky wrote. Exceptions of truesky itself (LakeError) pass unchanged.
    """
    from astropy.utils.exceptions import AstropyUserWarning

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", AstropyUserWarning)
            yield
    except LakeError:
        raise
    except Exception as error:
        raise Damaged(f"{path}: {' '.join(str(error).split())}") from None


def check_headers(path: Path) -> None:
    """Check the headers of a file that truesky wrote; raise Damaged if astropy could not read it in bounded time."""
    with path.open("rb") as stream:
        try:
            headers.check(str(path), stream)
        except BadInput as error:
            raise Damaged(str(error)) from None


@contextmanager
def open_written(path: Path) -> Iterator[fits.HDUList]:
    """Open a FITS file that truesky wrote for the body of a `with` statement, with compressed images as tables.

    Damaged is raised in place of any error of astropy, and if the headers are wrong.
    """
    from astropy.io import fits

    with errors_as_damaged(path):
        check_headers(path)
        with fits.open(path, memmap=False, disable_image_compression=True) as hdus:
            yield hdus


def check_size(path: Path, hdus: fits.HDUList, max_bytes: int) -> None:
    """Check that the data size in the headers of a FITS file exceeds neither the file nor a limit.

    Parameters
    ----------
    path : Path
        The file.
    hdus : HDUList
        Header-data units of the file, whose data need not have been read.
    max_bytes : int
        Largest number of bytes of the data of all units together, as stored or after decompression.

    Raises
    ------
    BadInput
        If the data exceed `max_bytes`.
    Damaged
        If the headers give more data than the file contains, or a negative NAXIS.
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
    """Return the number of bytes of a unit's data according to NAXIS and BITPIX in its header.

    With the prefix "Z", return the number of bytes of the decompressed image, from ZNAXIS and ZBITPIX.
    """
    axes = [int(header[f"{prefix}NAXIS{i}"]) for i in range(1, int(header[f"{prefix}NAXIS"]) + 1)]
    if any(axis < 0 for axis in axes):
        raise Damaged(f"{path}: has a negative NAXIS")
    pixels = 1
    for axis in axes:
        pixels *= axis
    return (pixels if axes else 0) * abs(int(header[f"{prefix}BITPIX"])) // 8
