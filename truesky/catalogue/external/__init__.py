"""Read catalogues of the user: map their columns to truesky's columns, check the values and store the rows by cell."""
