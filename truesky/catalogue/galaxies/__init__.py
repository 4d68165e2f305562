"""What a galaxy looks like."""
