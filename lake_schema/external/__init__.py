"""Reading of tables from files of other programs."""
