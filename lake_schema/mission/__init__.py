"""The mission database: all numbers of the telescopes, cameras and survey that the simulation uses.

Each number has a status (required, designed, built, current best estimate, or simulated) and a source.
"""
