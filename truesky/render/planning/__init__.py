"""Plan the exposures of a user's request: pointings, dates and detectors, and the computing time to simulate them."""
