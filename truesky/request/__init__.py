"""Read and check simulation requests, the TOML files in which users describe a simulation."""

from truesky.request.from_toml import parse
from truesky.request.schema import Request

__all__ = ["Request", "parse"]
