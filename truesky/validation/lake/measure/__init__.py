"""Functions for the checks of a lake (folder of simulated tables and images).

They read raw frames, measure stars and blank sky, and make the rows that say which checks passed.
"""
