# Limits numpy to the common instruction set, before any test imports it.
import lake_schema  # noqa: F401
