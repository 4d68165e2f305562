"""The simulation request: what it may hold, how it is read and checked."""

from truesky.request.from_toml import parse
from truesky.request.schema import Request

__all__ = ["Request", "parse"]
