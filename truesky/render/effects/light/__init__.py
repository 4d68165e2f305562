"""Effects on the expected light of each pixel, before it becomes charge: optics, sky and the response of pixels."""
