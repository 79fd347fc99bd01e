"""Progress of a command that computes: lines from one second on, and the share of compiled kernels."""

import re

import numba
import pytest

from device.clock import SystemClock
from services.running_time import working


def test_a_short_computation_says_nothing() -> None:
    lines: list[str] = []
    with working("adding", lines.append, SystemClock()) as beat:
        pass
    assert lines == []
    assert re.fullmatch(r"\d\.\d s in all", beat.spent)


def test_a_computation_of_a_second_is_said_and_compiled_kernels_are_counted() -> None:
    lines: list[str] = []
    clock = SystemClock()
    with working("adding", lines.append, clock) as beat:
        numba.njit(lambda x: x + 1)(3)  # a new function: no cache holds it
        clock.sleep(1.3)
    assert re.fullmatch(r"adding: 1 s \(compiling kernels, which this computer then keeps\)", lines[0])
    assert 0 < beat.compiled_s < beat.seconds
    assert "s of them to compile kernels" in beat.spent


def test_the_lines_end_with_an_error() -> None:
    with pytest.raises(ValueError, match="wrong"), working("adding", print, SystemClock()):
        raise ValueError("wrong")
