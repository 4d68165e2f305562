"""What happens to charge in the pixels."""
