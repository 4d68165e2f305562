"""Storage of the lake's tables: staging, publishing, verifying and reading versions."""
