"""Write a rendered detector to files, and read it back."""
