"""The methods of a study, and how the thesis's is timed."""

import pytest

from sliplens.study.material import STUDY_METHODS, THESIS_POLY_CAM, as_the_thesis_ran, method_options, study_explainers


@pytest.mark.parametrize("budget", [0.2, 1.0])
def test_the_budget_is_that_of_both_poly_cams(budget: float):
    options = method_options(study_explainers(budget=budget))
    assert {options[name]["budget"] for name in ("poly-cam", THESIS_POLY_CAM)} == {budget}


def test_the_thesis_is_timed_with_all_channels_and_the_others_as_they_are():
    explainers = study_explainers()
    timed = as_the_thesis_ran(explainers)
    assert tuple(timed) == STUDY_METHODS
    before, after = (method_options(table)[THESIS_POLY_CAM] for table in (explainers, timed))
    assert after == before | {"budget": 1.0}
    assert all(timed[name] is explainers[name] for name in STUDY_METHODS if name != THESIS_POLY_CAM)
