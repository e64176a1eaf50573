"""A lying gripper is never opened, never pressed beyond the ceiling, never loosened below the margin aimed at."""

import numpy as np
import pytest
from lying_gripper import CEILING_N, LIES, WIRE, hold

from sliplens.grip.controllers import MarginLaw


@pytest.mark.parametrize("lie", [*LIES, *WIRE])
def test_whatever_a_gripper_says_it_is_held(lie):
    held = hold(lie)
    assert held.sent <= {"F", "S"}  # no width
    assert held.command_n.max() <= CEILING_N
    assert held.command_n.min() >= MarginLaw.least_n
    change = np.diff(held.command_n, prepend=0.0)
    assert np.all(change[held.acted < MarginLaw.target] >= 0)
    if lie != "noise of 0.5 N":  # which is right on average
        assert held.troubles
