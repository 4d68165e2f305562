"""What is done to a spectrum between its source and the telescope."""
