"""Read the exposures of a request: pointings, observations that the planner schedules, and tables of pointings."""
