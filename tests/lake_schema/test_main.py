"""Output and exit status of the commands that inspect and clean up a lake."""

import errno
import shutil
from pathlib import Path

import pytest

import truesky
from lake_schema.errors import BadInput, Damaged, TasksFailed
from lake_schema.store import garbage, layout, manifest, provenance, publish, read
from tests.universe import plain_plan, plain_work, toy_plan, toy_work
from truesky.commands.__main__ import main


@pytest.fixture
def filled(lake):
    publish.make_version(lake, plain_plan(1), plain_work)
    publish.make_version(lake, plain_plan(2), plain_work)
    publish.make_version(lake, toy_plan(), toy_work)
    return lake


def flip(path, byte):
    data = bytearray(path.read_bytes())
    data[byte] ^= 1
    path.write_bytes(data)


def test_verify_says_sound_and_ends_with_0(filled, capsys):
    assert main(["verify", str(filled)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["plain", "toy"]
    assert all(line.endswith("sound") for line in lines)
    assert " 550 rows " in lines[1]


def test_only_verify_deep_compares_sha256(filled, capsys):
    version = read.version(filled, "toy")
    flip(version.sidecar_path("toy/partition_info.csv"), 5)
    assert main(["verify", str(filled), "toy"]) == 0
    capsys.readouterr()
    assert main(["verify", str(filled), "--deep"]) == 1
    out = capsys.readouterr().out
    assert "partition_info.csv has other contents" in out
    assert "1 faults" in out
    assert "plain" in out


def test_verify_goes_on_after_a_broken_manifest(filled, capsys):
    flip(layout.current_link(filled, "plain") / "manifest.json", 30)
    assert main(["verify", str(filled)]) == 1
    out, err = capsys.readouterr()
    assert "manifest.json" in err
    assert "toy" in out


def test_verify_names_a_version_that_is_gone(filled, capsys):
    shutil.rmtree(layout.version_folder(filled, "plain", plain_plan(2).key))
    assert main(["verify", str(filled)]) == 1
    out, err = capsys.readouterr()
    assert f"v-{plain_plan(2).key}, which is missing" in err
    assert "toy" in out


def test_verify_goes_on_after_a_file_that_cannot_be_read(filled, capsys, monkeypatch):
    real = provenance.file_sha256

    def sha256(path):
        if path.name == "Npix=1608.parquet":
            raise OSError(errno.EIO, "Input/output error", str(path))
        return real(path)

    version = read.version(filled, "toy")
    flip(version.partition_path(version.partitions[2]), 100)
    monkeypatch.setattr(manifest, "file_sha256", sha256)
    assert main(["verify", str(filled), "toy", "--deep"]) == 1
    out = capsys.readouterr().out
    assert "Npix=1610.parquet has other contents" in out
    assert "Npix=1608.parquet cannot be read: Input/output error" in out
    monkeypatch.setattr(manifest, "_size_difference", lambda path, entry: sha256(path) and "")
    assert [
        line for line in read.find_faults(version) if "Npix=1608.parquet cannot be read: Input/output error" in line
    ]


def test_a_copy_that_followed_links_is_damaged_for_everyone(filled, tmp_path, capsys):
    shutil.copytree(filled, tmp_path / "copy", symlinks=False)
    for command in ("verify", "gc", "describe"):
        assert main([command, str(tmp_path / "copy"), "toy"]) == 1
    assert len([line for line in capsys.readouterr().err.splitlines() if "must keep its links" in line]) == 3
    with pytest.raises(Damaged, match="must keep its links"):
        publish.make_version(tmp_path / "copy", toy_plan(), toy_work)


def test_a_failing_disc_is_reported_in_one_line(filled, capsys, monkeypatch):
    def refuse(root, name, delete):
        raise OSError(errno.EROFS, "Read-only file system", str(root))

    monkeypatch.setattr(garbage, "collect", refuse)
    assert main(["gc", str(filled), "toy"]) == 1
    assert capsys.readouterr().err == f"truesky gc: [Errno 30] Read-only file system: '{filled}'\n"


def test_gc_leaves_files_of_users(filled, capsys):
    (filled / "plain" / "my-Notes.txt").touch()
    (filled / "plain" / "v-2").mkdir()
    (filled / "runs").mkdir()
    assert main(["gc", str(filled), "--delete"]) == 0
    assert capsys.readouterr().out == f"removed {layout.version_folder(filled, 'plain', plain_plan(1).key)}\n"
    assert main(["gc", str(filled), "runs", "--delete"]) == 2
    assert list((filled / "runs").iterdir()) == []
    assert {"my-Notes.txt", "v-2"} < {path.name for path in (filled / "plain").iterdir()}


@pytest.mark.parametrize("to", ["gone", "elsewhere"])
def test_gc_removes_nothing_if_the_current_version_is_unknown(filled, capsys, to):
    versions = sorted((filled / "plain").glob("v-*"))
    if to == "gone":
        shutil.rmtree(versions.pop(versions.index(layout.version_folder(filled, "plain", plain_plan(2).key))))
    else:
        (filled / "plain" / "current").unlink()
        (filled / "plain" / "current").symlink_to(versions[0])
    assert main(["gc", str(filled), "plain", "--delete"]) == 1
    assert sorted((filled / "plain").glob("v-*")) == versions
    assert str(filled / "plain" / "current") in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["tables", "x"], ["tables", "--deep"], ["gc", "x", "--deep"], ["verify"]])
