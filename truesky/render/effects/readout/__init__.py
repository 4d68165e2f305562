"""What happens on the way to the converter and in it."""
