"""Numbers and names as text, and files of pictures."""

from pathlib import Path

import matplotlib as mpl
import pytest
from matplotlib.figure import Figure

from sliplens.errors import InputError
from sliplens.plots.style import percent, require_picture_path, save_page


@pytest.mark.parametrize(
    ("value", "written"),
    [(0.456, "46\xa0%"), (-0.0004, "0\xa0%"), (-0.04, "\N{MINUS SIGN}4\xa0%"), (None, "\N{EN DASH}")],
)
def test_a_share_is_a_percentage_and_what_rounds_to_nothing_has_no_sign(value, written):
    assert percent(value) == written


@pytest.mark.parametrize("name", ["page.doc", "page"])
def test_another_suffix_is_refused(name: str):
    with pytest.raises(InputError, match=r"does not end in \.png, .*; name"):
        require_picture_path(Path(name), example="a.png")


def test_a_page_is_the_same_each_time_and_leaves_matplotlib_as_it_was(tmp_path: Path):
    before, figure = dict(mpl.rcParams), Figure()
    figure.subplots().plot([0, 1])
    for name in ("a.svg", "b.svg"):
        save_page(figure, tmp_path / name)
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    assert dict(mpl.rcParams) == before
