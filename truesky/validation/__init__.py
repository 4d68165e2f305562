"""Is what is simulated what it should be: figures of it against expectations from theory and from observations."""
