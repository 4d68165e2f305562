"""Sources of light from catalogue rows: selection, shapes, colours and pictures."""
