"""Checks of images, a file each: what a frame's pixels say beside what its header and the lake's tables say."""
