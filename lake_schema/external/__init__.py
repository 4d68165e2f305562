"""Reading of tables from Parquet, FITS, CSV and HDF5 files of other programs, which may be damaged or hostile."""
