"""All checks of a lake: inventory of its contents, choice of checks, table `validation` and HTML report."""
