"""Lakes on S3-compatible object storage: pushing and reading."""
