"""Every check of a lake has a test that injects the fault that the check must detect."""

import inspect

import pytest

from tests.truesky.validation.lake.catalogues import (
    test_angular_power,
    test_changing_sources,
    test_colours,
    test_redshift_multipoles,
    test_two_points,
)
from tests.truesky.validation.lake.catalogues import test_faults as catalogues
from tests.truesky.validation.lake.images import (
    test_common_bias,
    test_completeness,
    test_gain,
    test_repeatability,
    test_spectra,
)
from tests.truesky.validation.lake.images import test_faults as images
from tests.truesky.validation.model import test_observed
from truesky.validation.lake.suite import checks, inventory
from truesky.validation.verdicts import FAIL

# Test and fault by check.
FAULTS = {
    "astrometry": ((images.test_a_wcs_off_by_a_tenth_of_a_pixel, "WCS off by 0.1 pixels"),
                   (images.test_a_scale_that_is_wrong, "scale off by 4e-4")),
    "photometry": ((images.test_a_band_whose_flux_is_shifted, "a band's fluxes shifted by 0.05 mag"),
                   (images.test_magnitudes_that_are_not_linear, "magnitudes stretched by 5 %")),
    "background": ((images.test_a_sky_that_is_too_bright, "sky brighter by 10 %"),),
    "noise": ((images.test_a_read_noise_that_is_a_fifth_off, "read noise 20 % off"),
              (images.test_a_gain_that_is_three_percent_off, "gain 3 % off")),
    "gain": ((test_gain.test_a_gain_that_is_off, "gain 4.5 % off"),),
    "psf": ((images.test_extended_points_fail, "PSF twice as long as wide"),
            (images.test_points_that_are_wider_than_the_header_says, "PSF wider by 18 %")),
    "quality": ((images.test_ramps_that_fit_and_others, "ramps noisier than they say"),),
    "cosmic_rays": ((images.test_cosmic_rays_that_are_off_or_too_many, "cosmic rays off, and too many"),),
    "saturation": ((images.test_stars_that_do_not_saturate, "full well 1.5 times that of the header, and 0.2"),),
    "requirement": ((images.test_a_stack_that_is_not_deep_enough, "sky ten times as bright; zero point off"),
                    (catalogues.test_requirements_that_are_not_met, "galaxies too few, too near, too few lines")),
    "completeness": ((test_completeness.test_sources_that_were_not_drawn, "a third of the sources elsewhere"),
                     (test_completeness.test_sources_that_are_fainter_than_they_should_be, "two magnitudes fainter")),
    "spectra": ((test_spectra.test_faulty_spectra_fail, "trace, flux and wavelength off"),),
    "between_images": ((test_repeatability.test_the_frame_that_is_off, "one frame off by 10 mas, one by 0.05 mag"),),
    "common_offset": ((test_common_bias.test_a_bias_that_all_detectors_share, "all detectors off by 2 mas, 0.03 mag"),),
    "clustering": ((test_two_points.test_places_that_are_shuffled, "positions shuffled"),
                   (test_two_points.test_galaxies_of_other_halos, "halos of another mass"),
                   (test_two_points.test_clustering_of_luminous_galaxies_that_are_shuffled, "luminous ones shuffled")),
    "colours": ((test_colours.test_a_band_whose_flux_is_shifted, "a band's fluxes shifted by 0.1 mag"),
                (test_colours.test_a_band_without_light, "a band without light")),
    "shear": ((test_two_points.test_shear_that_is_turned_by_45_degrees, "shear turned by 45 degrees"),
              (test_two_points.test_one_component_of_shear_with_the_wrong_sign, "one component's sign"),
              (test_two_points.test_shear_of_the_wrong_sign, "the sign of all shear"),
              (test_two_points.test_shear_that_is_half_as_large_again, "shear too large by a half")),
    "angular_power": ((test_angular_power.test_faults_are_found, "halos of another mass; sign of convergence"),),
    "redshift_space": ((test_redshift_multipoles.test_galaxies_that_do_not_cluster_fail, "positions drawn anew"),),
    "duplicates": ((catalogues.test_a_duplicated_cell_is_found, "a duplicated cell"),),
    "changing_sources": (
        (test_changing_sources.test_supernovae_of_unknown_galaxies_and_repeated_ones, "unknown hosts, repeated rows"),
        (test_changing_sources.test_too_few_or_too_many_supernovae, "a third or twice as many"),
        (test_changing_sources.test_nuclei_of_unknown_galaxies_and_repeated_ones, "unknown galaxies, repeated rows")),
    "observed": ((test_observed.test_a_band_whose_magnitudes_are_shifted_in_a_lake, "a band shifted by 0.3 mag"),
                 (test_observed.test_masses_rates_and_lines_that_are_off_in_a_lake, "masses, rates, lines off"),
                 (test_observed.test_a_lake_that_counts_its_area_twice, "all cells duplicated")),
}  # fmt: skip


def names():
    return [check.name for check in (*checks.FRAME_CHECKS, *checks.EXPOSURE_CHECKS, *checks.CATALOGUE_CHECKS)]


def test_no_check_without_a_fault():
    assert set(names()) == set(FAULTS)
    assert all(check.source for check in (*checks.FRAME_CHECKS, *checks.EXPOSURE_CHECKS, *checks.CATALOGUE_CHECKS))


def test_the_tables_of_all_checks_are_opened():
    assert {name for check in checks.CATALOGUE_CHECKS for name in check.tables} <= set(inventory.TABLES)


@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_changes_a_verdict(name):
    """Its test is collected by pytest and expects a failed verdict."""
    for test, fault in FAULTS[name]:
        assert fault
        assert test.__name__.startswith("test_")
        text = inspect.getsource(test)
        assert any(word in text for word in (FAIL.upper(), "turned(", "failed("))
