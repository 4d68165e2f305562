"""The mission database: every number of the telescopes, cameras and survey, its status and its source."""
