"""Readers of a lake on object storage see a complete old or new state, even if pushes or objects fail."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lake_schema.errors import BadInput, Damaged, Superseded
from lake_schema.store import layout, publish, read, request_links
from lake_schema.store.object_storage import push, s3
from tests.universe import plain_plan, plain_work, toy_plan, toy_work
from truesky.commands import __main__

ROOT = Path(__file__).resolve().parents[2]
CELLS = ((1607, 60), (1608, 40))


@pytest.fixture
def place(bucket):
    return s3.parse_address(f"s3://{bucket[1]}/lakes/one")


@pytest.fixture
def filled(lake):
    """Lake with a catalogue and a plain table."""
    publish.make_version(lake, toy_plan(cells=CELLS), toy_work)
    publish.make_version(lake, plain_plan(1), plain_work, name="first")
    return lake


def pushed(lake, place, **options):
    return list(push.push(lake, place, **options))


def opened(place):
    return layout.open_lake(str(place))


def seed(place):
    """Return which version of the plain table readers see, after checking all its rows."""
    values = set(read.version(opened(place), "plain").rows()["value"].to_pylist())
    assert len(values) == 1
    return values.pop()


def test_a_pushed_lake_is_read_like_its_folder(filled, place):
    told = pushed(filled, place)
    assert [one.table for one in told] == ["plain", "toy"]
    assert all(one.sent == one.objects and one.sent_size == one.size for one in told)
    there = opened(place)
    assert read.table_names(there) == ["plain", "toy"]
    assert request_links.request_names(there) == ["first"]
    assert request_links.tables_of_request(there, "first") == ["plain"]
    for table in ("plain", "toy"):
        here, far = read.version(filled, table), read.version(there, table)
        assert far.rows().equals(here.rows())
        assert far.schema.equals(here.schema, check_metadata=True)
        assert read.find_faults(far, deep=True) == []
        assert far.fingerprint == here.fingerprint
    toy, part = read.version(there, "toy"), layout.cell_file(5, 1607)
    ra, dec = (toy.rows()[name][0].as_py() for name in ("ra", "dec"))
    assert toy.cone(ra, dec, 0.3).equals(read.version(filled, "toy").cone(ra, dec, 0.3))
    assert toy.read_margin(part).equals(read.version(filled, "toy").read_margin(part))
    assert (
        toy.sidecar_path("toy/hats.properties").read_bytes()
        == (layout.current_link(filled, "toy") / "toy" / "hats.properties").read_bytes()
    )


def test_existing_objects_are_not_sent_again(filled, place, bucket):
    pushed(filled, place)
    bucket[0].recorder.asked.clear()
    assert {one.sent for one in pushed(filled, place)} == {0}
    # This push must be refused.
    assert [path.rpartition("/")[2] for path in bucket[0].recorder.sent()] == ["manifest.json"]
    publish.make_version(filled, plain_plan(2), plain_work)
    told = {(one.table, one.key): one.sent for one in pushed(filled, place)}
    assert sorted(told.values()) == [0, 0, 4]
    assert seed(place) == 2.0
    with pytest.raises(BadInput, match="has no request second"):
        read.version(opened(place), "plain", request="second")


def test_an_open_reader_keeps_its_versions(filled, place):
    pushed(filled, place)
    before = opened(place)
    first = read.version(before, "plain")
    publish.make_version(filled, plain_plan(2), plain_work, name="first")
    pushed(filled, place)
    assert read.version(before, "plain").key == first.key
    assert set(first.rows()["value"].to_pylist()) == {1.0}
    assert seed(place) == 2.0
    assert read.version(opened(place), "plain", key=first.key).rows().equals(first.rows())


def test_some_tables_leave_the_others_as_they_were(filled, place):
    pushed(filled, place)
    key = read.version(filled, "toy").key
    publish.make_version(filled, toy_plan(2, cells=CELLS), toy_work)
    publish.make_version(filled, plain_plan(2), plain_work, name="second")
    assert {one.table for one in pushed(filled, place, only=["plain"])} == {"plain"}
    there = opened(place)
    assert read.version(there, "toy").key == key != read.version(filled, "toy").key
    assert request_links.keys_by_request(there, "plain") == request_links.keys_by_request(filled, "plain")
    assert request_links.request_names(there) == ["first", "second"]
    with pytest.raises(BadInput, match="has no table stars; it has plain, toy"):
        pushed(filled, place, only=["stars"])


@pytest.mark.parametrize("stride", [4, pytest.param(1, marks=pytest.mark.nightly)])
def test_a_push_that_ends_anywhere_is_completed_by_the_next(filled, place, bucket, stride):
    pushed(filled, place, only=["plain"])
    publish.make_version(filled, plain_plan(2), plain_work, name="first")
    service = bucket[0]
    for most in range(0, 100, stride):
        before = len(service.recorder.sent())

        def answer(environ, before=before, most=most):
            late = len(service.recorder.sent()) - before > most
            return "403 Forbidden" if environ["REQUEST_METHOD"] == "PUT" and late else None

        service.recorder.answer = answer
        try:
            pushed(filled, place, threads=1)
            break
        except BadInput:
            service.recorder.answer = None
            assert seed(place) == 1.0
            assert read.table_names(opened(place)) == ["plain"]
    service.recorder.answer = None
    # The first runs end before anything is published, and each run continues the one before.
    assert 2 < most < 20
    assert seed(place) == 2.0
    assert read.find_faults(read.version(opened(place), "toy"), deep=True) == []


def test_the_second_of_two_simultaneous_pushes_is_refused(filled, tmp_path, place):
    pushed(filled, place)
    publish.make_version(filled, plain_plan(2), plain_work, name="first")
    other = tmp_path / "other"
    shutil.copytree(filled, other, symlinks=True)
    publish.make_version(other, plain_plan(3), plain_work, name="first")
    slow = push.push(filled, place)
    next(slow)
    pushed(other, place)
    with pytest.raises(Superseded, match="another push has ended since"):
        list(slow)
    assert seed(place) == 3.0
    pushed(filled, place)
    assert seed(place) == 2.0


def test_a_switch_whose_answer_is_lost_has_happened(filled, place, bucket):
    service, lost = bucket[0], []
    inner = service.recorder.app

    def app(environ, start_response):
        if environ["REQUEST_METHOD"] == "PUT" and environ["PATH_INFO"].endswith("/current") and not lost:
            lost.append(inner(environ, lambda *_: None))
            start_response("503 Slow Down", [("Content-Length", "0")])
            return [b""]
        return inner(environ, start_response)

    service.recorder.app = app
    try:
        pushed(filled, place)
    finally:
        service.recorder.app = inner
    assert lost
    assert seed(place) == 1.0


@pytest.mark.parametrize(
    "harm", ["changed", *(pytest.param(harm, marks=pytest.mark.nightly) for harm in ("cut short", "removed"))]
)
def test_an_object_that_is_not_as_it_was_is_refused_by_name_and_sent_again(filled, place, bucket, harm):
    pushed(filled, place)
    service, name = bucket
    (key,) = (key for key in service.names(name) if key.endswith("/1.parquet"))
    data = service.data(name, key)
    half = len(data) // 2
    if harm == "removed":
        service.client.delete_object(Bucket=name, Key=key)
    else:
        wrong = data[:half] if harm == "cut short" else data[:half] + bytes([data[half] ^ 1]) + data[half + 1 :]
        service.client.put_object(Bucket=name, Key=key, Body=wrong)
    version = read.version(opened(place), "plain")
    with pytest.raises(Damaged, match=f"s3://{name}/{key} ") as refused:
        version.rows()
    assert {"changed": "other bytes", "cut short": f"has {half} bytes", "removed": "is missing"}[harm] in str(
        refused.value
    )
    with pytest.raises(Damaged, match=f"s3://{name}/{key} "):
        version.partition_path("1.parquet")
    assert [line for line in read.find_faults(version, deep=True) if key in line]
    assert sum(one.sent for one in pushed(filled, place)) == 1
    assert service.data(name, key) == data


def test_a_manifest_that_was_changed_is_refused(filled, place, bucket):
    pushed(filled, place)
    service, name = bucket
    (key,) = (key for key in service.names(name) if "plain" in key and key.endswith("manifest.json"))
    service.client.put_object(Bucket=name, Key=key, Body=service.data(name, key).replace(b'"rows": 60', b'"rows": 61'))
    with pytest.raises(Damaged, match="its digest differs"):
        read.version(opened(place), "plain")
    service.client.put_object(Bucket=name, Key="lakes/one/current", Body=b'{"tables": {"../x": "1"}}')
    with pytest.raises(Damaged, match="current does not say"):
        read.table_names(opened(place))
    with pytest.raises(Damaged, match="current does not say"):
        pushed(filled, place)


def test_a_service_without_checksums_is_read_back(filled, place, bucket):
    service = bucket[0]
    service.recorder.answer = lambda environ: environ.pop("HTTP_X_AMZ_CHECKSUM_MODE", None) and None
    pushed(filled, place)
    got = {path for method, path in service.recorder.asked if method == "GET"}
    assert len([path for path in got if path.endswith(".parquet")]) >= 5
    key = next(key for key in service.names(bucket[1]) if key.endswith("/1.parquet"))
    data = service.data(bucket[1], key)
    service.client.put_object(Bucket=bucket[1], Key=key, Body=bytes(len(data)))
    assert sum(one.sent for one in pushed(filled, place)) == 1
    assert service.data(bucket[1], key) == data


def test_a_service_without_conditions_is_refused(filled, place, bucket):
    bucket[0].recorder.answer = lambda environ: environ.pop("HTTP_IF_NONE_MATCH", None) and None
    with pytest.raises(BadInput, match="ignores conditions of puts"):
        pushed(filled, place)
    # This is detected before the whole lake has been sent.
    assert {name.split("/")[2] for name in bucket[0].names(bucket[1])} == {"plain"}


def test_a_large_file_goes_in_parts(place, tmp_path, monkeypatch, bucket):
    monkeypatch.setattr(push, "_MAX_PUT_BYTES", 5 << 20)
    monkeypatch.setattr(push, "_PART_BYTES", 5 << 20)
    path, data = tmp_path / "large", random.Random(1).randbytes(12 << 20)
    path.write_bytes(data)
    one = push._Object(path, "large", len(data), push.file_sha256(path))
    there = push.Bucket(place)
    assert not there.has_object(one)
    there.send(one)
    assert there.has_object(one)
    assert bucket[0].data(bucket[1], "lakes/one/large") == data
    # Amazon appends the number of parts to the checksum of an object that was sent in parts.
    head, sums = there._client.head_object, []

    def as_amazon(**asked):
        told = head(**asked)
        sums.append(told["ChecksumSHA256"])
        return {**told, "ChecksumSHA256": f"{sums[-1].partition('-')[0]}-3"}

    monkeypatch.setattr(there._client, "head_object", as_amazon)
    assert there.has_object(one)
    assert sums
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    assert not there.has_object(one)


def test_a_version_that_is_not_whole_is_not_pushed(filled, place, bucket):
    folder = layout.current_link(filled, "plain").resolve()
    file = folder / "dataset" / "1.parquet"
    data = file.read_bytes()
    file.unlink()
    with pytest.raises(Damaged, match=r"1\.parquet is missing"):
        pushed(filled, place)
    file.write_bytes(data[:200] + bytes([data[200] ^ 1]) + data[201:])
    with pytest.raises(Damaged, match=r"1\.parquet has other bytes"):
        pushed(filled, place)
    file.write_bytes(data)
    # Files that are not tables are compared when they are sent.
    beside = layout.current_link(filled, "toy").resolve() / "toy" / "hats.properties"
    beside.write_bytes(beside.read_bytes().replace(b"toy", b"TOY"))
    with pytest.raises(Damaged, match=r"hats\.properties has other contents than the manifest says"):
        pushed(filled, place)
    assert "lakes/one/current" not in bucket[0].names(bucket[1])


# ------------------------------------------------------------------------------------------------ the command


def told(capsys, *arguments):
    status = __main__.main(["push", *map(str, arguments)])
    said = capsys.readouterr()
    if status:
        assert said.out == ""
        assert said.err.count("\n") == 1
    return status, said.err or said.out


def test_the_command_reports_its_work(filled, place, capsys):
    status, said = told(capsys, filled, place)
    assert status == 0
    assert said.splitlines()[-1] == f"{place} is published"
    assert "sent      4" in said


@pytest.mark.parametrize(
    ("there", "words"),
    [
        ("s3://no-such-bucket/lake", "there is no bucket no-such-bucket"),
        ("s3://sky/lake?endpoint_override=http://127.0.0.1:9", "Could not connect"),
        ("s3://sky/lake?endpoint_override=ftp://x", "endpoint ftp://x"),
        ("s3://sky/lake?colour=red", "must be s3://BUCKET/PREFIX"),
        ("s3://Sky!/lake", "is not a valid name of a bucket"),
        ("s3://sky/a/../b", "empty part"),
        ("s3:lake", "must be s3://BUCKET/PREFIX"),
        ("bucket/lake", "truesky push: target bucket/lake: must be s3://BUCKET/PREFIX"),
        ("bucket/lake", "; did you mean s3://bucket/lake?"),
    ],
)
def test_a_wrong_address_is_refused_in_one_line(filled, bucket, capsys, there, words):
    began = time.monotonic()
    status, said = told(capsys, filled, there)
    assert status == 2
    assert words in said
    assert time.monotonic() - began < 20


def test_folders_that_are_not_lakes_are_refused(tmp_path, place, capsys):
    (tmp_path / "empty").mkdir()
    for lake, words in (
        (tmp_path / "empty", "is not a lake"),
        ("s3://sky/lake", "POSIX"),
        (tmp_path / "no", "does not exist"),
    ):
        status, said = told(capsys, lake, place)
        assert status == 2
        assert words in said


def test_without_credentials_nothing_is_sent(filled, place, capsys, monkeypatch, tmp_path):
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "none"))
    status, said = told(capsys, filled, place)
    assert status == 2
    assert "Unable to locate credentials" in said


@pytest.mark.nightly
def test_a_push_that_is_killed_at_any_moment_is_completed(filled, place, bucket):
    pushed(filled, place)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "truesky.commands", "push", str(filled), str(place), "--threads", "2"]
    rng, killed = random.Random(7), 0
    for number in range(2, 14):
        publish.make_version(filled, plain_plan(number), plain_work, name="first")
        publish.make_version(filled, toy_plan(number, cells=CELLS), toy_work)
        before = len(bucket[0].recorder.sent())
        most = rng.randrange(0, 26)
        with subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL) as process:
            while process.poll() is None and len(bucket[0].recorder.sent()) - before < most:
                time.sleep(0.002)
            process.send_signal(signal.SIGKILL)
        killed += process.returncode == -signal.SIGKILL
        assert seed(place) in (number - 1.0, float(number))
        assert read.find_faults(read.version(opened(place), "toy"), deep=True) == []
        subprocess.run(command, env=environment, check=True, capture_output=True)
        assert seed(place) == number
    assert killed > 6
