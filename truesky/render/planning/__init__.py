"""What is observed when, by what, and what it will cost."""
