"""Names and headers of Euclid's level-1 files, for files of whole exposures."""
