"""The light of sources onto a frame."""
