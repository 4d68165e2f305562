"""The mission database: every number of the telescopes, cameras and survey, with its status and its source."""