def test_a_meaningless_argument_is_refused(arguments, capsys):
    with pytest.raises(SystemExit, match="2"):
        main(arguments)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"truesky {arguments[0]}: ")


def test_gc_removes_old_versions_and_lists_them(filled, capsys):
    old = layout.version_folder(filled, "plain", plain_plan(1).key)
    assert main(["gc", str(filled), "--delete"]) == 0
    assert capsys.readouterr().out == f"removed {old}\n"
    assert not old.exists()
    assert main(["verify", str(filled), "--deep"]) == 0
    capsys.readouterr()
    assert main(["gc", str(filled), "--delete"]) == 0
    assert capsys.readouterr().out == ""


def test_gc_removes_the_stage_of_a_run_that_was_given_up(lake, capsys):
    with pytest.raises(TasksFailed):
        publish.make_version(lake, plain_plan(1), lambda root, facts: None)
    assert main(["gc", str(lake), "--delete"]) == 0
    assert "removed" in capsys.readouterr().out
    assert [path.name for path in (lake / "plain").iterdir()] == [".lock"]


def test_describe_names_every_column_with_its_unit(filled, capsys):
    assert main(["describe", str(filled), "toy"]) == 0
    out = capsys.readouterr().out
    assert "550 rows in 4 files" in out
    assert all(name in out for name in toy_plan().table.names)
    assert "uJy" in out


@pytest.mark.parametrize("command", ["verify", "gc", pytest.param("describe", marks=pytest.mark.nightly)])
def test_a_missing_table_is_a_wrong_call(lake, capsys, command):
    assert main([command, str(lake)]) == 2
    assert main([command, str(lake), "galaxies"]) == 2
    assert main([command, str(lake), "../galaxies"]) == 2
    assert main([command, "s3://lake"]) == 2
    err = capsys.readouterr().err.splitlines()
    assert len(err) == 4
    assert main([command, str(lake / "none")]) == 2
    problem = f"lake {lake / 'none'} does not exist; make it with truesky run REQUEST {lake / 'none'}"
    assert capsys.readouterr().err == f"truesky {command}: {problem}\n"


def test_a_similar_folder_is_suggested(lake, capsys):
    assert main(["list", f"{lake}e"]) == 2
    assert capsys.readouterr().err == f"truesky list: lake {lake}e does not exist; did you mean {lake}?\n"


@pytest.mark.parametrize("command", ["list", "verify", "gc", "describe"])
def test_a_folder_without_tables_is_not_a_lake(tmp_path, capsys, command):
    (tmp_path / "notes").mkdir()
    assert main([command, str(tmp_path)]) == 2
    problem = f"{tmp_path} is not a lake, because it has no tables; give a folder that truesky run has made"
    assert capsys.readouterr().err == f"truesky {command}: {problem}\n"


@pytest.fixture
def parent(tmp_path, monkeypatch):
    """A folder with the lake `lake`, which has the table `stars` and the request `demo`; it is the working folder."""
    (tmp_path / "lake" / "stars" / "v-0123456789abcdef" / "stars").mkdir(parents=True)
    (tmp_path / "lake" / "stars" / "current").symlink_to("v-0123456789abcdef")
    (tmp_path / "lake" / "names" / "demo").mkdir(parents=True)
    (tmp_path / "lake" / "runs").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("command", ["list", "verify", "gc", "describe", "sql", "report"])
@pytest.mark.parametrize("folder", ["stars", "stars/current", "stars/current/stars", "names", "names/demo", "runs"])
def test_a_part_of_a_lake_is_not_a_lake(parent, capsys, command, folder):
    has_option = folder == "names/demo" and command in ("verify", "describe", "sql")
    for lake in ("lake", f"{parent}/lake"):
        assert main([command, f"{lake}/{folder}"]) == 2
        option = " and --name demo" if has_option else ""
        problem = f"lake {lake}/{folder} is a part of the lake {lake}: give {lake}{option}"
        assert capsys.readouterr().err == f"truesky {command}: {problem}\n"


def test_a_part_of_a_lake_is_not_a_lake_in_python(parent, monkeypatch):
    with pytest.raises(
        BadInput, match=r'^lake lake/names/demo is a part of the lake lake: give lake and request="demo"$'
    ):
        truesky.open("lake/names/demo")
    monkeypatch.chdir(parent / "lake" / "stars")
    with pytest.raises(BadInput, match=rf"^lake current is a part of the lake {parent}/lake: give {parent}/lake$"):
        truesky.open(Path("current"))


@pytest.mark.parametrize("command", ["list", "verify", "gc", "describe"])
def test_a_folder_without_tables_in_a_folder_with_the_name_of_a_table_is_not_a_lake(tmp_path, capsys, command):
    (tmp_path / "stars" / "notes").mkdir(parents=True)
    assert main([command, str(tmp_path / "stars")]) == 2
    assert "is not a lake, because it has no tables" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["list", "verify", "gc", "describe"])
def test_a_similar_table_is_suggested(filled, capsys, command):
    assert main([command, str(filled), "plains"]) == 2
    assert capsys.readouterr().err == f"truesky {command}: lake {filled} has no table plains; did you mean plain?\n"
    assert main([command, str(filled), "stars"]) == 2
    assert capsys.readouterr().err.endswith("has no table stars; it has plain, toy\n")
