"""Copying a lake (a folder of versioned tables) to S3-compatible object storage, and reading it there."""
