"""Model the effects on a spectrum between its source and the telescope."""
