"""Drawing of the light of sources onto a frame."""
