"""Read files block by block, and compare each block with a recorded checksum before its bytes are returned.

The manifest (list of files) of a table's version records the size and the sha256 of each file. For a Parquet file it
also records the sizes and the CRC-32 checksums of its blocks (consecutive ranges of bytes). A CRC-32 detects every
single flipped bit and every burst of up to 32 bits, and misses one in 4e9 other changes. It takes less time than the
checksums that Parquet can store per page. Unlike the page checksums, it covers page headers and detects exchanged
blocks. The sha256 is compared only when a whole file is read, such as an image or a file that is reused or copied. The
command `truesky verify --deep` compares it for every file.
"""

from __future__ import annotations

import base64
import hashlib
import io
import os
import struct
import zlib
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lake_schema.errors import Damaged
from lake_schema.store.object_storage.s3 import Folder, ObjectPath
from lake_schema.store.plan import Json

# Smallest size in bytes of a block, a range of a file with one checksum. A smaller range is joined with the next one.
# Only the last part of a divided range, the last block before the footer, and the footer may be smaller.
_MIN_BYTES = 16 << 10
# Largest size in bytes of a block, a range of a file with one checksum. A larger range is divided.
_MAX_BYTES = 8 << 20
# Form of the record of a block in the manifest: its size in bytes and its CRC-32.
_RECORD = struct.Struct("<II")


def file_checksums(path: Path, cuts: Sequence[int]) -> dict[str, Any]:
    """Return the size and the checksums that the manifest records for a file that is later read in parts.

    Parameters
    ----------
    path : Path
        The file.
    cuts : sequence of int
        Offsets in bytes, ascending, at which reading may start, at least one. The last one is the start of the footer,
        which always begins a new block, because every reader needs it.

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
    blocks = base64.b64encode(b"".join(_RECORD.pack(*block) for block in block_checksums)).decode()
    return {"bytes": size, "sha256": file_hash.hexdigest(), "blocks": blocks}


def crc32(path: Path) -> int:
    """Return the CRC-32 of a file's contents, 0 for an empty file. The file is read in pieces to save memory."""
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
    """Decode the list of blocks in a file's manifest entry, and return the end offset in bytes and CRC-32 of each.

    Raises
    ------
    KeyError, TypeError, ValueError
        If the entry has no key "blocks", its value is not valid base64, it lists no blocks, or their sizes do not add
        up to the size of the file.
    """
    data = base64.b64decode(entry["blocks"], validate=True)
    if len(data) % _RECORD.size:
        raise ValueError("the last record of a block is cut short")
    # For the few blocks of a file, the standard library is faster than numpy. A manifest can have 1e5 files.
    end, blocks = 0, []
    for size, crc in _RECORD.iter_unpack(data):
        end += size
        blocks.append((end, crc))
    if not blocks or end != entry["bytes"]:
        raise ValueError("the blocks do not add up to the size of the file")
    return blocks


class VerifiedFile(io.RawIOBase):
    """A file of a lake that is open for reading; each block of its bytes is verified when it is first read.

    Parameters
    ----------
    path : Path or ObjectPath
        The file. It is opened at the first read.
    entry : mapping
        Entry of the file in the manifest: its size, and the sizes and CRC-32 checksums of its blocks.

    Attributes
    ----------
    fault : str
        Message of the last Damaged that a method raised, "" before the first one. Libraries that read the file may
        replace the exception by another one without this message.

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
        # Opened object, or None before the first read. It is used on object storage only; a file on disc is opened
        # again for each read.
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
        """Return up to `size` bytes from the current position, after verifying the blocks that contain them.

        All remaining bytes are returned if `size` is None or negative, b"" at the end of the file. Damaged is raised
        if a block differs from its checksum or the file is missing.
        """
        first, length = self._position, int(self._entry["bytes"])
        last = length if size is None or size < 0 else min(first + size, length)
        if last <= first:
            return b""
        numbers = range(bisect_right(self._ends, first), bisect_left(self._ends, last) + 1)
        unverified = [number for number in numbers if number not in self._verified]
        # Read unverified blocks completely and return bytes of this copy. A second read of the file after the check
        # could return bytes that have changed meanwhile.
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
        """Mark all blocks as unverified, so that the next read compares them with their checksums again.

        Call this between queries if the file stays open for a long time, because it may change on disc meanwhile.
        """
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
        """Return the bytes from offset `first` up to but not including `last`; raise Damaged if they cannot be read.

        The file is opened and closed in each call, because the number of open files of a process is limited.
        """
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
            # The version to which the file belongs may have been removed after it was opened for reading.
            raise self._damage_error("is missing") from None
        except OSError as error:
            raise self._damage_error(f"cannot be read: {error.strerror}") from None
        if position < last:
            raise self._damage_error(f"has {position} bytes, the manifest says {self._entry['bytes']}")
        return pieces[0] if len(pieces) == 1 else b"".join(pieces)

    def _read_object_range(self, place: ObjectPath, first: int, last: int) -> bytes:
        """Return bytes `first` to `last` (exclusive) of an object on object storage; raise Damaged if that fails.

        The object is opened in the first call, and again in the first call after `forget`.
        """
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
