"""Push a lake to object storage: truesky push LAKE s3://BUCKET/PREFIX [--endpoint-url URL] [--only TABLE ...].

Objects of versions never change, so existing objects are not sent again, and a run that was killed can be continued.
After all objects exist and their checksums have been compared, one conditional put replaces the object `current`.
Readers therefore see either the old or the new set of versions. If two pushes run at the same time, the second one
fails. Nothing is removed.
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

from lake_schema import __version__, command
from lake_schema.errors import BadInput, Damaged, Superseded
from lake_schema.store import layout, manifest, request_links
from lake_schema.store.object_storage import s3
from lake_schema.store.object_storage.s3 import CURRENT, MANIFEST, Address, PublishedVersions
from lake_schema.store.provenance import file_sha256

# S3 allows 5 GB per put; larger files are sent in parts, each with a checksum.
_MAX_PUT_BYTES, _PART_BYTES = 1 << 30, 256 << 20
_CHUNK_BYTES = 8 << 20
THREADS = 16
# Error codes of services if the condition of a put is not met, or if another put is in progress.
_REFUSED_CODES = {"PreconditionFailed", "ConditionalRequestConflict", "412", "409"}
_ABSENT_CODES = {"NoSuchKey", "404", "NotFound"}


@dataclass(frozen=True, slots=True)
class PushReport:
    """Result of pushing one version.

    Attributes
    ----------
    table : str
        Name of the table.
    key : str
        Key of the version.
    objects : int
        Number of its objects.
    size : int
        Total size in bytes.
    sent : int
        Number of objects that were sent.
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
    """A file of a version and the name of its object."""

    path: Path
    name: str
    size: int
    sha256: str


class Bucket:
    """Objects of one lake, accessed through boto3.

    Methods raise BadInput if the service does not answer, the bucket does not exist, or access is denied.

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
            retries={"mode": "standard", "max_attempts": s3.MAX_ATTEMPTS},
            max_pool_connections=2 * THREADS,
        )
        options: dict[str, Any] = {"endpoint_url": address.service} if address.service else {}
        with self._errors_as_bad_input():
            # Any region works as the default: other services have only one, and Amazon redirects to the right one.
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
        """Return the published versions, and the ETag of the object `current` or None if it does not exist.

        Raises
        ------
        Damaged
            If the object has another form.
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
        """Return True if an object exists with the contents of its file, by its checksum or else by reading it.

        An object that was sent in parts of another size counts as missing. Errors of the service raise BadInput.
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
                # For an object sent in parts, this is a checksum of checksums; Amazon appends "-" and their number.
                checksum_value, in_parts, _ = checksum.partition("-")
                in_parts = in_parts or "-" in response["ETag"]
                return bool(checksum_value == (_multipart_checksum(item) if in_parts else _base64(item.sha256)))
            # The object was sent by another program, or the service stores no checksums.
            file_hash = hashlib.sha256()
            body = self._client.get_object(Bucket=self.address.bucket, Key=object_key)["Body"]
            for piece in body.iter_chunks(_CHUNK_BYTES):
                file_hash.update(piece)
            return file_hash.hexdigest() == item.sha256

    def send(self, item: _Object) -> None:
        """Send a file with its checksum."""
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
        """Return True if the service refuses a put whose condition is not met.

        `name` is an existing object; the test does not change its contents.

        Raises
        ------
        Damaged
            If the object does not exist.
        """
        if (existing := self._read_object(name)) is None:
            raise Damaged(f"{self.address.plain}/{name} is missing")
        return not self._put_if(name, existing[0], {"IfNoneMatch": "*"})

    def replace_current(self, published: PublishedVersions, tag: str | None) -> bool:
        """Replace `current` if its ETag is still `tag`, or for None if it does not exist; return True on success."""
        condition = {"IfNoneMatch": "*"} if tag is None else {"IfMatch": tag}
        if self._put_if(CURRENT, published.to_bytes(), condition):
            return True
        # If the answer to a successful put was lost, the retry fails although `current` is as requested.
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
    """Return the sha256 of the sha256 of all parts, as S3 computes it."""
    combined_hash = hashlib.sha256()
    with item.path.open("rb") as stream:
        while part := stream.read(_PART_BYTES):
            combined_hash.update(hashlib.sha256(part).digest())
    return base64.b64encode(combined_hash.digest()).decode()


# ------------------------------------------------------------------------------------------------ a lake


def push(root: Path, address: Address, only: Sequence[str] = (), threads: int = THREADS) -> Iterator[PushReport]:
    """Send the published versions of a lake and yield a report for each; then replace `current`.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    address : Address
        Address of the lake on object storage.
    only : sequence of str, optional
        Tables to push; other tables on object storage stay. By default, all tables are pushed, and the published
        versions become the versions of this lake.
    threads : int, optional
        Number of objects that are sent at the same time.

    Yields
    ------
    PushReport
        Report of a version, when all its objects exist.

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
        # This test needs an object. It runs after the first version, before other versions are sent for hours.
        if number == 0 and not bucket.supports_conditions(f"{table}/v-{key}/{MANIFEST}"):
            raise BadInput(f"{address}: the storage ignores conditions of puts, so two pushes could mix versions")
        yield report
    if (tag is None or new_versions != remote_versions) and not bucket.replace_current(new_versions, tag):
        raise Superseded(f"{address}: another push has ended since this one began: run again to replace it")


