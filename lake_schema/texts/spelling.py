"""Suggest the names that a user may have meant by a name that does not exist."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence

# Smallest similarity (0 to 1, by difflib) of a suggested name.
_LEAST_SIMILARITY = 0.6
# Largest number of names that are compared or listed, and the number of first names that stand for a longer list. After
# a suggestion, a list of more than this number of names is left out.
_MAX_COMPARED, _MAX_LISTED, _EXAMPLES = 10_000, 60, 8
# Name of a passband: a survey and a filter.
_BAND = re.compile(r"([a-z0-9]{2,})[-_. ]([a-z])")
# Largest number of suggestions if the name is a part of several names.
_MAX_WITH_PART = 3


def closest_names(name: str, existing: Iterable[str], count: int = 3) -> list[str]:
    """Return the existing names that are most similar to a name, the best first, [] if none is similar.

    Parameters
    ----------
    name : str
        A name that does not exist. Upper and lower case are the same.
    existing : iterable of str
        Names that exist.
    count : int, optional
        Largest number of names to return.

    Returns
    -------
    list of str
        Names with another spelling, such as the plural, and names of which `name` is a part between underscores or
        hyphens, such as "euclid_vis" for "VIS".
    """
    by_lower_case = {other.lower(): other for other in list(existing)[:_MAX_COMPARED]}
    lower = name.lower()[:100]
    if lower in by_lower_case:
        return [by_lower_case[lower]]
    similar = difflib.get_close_matches(lower, by_lower_case, count, _LEAST_SIMILARITY)
    with_part = _names_with_part(lower, by_lower_case)
    plurals = [other for other in (f"{lower}s", f"{lower.removesuffix('y')}ies") if other in by_lower_case]
    without_marks = [other for other in by_lower_case if _letters(lower) and _letters(other) == _letters(lower)]
    return [by_lower_case[other] for other in dict.fromkeys((*without_marks, *plurals, *with_part, *similar))][:count]


def _names_with_part(lower: str, existing: Iterable[str]) -> list[str]:
    return [other for other in existing if lower and lower in re.split("[-_.]", other)]


def related_bands(name: str, existing: Iterable[str]) -> str:
    """Return the passbands of a survey that does not have a passband, and the passbands of other surveys in its filter.

    Parameters
    ----------
    name : str
        Name, such as "hsc_i" or "HSC-i". Upper and lower case are the same.
    existing : iterable of str
        Names that exist.

    Returns
    -------
    str
        Text such as "allowed with hsc: hsc_g, hsc_z; allowed with i: lsst_i, des_i"; "" if the name is not that of a
        known survey, or if the passband exists with another spelling.
    """
    band = _BAND.fullmatch(name.lower()[:100])
    if band is None:
        return ""
    bands = [(other, re.split("[-_. ]", other.lower())) for other in existing]
    same_survey = [other for other, parts in bands if parts[0] == band[1]]
    same_filter = [other for other, parts in bands if parts[1:] == [band[2]]]
    if not same_survey or {*same_survey} & {*same_filter}:
        return ""
    lists = ((f"allowed with {band[1]}:", same_survey), (f"allowed with {band[2]}:", same_filter))
    return "; ".join(f"{words} {', '.join(names[:_EXAMPLES])}" for words, names in lists if names)


def _letters(text: str) -> str:
    return re.sub("[^a-z0-9]", "", text)


def did_you_mean(name: str, existing: Iterable[str], count: int = 1) -> str:
    """Return "did you mean X?" with the closest existing names, or "" if no name is similar.

    Parameters
    ----------
    name : str
        A name that does not exist.
    existing : iterable of str
        Names that exist.
    count : int, optional
        Largest number of names to suggest. If the name is a part of several names, such as "NISP" of "NISP-P" and
        "NISP-S", up to three are suggested.

    Returns
    -------
    str
        The question, without a blank at its end.
    """
    existing = list(existing)[:_MAX_COMPARED]
    part_count = len(_names_with_part(name.lower(), [other.lower() for other in existing]))
    names = closest_names(name, existing, max(count, min(part_count, _MAX_WITH_PART)))
    return f"did you mean {' or '.join(names)}?" if names else ""


def suggestion(name: str, existing: Iterable[str]) -> str:
    """Return " (did you mean X?)" with the existing name that is most similar to a name, or "" if none is similar."""
    question = did_you_mean(name, existing)
    return f" ({question})" if question else ""


def choices(name: str, existing: Sequence[str], count: int = 1) -> str:
    """Return the end of an error message about a name that does not exist: a suggestion, and the names that exist.

    Parameters
    ----------
    name : str
        A name that does not exist.
    existing : sequence of str
        Names that exist. Of more than 60, only the first ones are listed. After a suggestion, more than 8 names are not
        listed.
    count : int, optional
        Largest number of names to suggest.

    Returns
    -------
    str
        Text such as "did you mean des_r? allowed: des_g, des_r".
    """
    if related := related_bands(name, existing):
        return related
    suggestion = did_you_mean(name, existing, count)
    if suggestion and len(existing) > _EXAMPLES:
        return suggestion
    listed = ", ".join(existing if len(existing) <= _MAX_LISTED else existing[:_EXAMPLES])
    rest = f", ... ({len(existing)} names)" if len(existing) > _MAX_LISTED else ""
    return f"{suggestion} allowed: {listed}{rest}".strip()


def join_words(words: Sequence[str], conjunction: str = "or") -> str:
    """Return at least one word as a text such as "bias, dark or flat"."""
    *first, last = words
    return f"{', '.join(first)} {conjunction} {last}" if first else last
