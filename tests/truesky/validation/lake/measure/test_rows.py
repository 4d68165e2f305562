"""Rows of the table `validation`."""

from truesky.validation.lake.measure.rows import Place


def test_places_have_names():
    assert Place("VIS", "euclid_vis", 12, "3-4").text == "VIS/euclid_vis/000012/3-4"
    assert Place("VIS").text == "VIS"
    assert Place().text == "lake"
