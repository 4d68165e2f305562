# Limits numpy to the common instruction set, before any benchmark imports it.
import lake_schema  # noqa: F401
