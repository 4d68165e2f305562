"""Push a lake to object storage: truesky push LAKE s3://BUCKET/PREFIX [--endpoint-url URL] [--only TABLE ...].

A lake is a folder of tables, each with immutable versions. Files of versions never change, so objects that exist are
not sent again, and a run that was killed can be continued. After all objects exist and their checksums have been
compared, one conditional put replaces the object `current`, which lists the published versions. Readers therefore see
either the old or the new list. If two pushes run at the same time, the one that ends later fails. Nothing is removed.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lake_schema.errors import BadInput, Damaged, Superseded
from lake_schema.store import layout, manifest, request_links
from lake_schema.store.object_storage import s3
from lake_schema.store.object_storage.s3 import CURRENT, MANIFEST, Address, PublishedVersions
from lake_schema.store.provenance import file_sha256

# Size in bytes of the largest file that is sent in one put (S3 allows 5 GB). Larger files are sent in parts.
_MAX_PUT_BYTES = 1 << 30
# Size in bytes of a part of a larger file. S3 stores a checksum of each part.
_PART_BYTES = 256 << 20
# Number of bytes of an object that are read at a time.
_CHUNK_BYTES = 8 << 20
# Default number of objects that are sent at the same time.
THREADS = 16
# Error codes of services if the condition of a put is not met, or if another put of the same object is in progress.
_REFUSED_CODES = {"PreconditionFailed", "ConditionalRequestConflict", "412", "409"}
# Error codes of services if an object does not exist.
_ABSENT_CODES = {"NoSuchKey", "404", "NotFound"}


@dataclass(frozen=True, slots=True)
class PushReport:
    """Result of pushing one version of a table to object storage.

    Attributes
    ----------
    table : str
        Name of the table.
    key : str
        Key of the version, 16 hexadecimal digits.
    objects : int
        Number of objects (files) of the version.
    size : int
        Total size of the objects in bytes.
    sent : int
        Number of objects that were sent, because they did not exist with the same contents.
    sent_size : int
        Total size of the objects that were sent, in bytes.
    """

    table: str
    key: str
    objects: int
    size: int
    sent: int
    sent_size: int


@dataclass(frozen=True, slots=True)
class _Object:
    """A file of a version: its path, the name of its object in the lake, its size in bytes and its sha256."""

    path: Path
    name: str
    size: int
    sha256: str


class Bucket:
    """Objects of one lake on object storage, accessed through boto3.

    The constructor and all methods raise BadInput if the service does not answer, the bucket does not exist, or access
    is denied. The constructor also raises it if boto3 is not installed.

    Parameters
    ----------
    address : Address
        Address of the lake.
    """

    def __init__(self, address: Address) -> None:
        try:
            import boto3
            from botocore.config import Config
        except ImportError:
            raise BadInput("push requires the package boto3: pip install 'truesky[s3]', or boto3 alone") from None
        self.address = address
        config = Config(
            connect_timeout=s3.CONNECT_TIMEOUT,
            read_timeout=s3.REQUEST_TIMEOUT,
            retries={"mode": "standard", "total_max_attempts": s3.MAX_ATTEMPTS},
            max_pool_connections=2 * THREADS,
        )
        options: dict[str, Any] = {"endpoint_url": address.service} if address.service else {}
        with self._errors_as_bad_input():
            # boto3 needs a region. Any default works: Amazon redirects to the right region, and other services have
            # only one.
            session = boto3.session.Session()
            region = address.region or session.region_name or "us-east-1"
            self._client = session.client("s3", region_name=region, config=config, **options)
            self._client.head_bucket(Bucket=address.bucket)

    @contextmanager
    def _errors_as_bad_input(self) -> Iterator[None]:
        from botocore.exceptions import BotoCoreError, ClientError

        try:
            yield
        except ClientError as error:
            code = error.response["Error"].get("Code", "")
            if code in ("404", "NoSuchBucket"):
                raise BadInput(f"{self.address}: there is no bucket {self.address.bucket}") from None
            raise BadInput(f"{self.address}: {error}") from None
        except (BotoCoreError, ValueError) as error:
            raise BadInput(f"{self.address}: {error}") from None

    def read_published(self) -> tuple[PublishedVersions, str | None]:
        """Read the object `current`, and return the versions that it lists and its ETag.

        If the object does not exist, return an empty list of versions and None.

        Raises
        ------
        Damaged
            If the object is not a valid list of versions.
        """
        if (current := self._read_object(CURRENT)) is None:
            return PublishedVersions({}, {}), None
        return s3.parse_published(current[0], f"{self.address.plain}/{CURRENT}"), current[1]

    def _read_object(self, name: str) -> tuple[bytes, str] | None:
        with self._errors_as_bad_input():
            try:
                response = self._client.get_object(Bucket=self.address.bucket, Key=self.address.key(name))
                return response["Body"].read(), response["ETag"]
            except self._client.exceptions.NoSuchKey:
                return None

    def has_object(self, item: _Object) -> bool:
        """Return True if the object of a file exists and has the same contents.

        The checksum that the service stores is compared. If the service stores no checksum, the object is read. An
        object that another program sent in parts of another size has another checksum, so the result is False.
        """
        from botocore.exceptions import ClientError

        object_key = self.address.key(item.name)
        with self._errors_as_bad_input():
            try:
                response = self._client.head_object(Bucket=self.address.bucket, Key=object_key, ChecksumMode="ENABLED")
            except ClientError as error:
                if error.response["Error"].get("Code") in _ABSENT_CODES:
                    return False
                raise
            if response["ContentLength"] != item.size:
                return False
            if checksum := response.get("ChecksumSHA256"):
                # The checksum of an object that was sent in parts is a hash of the hashes of its parts. Amazon appends
                # "-" and the number of parts to it; other services do so only in the ETag.
                checksum_value, in_parts, _ = checksum.partition("-")
                in_parts = in_parts or "-" in response["ETag"]
                return bool(checksum_value == (_multipart_checksum(item) if in_parts else _base64(item.sha256)))
            # Read the whole object, because the service stores no sha256 of it. Another program may have sent it.
            file_hash = hashlib.sha256()
            body = self._client.get_object(Bucket=self.address.bucket, Key=object_key)["Body"]
            for piece in body.iter_chunks(_CHUNK_BYTES):
                file_hash.update(piece)
            return file_hash.hexdigest() == item.sha256

    def send(self, item: _Object) -> None:
        """Send a file to its object, which is replaced, and let the service compare the sha256 of the data."""
        target = {"Bucket": self.address.bucket, "Key": self.address.key(item.name)}
        with self._errors_as_bad_input():
            if item.size <= _MAX_PUT_BYTES:
                with item.path.open("rb") as stream:
                    checksums = {"ChecksumAlgorithm": "SHA256", "ChecksumSHA256": _base64(item.sha256)}
                    self._client.put_object(Body=stream, **target, **checksums)
                return
            from boto3.exceptions import S3UploadFailedError
            from boto3.s3.transfer import TransferConfig

            parts = TransferConfig(
                multipart_threshold=_MAX_PUT_BYTES, multipart_chunksize=_PART_BYTES, use_threads=False
            )
            try:
                self._client.upload_file(
                    str(item.path), *target.values(), ExtraArgs={"ChecksumAlgorithm": "SHA256"}, Config=parts
                )
            except S3UploadFailedError as error:
                raise BadInput(f"{self.address}: {error}") from None

    def supports_conditions(self, name: str) -> bool:
        """Return True if the service refuses a put whose condition ("only if the object does not exist") is not met.

        The test puts the object `name` with its existing contents, so it changes nothing in any case.

        Raises
        ------
        Damaged
            If the object does not exist.
        """
        if (existing := self._read_object(name)) is None:
            raise Damaged(f"{self.address.plain}/{name} is missing")
        return not self._put_if(name, existing[0], {"IfNoneMatch": "*"})

    def replace_current(self, published: PublishedVersions, tag: str | None) -> bool:
        """Replace the object `current` by a new list of versions, unless another process has changed it.

        The condition is that its ETag is still `tag`, or that it does not exist if `tag` is None. Return True if the
        object has the new contents.
        """
        condition = {"IfNoneMatch": "*"} if tag is None else {"IfMatch": tag}
        if self._put_if(CURRENT, published.to_bytes(), condition):
            return True
        # Compare the contents: if the answer to a successful put was lost, boto3 has repeated the put, and the second
        # one was refused because the first one had changed the ETag.
        current = self._read_object(CURRENT)
        return current is not None and current[0] == published.to_bytes()

    def _put_if(self, name: str, data: bytes, condition: dict[str, str]) -> bool:
        from botocore.exceptions import ClientError

        with self._errors_as_bad_input():
            try:
                self._client.put_object(Bucket=self.address.bucket, Key=self.address.key(name), Body=data, **condition)
            except ClientError as error:
                if error.response["Error"].get("Code") in _REFUSED_CODES | _ABSENT_CODES:
                    return False
                raise
        return True


def _base64(sha256: str) -> str:
    return base64.b64encode(bytes.fromhex(sha256)).decode()


def _multipart_checksum(item: _Object) -> str:
    """Return the checksum of a file that is sent in parts, as S3 computes it: base64 of a sha256.

    It is the sha256 of the concatenated sha256 of all parts, each of `_PART_BYTES` bytes except the last one.
    """
    combined_hash = hashlib.sha256()
    with item.path.open("rb") as stream:
        while part := stream.read(_PART_BYTES):
            combined_hash.update(hashlib.sha256(part).digest())
    return base64.b64encode(combined_hash.digest()).decode()


# ------------------------------------- pushing all versions of a lake


def push(root: Path, address: Address, only: Sequence[str] = (), threads: int = THREADS) -> Iterator[PushReport]:
    """Send the published versions of a lake to object storage, and yield a report after each version.

    At the end, the object `current` is replaced, which lists the published versions. Iterate to the end: otherwise
    nothing is published.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    address : Address
        Address of the lake on object storage.
    only : sequence of str, optional
        Names of the tables to push; other tables on object storage stay. By default, all tables are pushed, and
        afterwards exactly the versions of this lake are published.
    threads : int, optional
        Number of objects that are sent at the same time.

    Yields
    ------
    PushReport
        Report of a version, when all its objects exist and their checksums have been compared.

    Raises
    ------
    BadInput
        If there is nothing to push, a table does not exist, or the service refuses.
    Damaged
        If a file or an object differs from its manifest.
    Superseded
        If another push has ended since this one began.
    """
    local_versions = _linked_versions(root, only)
    bucket = Bucket(address)
    remote_versions, tag = bucket.read_published()
    new_versions = _merge_published(remote_versions, local_versions, only)
    versions = {(table, key) for table, key in local_versions.tables.items()}
    versions |= {
        (table, key) for keys_by_table in local_versions.names.values() for table, key in keys_by_table.items()
    }
    for number, (table, key) in enumerate(sorted(versions)):
        report = _push_version(bucket, _objects_of_version(root, table, key), table, key, threads)
        # The test of the service needs an existing object, so it runs after the first version. It must not run later,
        # because sending all versions may take hours.
        if number == 0 and not bucket.supports_conditions(f"{table}/v-{key}/{MANIFEST}"):
            raise BadInput(f"{address}: the storage ignores conditions of puts, so two pushes could mix versions")
        yield report
    if (tag is None or new_versions != remote_versions) and not bucket.replace_current(new_versions, tag):
        raise Superseded(f"{address}: another push has ended since this one began: run again to replace it")


def _linked_versions(root: Path, only: Sequence[str]) -> PublishedVersions:
    """Return the versions to which links of a lake lead, for the tables in `only` or by default for all tables.

    Raise BadInput if the lake has no tables, or one of `only` does not exist.
    """
    if not (table_names := layout.table_names(root)):
        raise layout.missing_table(root)
    if unknown := sorted(set(only) - set(table_names)):
        raise layout.missing_table(root, unknown[0], table_names)
    keys_by_request: dict[str, dict[str, str]] = {"": {}}
    for table in only or table_names:
        for name, key in {"": layout.current_key(root, table), **request_links.keys_by_request(root, table)}.items():
            if key is not None:
                keys_by_request.setdefault(name, {})[table] = key
    return PublishedVersions(keys_by_request.pop(""), keys_by_request)


def _merge_published(
    remote_versions: PublishedVersions, local_versions: PublishedVersions, only: Sequence[str]
) -> PublishedVersions:
    """Return the list of versions that `current` will contain after the push.

    Without `only`, it is the list of the local lake. Otherwise the tables in `only` are replaced in the remote list.
    """
    if not only:
        return local_versions
    keys_by_request: dict[str, dict[str, str]] = {}
    for name in sorted({*remote_versions.names, *local_versions.names}):
        remaining = {table: key for table, key in remote_versions.names.get(name, {}).items() if table not in only}
        if keys_by_table := remaining | dict(local_versions.names.get(name, {})):
            keys_by_request[name] = keys_by_table
    return PublishedVersions({**remote_versions.tables, **local_versions.tables}, keys_by_request)


def _objects_of_version(root: Path, table: str, key: str) -> list[_Object]:
    """Return the files of a local version with the names of their objects; the manifest is the last one.

    Raise Damaged if the files differ from the manifest (list of files with sizes and sha256).
    """
    folder = layout.version_folder(root, table, key)
    facts = manifest.load(folder, table)
    if faults := manifest.faults(folder, facts):
        raise Damaged(faults[0])
    prefix, path = f"{table}/{folder.name}", folder / MANIFEST
    files = [_Object(folder / f["path"], f"{prefix}/{f['path']}", f["bytes"], f["sha256"]) for f in facts["files"]]
    return [*files, _Object(path, f"{prefix}/{MANIFEST}", path.stat().st_size, file_sha256(path))]


def _push_version(bucket: Bucket, objects: Sequence[_Object], table: str, key: str, threads: int) -> PushReport:
    def upload_if_missing(item: _Object) -> int:
        if bucket.has_object(item):
            return 0
        if file_sha256(item.path) != item.sha256:
            raise Damaged(f"{item.path} has other contents than the manifest says")
        bucket.send(item)
        if not bucket.has_object(item):
            raise Damaged(f"{bucket.address.plain}/{item.name} differs from what was sent")
        return 1

    with ThreadPoolExecutor(threads) as pool:
        try:
            # Send the manifest last, so that a version whose manifest exists is complete.
            is_sent = [*pool.map(upload_if_missing, objects[:-1]), upload_if_missing(objects[-1])]
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    sent_sizes = [item.size for item, was_sent in zip(objects, is_sent, strict=True) if was_sent]
    return PushReport(table, key, len(objects), sum(item.size for item in objects), len(sent_sizes), sum(sent_sizes))


# ------------------------------------- the command `truesky push`


def run_command(options: argparse.Namespace) -> int:
    """Run `truesky push` with its parsed arguments, and return the exit status 0.

    BadInput is raised for wrong arguments, Damaged for a damaged lake, and Superseded if another push ended first.
    """
    root, address = layout.resolve_lake(options.lake), s3.parse_address(options.place, options.endpoint_url, "target")
    threads = THREADS if options.threads is None else options.threads
    if not 1 <= threads <= 256:
        raise BadInput(f"--threads {threads}: must be 1 to 256")
    for report in push(root, address, options.only, threads):
        sent = f"sent {report.sent:6,} {report.sent_size / 1e6:10.1f} MB"
        totals = f"{report.objects:6,} objects {report.size / 1e6:10.1f} MB, {sent}"
        print(f"{report.table:16} v-{report.key} {totals}", flush=True)
    print(f"{address} is published")
    return 0
