"""How numbers and names are written."""

import pytest

from sliplens.plots.style import name_methods, percent


@pytest.mark.parametrize(
    ("value", "digits", "written"),
    [(0.456, 0, "46\xa0%"), (-0.0004, 0, "0\xa0%"), (-0.0004, 2, "\N{MINUS SIGN}0.04\xa0%"), (None, 0, "\N{EN DASH}")],
)
def test_a_share_is_a_percentage_and_what_rounds_to_nothing_has_no_sign(value, digits, written):
    assert percent(value, digits=digits) == written


def test_methods_in_a_text_are_named_and_other_words_stay():
    text = "poly-cam-thesis and poly-cam of integrated-gradients-like input; insertion, black: occlusion"
    assert name_methods(text) == (
        "Poly-CAM as in the thesis and Poly-CAM of integrated-gradients-like input; insertion, black: Occlusion"
    )
