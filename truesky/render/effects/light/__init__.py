"""What happens to light before it is charge."""
