"""Tools that the checks share: rows with verdicts, frames read by their headers, stars and blank sky."""
