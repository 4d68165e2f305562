"""Validate a lake (folder of simulated tables and images) by measurements of its images and catalogues.

The measured values are compared with headers, models and observations.
"""
