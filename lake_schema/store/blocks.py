"""Read files with checksums: every byte is compared with the file's manifest entry before it is returned.

The manifest entry of a file contains its size, its sha256, and its blocks, each with a checksum. The checksum of a
block is its CRC-32. It detects every single flipped bit and every burst of up to 32 bits, and misses one in 4e9 other
changes. It takes less time than the checksums of Parquet's pages. Unlike them, it covers page headers and detects
exchanged blocks. `verify --deep` compares the sha256 of whole files.
"""

from __future__ import annotations

import base64
import hashlib
import io
import os
import zlib
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lake_schema.errors import Damaged
from lake_schema.store.object_storage.s3 import Folder, ObjectPath
from lake_schema.store.plan import Json

# Pieces below the minimum share a block; pieces above the maximum are divided.
_MIN_BYTES, _MAX_BYTES = 16 << 10, 8 << 20
_RECORD = np.dtype([("bytes", "<u4"), ("crc", "<u4")])


def file_checksums(path: Path, cuts: Sequence[int]) -> dict[str, Any]:
    """Return the size and the checksums that the manifest records for a file of which parts are read.

    Parameters
    ----------
    path : Path
        The file.
    cuts : sequence of int
        Offsets in bytes, ascending, at which reading may start. The last one is the start of the footer, which every
        reader needs.

    Returns
    -------
    dict
        ``bytes``: size. ``sha256``: hexadecimal. ``blocks``: base64 of the size and the CRC-32 of each block, as 4-byte
        little-endian integers.
    """
    file_hash, block_checksums, size = hashlib.sha256(), [], path.stat().st_size
    ends = _block_ends(cuts, size)
    with path.open("rb") as stream:
        for start, end in zip([0, *ends[:-1]], ends, strict=True):
            data = stream.read(end - start)
            file_hash.update(data)
            block_checksums.append((len(data), zlib.crc32(data)))
    blocks = base64.b64encode(np.array(block_checksums, _RECORD).tobytes()).decode()
    return {"bytes": size, "sha256": file_hash.hexdigest(), "blocks": blocks}


def crc32(path: Path) -> int:
    """Return the CRC-32 of a file's contents, which are read in pieces."""
    checksum = 0
    with path.open("rb") as stream:
        while data := stream.read(_MAX_BYTES):
            checksum = zlib.crc32(data, checksum)
    return checksum


def _block_ends(cuts: Sequence[int], size: int) -> list[int]:
    ends, last = [], 0
    for cut in [*cuts, size]:
        if cut - last >= _MIN_BYTES or cut in (cuts[-1], size):
            ends += [*range(last + _MAX_BYTES, cut, _MAX_BYTES), cut]
            last = cut
    return ends


def decode_blocks(entry: Json) -> list[tuple[int, int]]:
    """Return (end offset, CRC-32) of each block of a manifest entry.

    Raises
    ------
    KeyError, TypeError, ValueError
        If the entry has no valid blocks for its size.
    """
    blocks = np.frombuffer(base64.b64decode(entry["blocks"], validate=True), _RECORD)
    ends = np.cumsum(blocks["bytes"], dtype=np.int64)
    if not ends.size or ends[-1] != entry["bytes"]:
        raise ValueError("the blocks do not add up to the size of the file")
    return list(zip(ends.tolist(), blocks["crc"].tolist(), strict=True))


class VerifiedFile(io.RawIOBase):
    """A file of a lake that is open for reading; each block is verified when it is first read.

    Parameters
    ----------
    path : Path or ObjectPath
        The file.
    entry : mapping
        Its entry in the manifest.

    Attributes
    ----------
    fault : str
        Reason why the file was refused, "" if it was not. Use it if another library hides the exception.

    Raises
    ------
    Damaged
        By methods that read, if the contents differ from the manifest. The message names the file.
    """

    fault = ""

    def __init__(self, path: Folder, entry: Json) -> None:
        super().__init__()
        self.path, self._entry = path, entry
        blocks = decode_blocks(entry)
        self._ends, self._checksums = [end for end, _ in blocks], [crc for _, crc in blocks]
        self._verified: set[int] = set()
        self._position = 0
        # The opened object on object storage; files on disc are opened for each read.
        self._object: Any = None

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: int(self._entry["bytes"])}[whence]
        self._position = max(start + offset, 0)
        return self._position

    def tell(self) -> int:
        return self._position

    def read(self, size: int | None = -1) -> bytes:
        """Return up to `size` bytes from the current position, after verifying their blocks."""
        first, length = self._position, int(self._entry["bytes"])
        last = length if size is None or size < 0 else min(first + size, length)
        if last <= first:
            return b""
        numbers = range(bisect_right(self._ends, first), bisect_left(self._ends, last) + 1)
        unverified = [number for number in numbers if number not in self._verified]
        # Whole blocks are read once, so that the verified bytes are the bytes that are returned.
        start, end = (
            (min(first, self._block_start(unverified[0])), max(last, self._ends[unverified[-1]]))
            if unverified
            else (first, last)
        )
        data = self._read_range(start, end)
        for number in unverified:
            self._verify_block(number, memoryview(data)[self._block_start(number) - start : self._ends[number] - start])
        self._position = last
        return data[first - start : last - start]

    def forget(self) -> None:
        """Verify every block again when it is next read; call this if a file stays open between queries."""
        self._verified.clear()
        self._object = None

    def _block_start(self, number: int) -> int:
        return self._ends[number - 1] if number else 0

    def _verify_block(self, number: int, block: memoryview) -> None:
        if zlib.crc32(block) != self._checksums[number]:
            place = f"from {self._block_start(number)} to {self._ends[number]}"
            raise self._damage_error(f"has other bytes {place} than the manifest says")
        self._verified.add(number)

    def _damage_error(self, why: str) -> Damaged:
        self.fault = f"{self.path} {why}"
        return Damaged(self.fault)

    def _read_range(self, first: int, last: int) -> bytes:
        """Read a range of bytes. The file is opened for each call, because a process can only keep some files open."""
        if isinstance(self.path, ObjectPath):
            return self._read_object_range(self.path, first, last)
        try:
            descriptor = os.open(self.path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                pieces, position = [], first
                while position < last and (piece := os.pread(descriptor, last - position, position)):
                    pieces.append(piece)
                    position += len(piece)
            finally:
                os.close(descriptor)
        except FileNotFoundError:
            # The whole version has been removed since.
            raise self._damage_error("is missing") from None
        except OSError as error:
            raise self._damage_error(f"cannot be read: {error.strerror}") from None
        if position < last:
            raise self._damage_error(f"has {position} bytes, the manifest says {self._entry['bytes']}")
        return pieces[0] if len(pieces) == 1 else b"".join(pieces)

    def _read_object_range(self, place: ObjectPath, first: int, last: int) -> bytes:
        """Read a range of bytes of an object; the object is opened once, and again after `forget`."""
        try:
            if self._object is None:
                self._object = place.open()
            if (size := self._object.size()) != self._entry["bytes"]:
                raise self._damage_error(f"has {size} bytes, the manifest says {self._entry['bytes']}")
            data: bytes = self._object.read_at(last - first, first)
        except FileNotFoundError:
            raise self._damage_error("is missing") from None
        except OSError as error:
            raise self._damage_error(f"cannot be read: {error}") from None
        if len(data) < last - first:
            raise self._damage_error(f"has {first + len(data)} bytes, the manifest says {self._entry['bytes']}")
        return data
