"""The order of effects in each channel."""
