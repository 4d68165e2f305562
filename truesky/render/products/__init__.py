"""A rendered detector as files, and back."""
