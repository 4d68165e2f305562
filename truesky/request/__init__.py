"""Read and check simulation requests."""

from truesky.request.from_toml import parse
from truesky.request.schema import Request

__all__ = ["Request", "parse"]
