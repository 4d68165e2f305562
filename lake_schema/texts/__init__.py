"""Write texts for people: amounts with units, suggestions for misspelt names, and tables."""
