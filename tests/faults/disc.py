"""Simulate disc failures: calls that change the disc are counted, and the n-th can raise, end the process, or wait.

with Disc(lake, fail_at=7): ...          the 7th call raises OSError
with Disc(lake, die_at=7): ...           from the 7th call on nothing reaches the disc, as after kill -9
with Disc(lake, at=hook): ...            hook(n, what, path) before each call
"""

import builtins
import contextlib
import errno
import io
import os
from pathlib import Path

from lake_schema.store import parquet


class Killed(BaseException):
    """Raised when the simulated process ends; later operations have no effect on the disc."""


class Disc:
    """Count `mkdir`, `open` for writing, `flush`, `fsync`, `rename`, `symlink`, `unlink`, `rmdir`, Parquet writes."""

    def __init__(self, root, fail_at=0, die_at=0, at=None):
        self.root, self.fail_at, self.die_at, self.at = str(Path(root).resolve()), fail_at, die_at, at
        self.calls = []

    @property
    def dead(self):
        return bool(self.die_at) and len(self.calls) >= self.die_at

    def before(self, what, path):
        if not str(path).startswith(self.root):
            return
        self.calls.append(f"{what} {str(path)[len(self.root) + 1 :]}")
        n = len(self.calls)
        if self.at is not None:
            self.at(n, what, str(path))
        if self.dead:
            raise Killed
        if n == self.fail_at:
            raise OSError(errno.EIO, "injected", str(path))

    def __enter__(self):
        with contextlib.ExitStack() as stack:
            for module, name, wrapped in self._wrappers():
                stack.callback(setattr, module, name, getattr(module, name))
                setattr(module, name, wrapped)
            self.undo = stack.pop_all()
        return self

    def __exit__(self, *_):
        self.undo.close()

    def _wrappers(self):
        for name in ("mkdir", "unlink", "rmdir", "rename", "replace"):
            yield os, name, self._on_first(name, getattr(os, name))
        yield os, "symlink", self._symlink(os.symlink)
        yield os, "fsync", self._fsync(os.fsync)
        yield io, "open", self._open(io.open)
        yield builtins, "open", self._open(builtins.open)
        yield parquet, "write", self._write_table(parquet.write)

    def _on_first(self, name, real):
        def call(path, *args, **kwargs):
            self.before(name, os.path.abspath(path) if kwargs.get("dir_fd") is None else f"{self.root}/{path}")
            return real(path, *args, **kwargs)

        return call

    def _symlink(self, real):
        def call(target, path, *args, **kwargs):
            self.before("symlink", path)
            return real(target, path, *args, **kwargs)

        return call

    def _fsync(self, real):
        def call(descriptor):
            self.before("fsync", os.readlink(f"/proc/self/fd/{descriptor}"))
            return real(descriptor)

        return call

    def _open(self, real):
        def call(path, mode="r", *args, **kwargs):
            writes = not isinstance(path, int) and set(mode) & set("wax+")
            if writes:
                self.before("open", path)
            stream = real(path, mode, *args, **kwargs)
            return _Text(stream, self, str(path)) if writes and "b" not in mode else stream

        return call

    def _write_table(self, real):
        def call(path, *args):
            try:
                self.before("write", path)
            except OSError:
                Path(path).write_bytes(b"PAR1 half a file")
                raise
            return real(path, *args)

        return call


class _Text(io.StringIO):
    """Text file whose flush is counted; text that was not flushed before a death is lost."""

    def __init__(self, stream, disc, path):
        super().__init__()
        self.stream, self.disc, self.path = stream, disc, path

    def flush(self):
        self.disc.before("flush", self.path)
        self._write()

    def _write(self):
        self.stream.write(self.getvalue())
        self.stream.flush()
        self.seek(0)
        self.truncate()

    def fileno(self):
        return self.stream.fileno()

    def close(self):
        if not self.closed:
            if not self.disc.dead:
                self._write()
            self.stream.close()
        super().close()
