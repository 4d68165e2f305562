"""The end of a command's process."""

import subprocess
import sys

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

# A scan whose threads still need the interpreter while it shuts down.
SCANNED = """
import atexit, io, sys, threading, time
import pyarrow.dataset as ds
from lake_schema import command

class Slow(io.FileIO):
    def readinto(self, buffer):
        time.sleep(0.02)
        return super().readinto(buffer)

    def read(self, size=-1):
        time.sleep(0.02)
        return super().read(size)

class Late:
    def __del__(self, wait=time.sleep):
        wait(0.5)

late = Late()

def main(code):
    if code == "error":
        raise RuntimeError("as it came")
    parquet = ds.ParquetFileFormat()
    files = [parquet.make_fragment(Slow(sys.argv[1])) for _ in range(50)]
    slow = ds.FileSystemDataset(files, files[0].physical_schema, parquet)
    threading.Thread(target=slow.to_table, daemon=True).start()
    time.sleep(0.1)
    atexit.register(lambda: print("done", end=""))
    if code == "2":
        raise SystemExit(2)
    return int(code)

command.exit_with_status(main, sys.argv[2])
"""


def ended(*arguments):
    return subprocess.run([sys.executable, "-c", SCANNED, *arguments], capture_output=True, text=True, timeout=120)


@pytest.fixture
def path(tmp_path):
    pq.write_table(pa.table({"a": range(100_000)}), tmp_path / "a.parquet", row_group_size=100)
    return tmp_path / "a.parquet"


@pytest.mark.parametrize("code", [0, *(pytest.param(code, marks=pytest.mark.nightly) for code in (1, 2))])
def test_a_scan_that_is_still_open_does_not_abort_a_command(path, code):
    done = ended(path, str(code))
    assert (done.returncode, done.stdout, done.stderr) == (code, "done", "")


def test_an_error_is_not_hidden(path):
    done = ended(path, "error")
    assert (done.returncode, done.stdout) == (1, "")
    assert "RuntimeError: as it came" in done.stderr
