"""Plan the exposures of a request: what is observed, when, with which detectors, and at what cost."""
