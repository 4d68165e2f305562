"""Files and tables of others."""
