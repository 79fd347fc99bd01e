"""Preparation of the frames of a press: which frames, in which thread, and what happens after an error."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from threading import Event, current_thread
from typing import Any

import numpy as np
import pytest

from device.errors import FrameError
from device.recon.burst import JoinedFrame, SeenFrame
from device.recon.burst_reconstructor import PreparedFrame
from device.recon.estimation.sensor_lines import EvenFrame
from device.recon.model.preprocessing import Linear
from device.recon.solvers.solver import Diagnostics
from device.recon.stage import QuickLook, Recipe, Solved, StageResult
from device.values import Colour, Frame, Illumination, Image, Verdict
from services.instrument.frame_preparation import FramePreparation
from services.instrument.press_exposure import Exposure

BLINKS = (20, 21)  # numbers of frames that show a lid
USELESS, FATAL = 0, 99  # numbers of frames that cannot be prepared, and that raise an unknown exception


class Bench:
    """Assessor and preparer of frames whose first count is their number, and what they were asked for."""

    def __init__(self) -> None:
        self.go = Event()
        self.go.set()
        self.darks: set[float | None] = set()
        self.refracted: list[int] = []
        self.options: dict[str, bool] = {}
        self.looks: list[tuple[int, bool, str]] = []
        self.joined: tuple[list[int], dict[int, str]] | None = None

    def assess(self, counts: Any, dark: Any, begin_s: float) -> Verdict:
        assert begin_s == 5.0
        self.darks.add(None if dark is None else float(dark[0, 0]))
        number = int(counts[0, 0])
        return (
            Verdict("again", "shot.blink", {"number": number})
            if number in BLINKS
            else Verdict("good", None, {"number": number})
        )

    def prepare(self, counts: Any, dark: Any = None, *, refract: bool = False, **options: bool) -> PreparedFrame:
        assert self.go.wait(10)
        number = int(counts[0, 0])
        if number == USELESS:
            raise FrameError("too many pixels are missing")
        if number == FATAL:
            raise ZeroDivisionError("unexpected")
        self.refracted += [number] * refract
        self.options = options
        picture = np.full((2, 2), number, np.float32)
        solved = Solved(Linear(picture, picture, 1.0, 0.0, 0.0), Diagnostics())
        look = QuickLook(
            StageResult(Recipe(), picture, last=False), picture[np.newaxis], solved, {}, EvenFrame(counts, {})
        )
        return PreparedFrame(look, SeenFrame(picture, picture > 0, picture, 1.0, 0.0))

    def join(
        self, frames: Sequence[Any], dark: Any, unusable: Mapping[int, str], prepared: Mapping[int, PreparedFrame]
    ) -> JoinedFrame:
        assert prepared.keys() <= set(range(len(frames)))
        self.joined = [int(counts[0, 0]) for counts in frames], dict(unusable)
        return JoinedFrame(np.zeros((2, 2), np.float32), float(len(frames)), ())

    def look(self, image: Image, simulated: bool) -> None:
        self.looks.append((int(image[0, 0]), simulated, current_thread().name))

    def preparation(self, **options: bool) -> FramePreparation:
        return FramePreparation(self, self, "green", 5.0, self.look, **options)


def frame(number: int, colour: Colour | None = "green") -> Frame:
    illumination = None if colour is None else Illumination(colour)
    return Frame(np.full((2, 2), number, np.uint16), 0.1, number, illumination, True)


def test_lit_frames_of_the_burst_are_prepared_with_the_dark_frame_in_a_thread() -> None:
    bench = Bench()
    with bench.preparation() as preparation:
        for taken in (frame(9, None), frame(1), frame(2), frame(3, "red")):
            preparation.add(taken)
        ready = preparation.finish()
    assert {number: prepared.verdict.numbers["number"] for number, prepared in ready.items()} == {1: 1, 2: 2}
    assert bench.darks == {9.0}
    ((look, simulated, thread),) = bench.looks
    assert (look, simulated, bench.refracted) == (1, True, [1]), "the first one alone"
    assert thread != current_thread().name


def test_no_refraction_is_estimated_where_the_budget_is_too_short_for_it() -> None:
    bench = Bench()
    with bench.preparation(refract=False, cylinder=False, alone=True) as preparation:
        preparation.add(frame(1))
        preparation.finish()
    assert (len(bench.looks), bench.refracted) == (1, [])
    assert bench.options == {"cylinder": False, "alone": True}


def test_adding_a_frame_does_not_wait_for_its_preparation() -> None:
    bench = Bench()
    bench.go.clear()
    with bench.preparation() as preparation:
        preparation.add(frame(1))
        assert bench.looks == []
        bench.go.set()
        assert preparation.finish().keys() == {1}


def test_a_useless_frame_has_a_verdict_and_the_next_one_gives_the_quick_look() -> None:
    bench = Bench()
    with bench.preparation() as preparation:
        for number in (USELESS, 1, 2):
            preparation.add(frame(number))
        ready = preparation.finish()
    assert ready[USELESS].prepared is None
    assert ready[USELESS].verdict.word == "good"
    assert [number for number, *_ in bench.looks] == bench.refracted == [1]


@pytest.mark.parametrize(
    ("taken", "order", "unusable"),
    [
        ((1, 2, 3), [1, 2, 3], {}),
        ((20, 1, 2), [1, 20, 2], {1: "frame quality: shot.blink"}),  # a good one comes first
        ((20, 21), [20, 21], {}),  # two of one kind, none of them good
    ],
)
def test_the_frames_are_joined_during_the_next_exposure(
    taken: tuple[int, ...], order: list[int], unusable: dict[int, str]
) -> None:
    bench = Bench()
    with bench.preparation() as preparation:
        for number in taken:
            preparation.add(frame(number))
        preparation.join()
        ready = preparation.finish()
        burst = preparation.joined
    assert burst is not None
    assert bench.joined == (order, unusable)
    assert burst.order == tuple(order)
    lit = tuple(frame(number) for number in order)
    exposure = Exposure(lit, {}, None, 5.0, 1.0, 0.0, ready=ready, burst=burst)
    assert exposure.joined is burst.frame
    assert replace(exposure, lit=lit[::-1]).joined is None


@pytest.mark.parametrize("taken", [(), (1,), (1, 20), (1, USELESS)])
def test_less_than_two_usable_frames_are_not_joined(taken: tuple[int, ...]) -> None:
    with Bench().preparation() as preparation:
        for number in taken:
            preparation.add(frame(number))
        preparation.join()
        preparation.finish()
        assert preparation.joined is None


def test_an_unexpected_error_is_raised_in_the_thread_of_the_press() -> None:
    with Bench().preparation() as preparation:
        preparation.add(frame(FATAL))
        with pytest.raises(ZeroDivisionError):
            preparation.finish()


def test_after_an_error_of_the_press_no_further_frame_is_prepared() -> None:
    bench = Bench()
    bench.go.clear()

    def press() -> None:
        with bench.preparation() as preparation:
            for number in (1, 2, 3):
                preparation.add(frame(number))
            bench.go.set()
            raise FrameError("the camera failed")

    with pytest.raises(FrameError):
        press()
    seen = len(bench.looks), len(bench.darks)
    assert seen <= (1, 1), "at most the one that was being prepared"
