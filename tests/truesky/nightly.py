"""Parametrized tests of which a few cases belong to the default run; the others are nightly.

parametrize  cases of a test
params       parameters of a fixture
"""

import pytest


def parametrize(names, cases, default):
    """Return the decorator of a parametrized test.

    Parameters
    ----------
    names : str or tuple of str
        Names of the arguments.
    cases : iterable
        A value per case, or a tuple of them if there are several names. Cases that are `pytest.param` keep their marks.
    default : collection of int
        Positions of the cases of the default run.
    """
    several = not isinstance(names, str) or "," in names
    return pytest.mark.parametrize(names, _marked(cases, default, several))


def params(cases, default):
    """Return the parameters of a fixture, of which those at the positions `default` belong to the default run."""
    return _marked(cases, default, False)


def _marked(cases, default, several):
    cases = list(cases)
    if missing := set(default) - set(range(len(cases))):
        raise IndexError(f"there are {len(cases)} cases, but the default run has {sorted(missing)}")
    marked = []
    for number, case in enumerate(cases):
        if isinstance(case, type(pytest.param())):
            values, marks, name = case.values, [getattr(mark, "mark", mark) for mark in case.marks], case.id
        else:
            values, marks, name = case if several else (case,), [], None
        if number in default and "nightly" in {mark.name for mark in marks}:
            raise ValueError(f"case {number} of the default run is nightly")
        if number not in default:
            marks = [*marks, pytest.mark.nightly]
        marked.append(pytest.param(*values, marks=marks, id=name))
    return marked
