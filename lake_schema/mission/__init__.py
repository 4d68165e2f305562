"""The mission database: all numbers of the telescopes, cameras and survey, each with its status and source."""
