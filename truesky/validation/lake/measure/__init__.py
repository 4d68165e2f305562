"""What the checks share: rows with verdicts, frames by their headers alone, stars, blank sky."""
