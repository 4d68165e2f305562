# Limits numpy to the common instruction set, before any module of this package imports it.
import lake_schema  # noqa: F401
