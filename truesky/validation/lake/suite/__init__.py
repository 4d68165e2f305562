"""Run all checks of a lake (folder of simulated tables and images), and publish a table and an HTML report.

The table `validation` has the measured values with expected values and verdicts.
"""
