"""The checks of a lake together: what it holds, which checks that asks for, the table `validation` and its report."""
