"""Put a lake on object storage: truesky push LAKE s3://BUCKET/PREFIX [--endpoint-url URL] [--only TABLE ...].

Objects of versions never change, so that what is there as it should be is not sent again, and a run that was killed
goes on where it ended. When every object of every version is there and its checksum compared, one conditional put
replaces the object `current`: readers see what was published before or what is published now. Of two who push at the
same time the second is refused. Nothing is removed.
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
from lake_schema.store import layout, manifest, names
from lake_schema.store.object_storage import s3
from lake_schema.store.object_storage.s3 import CURRENT, MANIFEST, Address, Published
from lake_schema.store.provenance import file_sha256

# A put holds at most 5 GB; a larger file goes in parts, each with a checksum of its own.
_IN_ONE_PUT, _PART = 1 << 30, 256 << 20
_PIECE = 8 << 20
THREADS = 16
# What services answer where a condition of a put does not hold, or another put is under way.
_REFUSED = {"PreconditionFailed", "ConditionalRequestConflict", "412", "409"}
_ABSENT = {"NoSuchKey", "404", "NotFound"}


@dataclass(frozen=True, slots=True)
class Sent:
    """What a push did with a version: objects and bytes in all, objects and bytes that it sent."""

    table: str
    key: str
    objects: int
    size: int
    sent: int
    sent_size: int


@dataclass(frozen=True, slots=True)
class _Object:
    """A file of a version and the object that is to hold it."""

    path: Path
    name: str
    size: int
    sha256: str


class Bucket:
    """The objects of one lake, through boto3.

    Errors : BadInput where the storage does not answer, has no such bucket, or does not let us in
    """

    def __init__(self, place: Address) -> None:
        try:
            import boto3
            from botocore.config import Config
        except ImportError:
            raise BadInput("push wants the package boto3: pip install 'truesky[s3]', or boto3 alone") from None
        self.place = place
        config = Config(
            connect_timeout=s3.CONNECT,
            read_timeout=s3.ANSWER,
            retries={"mode": "standard", "max_attempts": s3.TRIES},
            max_pool_connections=2 * THREADS,
        )
        told: dict[str, Any] = {"endpoint_url": place.service} if place.service else {}
        with self._refusing():
            # Where nothing names a region, any serves: a service of one's own has but one, Amazon tells the right one.
            session = boto3.session.Session()
            region = place.region or session.region_name or "us-east-1"
            self._client = session.client("s3", region_name=region, config=config, **told)
            self._client.head_bucket(Bucket=place.bucket)

    @contextmanager
    def _refusing(self) -> Iterator[None]:
        from botocore.exceptions import BotoCoreError, ClientError

        try:
            yield
        except ClientError as error:
            code = error.response["Error"].get("Code", "")
            if code in ("404", "NoSuchBucket"):
                raise BadInput(f"{self.place}: there is no bucket {self.place.bucket}") from None
            raise BadInput(f"{self.place}: {error}") from None
        except (BotoCoreError, ValueError) as error:
            raise BadInput(f"{self.place}: {error}") from None

    def published(self) -> tuple[Published, str | None]:
        """What is published, and the tag of the object that says so; None where there is none.  Errors: Damaged"""
        if (found := self._read(CURRENT)) is None:
            return Published({}, {}), None
        return s3.published(found[0], f"{self.place.plain}/{CURRENT}"), found[1]

    def _read(self, name: str) -> tuple[bytes, str] | None:
        with self._refusing():
            try:
                told = self._client.get_object(Bucket=self.place.bucket, Key=self.place.key(name))
                return told["Body"].read(), told["ETag"]
            except self._client.exceptions.NoSuchKey:
                return None

    def holds(self, one: _Object) -> bool:
        """Whether an object is there with the bytes of its file, by its checksum or by reading it."""
        from botocore.exceptions import ClientError

        name = self.place.key(one.name)
        with self._refusing():
            try:
                told = self._client.head_object(Bucket=self.place.bucket, Key=name, ChecksumMode="ENABLED")
            except ClientError as error:
                if error.response["Error"].get("Code") in _ABSENT:
                    return False
                raise
            if told["ContentLength"] != one.size:
                return False
            if said := told.get("ChecksumSHA256"):
                # Of one that came in parts it is a sum of their sums, and Amazon says how many behind a hyphen.
                whole, in_parts, _ = said.partition("-")
                in_parts = in_parts or "-" in told["ETag"]
                return bool(whole == (_sum_of_parts(one) if in_parts else _base64(one.sha256)))
            # Sent by another program, or kept by a service that keeps no such checksums.
            summed = hashlib.sha256()
            body = self._client.get_object(Bucket=self.place.bucket, Key=name)["Body"]
            for piece in body.iter_chunks(_PIECE):
                summed.update(piece)
            return summed.hexdigest() == one.sha256

    def send(self, one: _Object) -> None:
        """Put a file's bytes there, with their checksum."""
        where = {"Bucket": self.place.bucket, "Key": self.place.key(one.name)}
        with self._refusing():
            if one.size <= _IN_ONE_PUT:
                with one.path.open("rb") as stream:
                    sums = {"ChecksumAlgorithm": "SHA256", "ChecksumSHA256": _base64(one.sha256)}
                    self._client.put_object(Body=stream, **where, **sums)
                return
            from boto3.exceptions import S3UploadFailedError
            from boto3.s3.transfer import TransferConfig

            parts = TransferConfig(multipart_threshold=_IN_ONE_PUT, multipart_chunksize=_PART, use_threads=False)
            try:
                self._client.upload_file(
                    str(one.path), *where.values(), ExtraArgs={"ChecksumAlgorithm": "SHA256"}, Config=parts
                )
            except S3UploadFailedError as error:
                raise BadInput(f"{self.place}: {error}") from None

    def knows_conditions(self, name: str) -> bool:
        """Whether the service refuses a put whose condition does not hold.

        name : of an object that is there, and stays as it is either way
        """
        if (there := self._read(name)) is None:
            raise Damaged(f"{self.place.plain}/{name} is missing")
        return not self._put(name, there[0], {"IfNoneMatch": "*"})

    def switch(self, wanted: Published, before: str | None) -> bool:
        """Replace `current` if it still is the one of a tag (None: if there is none); False where it is not."""
        condition = {"IfNoneMatch": "*"} if before is None else {"IfMatch": before}
        if self._put(CURRENT, wanted.written(), condition):
            return True
        # Our own put, if its answer was lost and it was tried again.
        now = self._read(CURRENT)
        return now is not None and now[0] == wanted.written()

    def _put(self, name: str, data: bytes, condition: dict[str, str]) -> bool:
        from botocore.exceptions import ClientError

        with self._refusing():
            try:
                self._client.put_object(Bucket=self.place.bucket, Key=self.place.key(name), Body=data, **condition)
            except ClientError as error:
                if error.response["Error"].get("Code") in _REFUSED | _ABSENT:
                    return False
                raise
        return True


