# Importing lake_schema restricts numpy to instructions that all common CPUs have. This must happen before a benchmark
# imports numpy.
import lake_schema  # noqa: F401
