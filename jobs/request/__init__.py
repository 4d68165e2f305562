"""The simulation request: what it may hold, how it is read and checked."""

from jobs.request.from_toml import parse
from jobs.request.schema import Request

__all__ = ["Request", "parse"]
