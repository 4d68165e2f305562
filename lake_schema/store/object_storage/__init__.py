"""Lakes on S3-compatible object storage."""