def _linked_versions(root: Path, only: Sequence[str]) -> PublishedVersions:
    """Return the published versions of some or all tables; raise BadInput if a table does not exist."""
    if not (table_names := layout.table_names(root)):
        raise BadInput(f"lake {root} holds no table")
    if unknown := sorted(set(only) - set(table_names)):
        raise BadInput(f"lake {root} has no table {unknown[0]}; it has {', '.join(table_names)}")
    keys_by_request: dict[str, dict[str, str]] = {"": {}}
    for table in only or table_names:
        for name, key in {"": layout.current_key(root, table), **request_links.keys_by_request(root, table)}.items():
            if key is not None:
                keys_by_request.setdefault(name, {})[table] = key
    return PublishedVersions(keys_by_request.pop(""), keys_by_request)


def _merge_published(
    remote_versions: PublishedVersions, local_versions: PublishedVersions, only: Sequence[str]
) -> PublishedVersions:
    """Return the versions that are to be published."""
    if not only:
        return local_versions
    keys_by_request: dict[str, dict[str, str]] = {}
    for name in sorted({*remote_versions.names, *local_versions.names}):
        remaining = {table: key for table, key in remote_versions.names.get(name, {}).items() if table not in only}
        if keys_by_table := remaining | dict(local_versions.names.get(name, {})):
            keys_by_request[name] = keys_by_table
    return PublishedVersions({**remote_versions.tables, **local_versions.tables}, keys_by_request)


def _objects_of_version(root: Path, table: str, key: str) -> list[_Object]:
    """Return the files of a version, its manifest last; raise Damaged if they differ from the manifest."""
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
            # The manifest is sent last: if it exists, the version is complete.
            is_sent = [*pool.map(upload_if_missing, objects[:-1]), upload_if_missing(objects[-1])]
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    sent_sizes = [item.size for item, was_sent in zip(objects, is_sent, strict=True) if was_sent]
    return PushReport(table, key, len(objects), sum(item.size for item in objects), len(sent_sizes), sum(sent_sizes))


# ------------------------------------------------------------------------------------------------ the command


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status.

    The status is 0 for success, 1 for a fault of the lake or if another push came first, and 2 for a wrong call.
    """
    parser = argparse.ArgumentParser(
        prog="python -m lake_schema.store.object_storage.push",
        description="Push the published versions of a lake to object storage; existing objects are not sent again.",
        epilog=f"truesky {__version__}",
    )
    parser.add_argument("lake", help="folder of the lake")
    parser.add_argument("place", metavar="s3://BUCKET/PREFIX", help="address of the lake on object storage")
    parser.add_argument("--endpoint-url", help="URL of the object storage (default: $AWS_ENDPOINT_URL, else Amazon S3)")
    parser.add_argument("--only", nargs="+", default=[], metavar="TABLE", help="tables to push; other tables stay")
    parser.add_argument("--threads", type=int, default=THREADS, help=f"objects at a time (default: {THREADS})")
    options = parser.parse_args(argv)
    return command.run("push", lambda: _run_push(options))


def _run_push(options: argparse.Namespace) -> int:
    root, address = layout.resolve_lake(options.lake), s3.parse_address(options.place, options.endpoint_url)
    if not 1 <= options.threads <= 256:
        raise BadInput(f"--threads {options.threads}: must be 1 to 256")
    for report in push(root, address, options.only, options.threads):
        sent = f"sent {report.sent:6,} {report.sent_size / 1e6:10.1f} MB"
        totals = f"{report.objects:6,} objects {report.size / 1e6:10.1f} MB, {sent}"
        print(f"{report.table:16} v-{report.key} {totals}", flush=True)
    print(f"{address} is published")
    return 0


if __name__ == "__main__":
    command.exit_with_status(main)