def _base64(sha256: str) -> str:
    return base64.b64encode(bytes.fromhex(sha256)).decode()


def _sum_of_parts(one: _Object) -> str:
    """sha256 over the sha256 of its parts, as S3 keeps it."""
    summed = hashlib.sha256()
    with one.path.open("rb") as stream:
        while part := stream.read(_PART):
            summed.update(hashlib.sha256(part).digest())
    return base64.b64encode(summed.digest()).decode()


# ------------------------------------------------------------------------------------------------ a lake


def push(root: Path, place: Address, only: Sequence[str] = (), threads: int = THREADS) -> Iterator[Sent]:
    """Put the published versions of a lake there, each told when it is; then switch `current`.

    root    : folder of the lake;  place : where it goes
    only    : tables, none = all of them: then the lake there is what this one is, else its other tables stay
    threads : objects at a time
    Errors  : BadInput for what cannot be pushed, or where the storage refuses; Damaged names what is not as it was
              written, here or there; Superseded where another push has ended since this one began
    """
    chosen = _chosen(root, only)
    bucket = Bucket(place)
    there, tag = bucket.published()
    wanted = _merged(there, chosen, only)
    versions = {(table, key) for table, key in chosen.tables.items()}
    versions |= {(table, key) for own in chosen.names.values() for table, key in own.items()}
    for number, (table, key) in enumerate(sorted(versions)):
        sent = _sent(bucket, _objects(root, table, key), table, key, threads)
        # As soon as there is an object to ask it with, not when hours of others have been sent.
        if number == 0 and not bucket.knows_conditions(f"{table}/v-{key}/{MANIFEST}"):
            raise BadInput(f"{place}: the storage takes no conditional puts: two who push could not be told apart")
        yield sent
    if (tag is None or wanted != there) and not bucket.switch(wanted, tag):
        raise Superseded(f"{place}: another push has ended since this one began: run again to replace it")


