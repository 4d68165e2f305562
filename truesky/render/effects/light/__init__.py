"""Effects of the optics and of the pixels' response on light before it becomes charge."""