def _chosen(root: Path, only: Sequence[str]) -> Published:
    """What the links of a lake say, of all tables or of some.  Errors: BadInput"""
    if not (known := layout.tables(root)):
        raise BadInput(f"lake {root} holds no table")
    if unknown := sorted(set(only) - set(known)):
        raise BadInput(f"lake {root} has no table {unknown[0]}; it has {', '.join(known)}")
    found: dict[str, dict[str, str]] = {"": {}}
    for table in only or known:
        for name, key in {"": layout.current_key(root, table), **names.holders(root, table)}.items():
            if key is not None:
                found.setdefault(name, {})[table] = key
    return Published(found.pop(""), found)


def _merged(there: Published, chosen: Published, only: Sequence[str]) -> Published:
    """What is to be published."""
    if not only:
        return chosen
    found: dict[str, dict[str, str]] = {}
    for name in sorted({*there.names, *chosen.names}):
        kept = {table: key for table, key in there.names.get(name, {}).items() if table not in only}
        if own := kept | dict(chosen.names.get(name, {})):
            found[name] = own
    return Published({**there.tables, **chosen.tables}, found)


def _objects(root: Path, table: str, key: str) -> list[_Object]:
    """The files of a version, its manifest last.  Errors: Damaged where it is not what the manifest says"""
    folder = layout.version(root, table, key)
    facts = manifest.load(folder, table)
    if found := manifest.faults(folder, facts):
        raise Damaged(found[0])
    own, path = f"{table}/{folder.name}", folder / MANIFEST
    files = [_Object(folder / f["path"], f"{own}/{f['path']}", f["bytes"], f["sha256"]) for f in facts["files"]]
    return [*files, _Object(path, f"{own}/{MANIFEST}", path.stat().st_size, file_sha256(path))]


def _sent(bucket: Bucket, objects: Sequence[_Object], table: str, key: str, threads: int) -> Sent:
    def settled(one: _Object) -> int:
        if bucket.holds(one):
            return 0
        if file_sha256(one.path) != one.sha256:
            raise Damaged(f"{one.path} has other contents than the manifest says")
        bucket.send(one)
        if not bucket.holds(one):
            raise Damaged(f"{bucket.place.plain}/{one.name} is not what was sent")
        return 1

    with ThreadPoolExecutor(threads) as pool:
        try:
            # The manifest after all others: where it is, the version is whole.
            new = [*pool.map(settled, objects[:-1]), settled(objects[-1])]
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    sent = [one.size for one, is_new in zip(objects, new, strict=True) if is_new]
    return Sent(table, key, len(objects), sum(one.size for one in objects), len(sent), sum(sent))


# ------------------------------------------------------------------------------------------------ the command


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status: 0 pushed, 1 something is wrong with the lake or another push came first, 2 the call is wrong."""
    parser = argparse.ArgumentParser(
        prog="python -m lake_schema.store.object_storage.push",
        description="Put the published versions of a lake on object storage; what is there already is not sent again.",
        epilog=f"truesky {__version__}",
    )
    parser.add_argument("lake", help="folder of the lake")
    parser.add_argument("place", metavar="s3://BUCKET/PREFIX", help="where it goes")
    parser.add_argument("--endpoint-url", help="of the object storage (default: $AWS_ENDPOINT_URL, else Amazon S3)")
    parser.add_argument("--only", nargs="+", default=[], metavar="TABLE", help="these tables; what else is there stays")
    parser.add_argument("--threads", type=int, default=THREADS, help=f"objects at a time (default {THREADS})")
    options = parser.parse_args(argv)
    return command.status("push", lambda: _pushed(options))


def _pushed(options: argparse.Namespace) -> int:
    root, place = layout.lake(options.lake), s3.address(options.place, options.endpoint_url)
    if not 1 <= options.threads <= 256:
        raise BadInput(f"--threads {options.threads}: wanted 1 to 256")
    for one in push(root, place, options.only, options.threads):
        about = f"{one.objects:6,} objects {one.size / 1e6:10.1f} MB, sent {one.sent:6,} {one.sent_size / 1e6:10.1f} MB"
        print(f"{one.table:16} v-{one.key} {about}", flush=True)
    print(f"{place} is published")
    return 0


if __name__ == "__main__":
    command.leave(main)
