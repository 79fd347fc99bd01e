"""Refraction tasks: order of the calls of their estimator, which holds the state of one frame, and errors."""

from dataclasses import replace
from threading import Event, Lock
from typing import Any

import numpy as np
import pytest

from device.clock import Deadline, SystemClock, VirtualClock
from device.recon.estimation.refraction.estimator import NoRefraction, Refraction
from device.recon.estimation.refraction.field import FieldEdge
from device.recon.estimation.refraction.task import RefractionTask

EDGE = FieldEdge(33.4, 0.1, 0.0, 0.0, 0.0)


class Estimator:
    """Estimator whose result is the first count of the frame in dpt; waits for `go`, and records its calls."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, float]] = []
        self.go = Event()

    def find(self, counts: Any, dark: Any = None, defects: Any = None) -> Refraction | NoRefraction:
        assert self.go.wait(10)
        self.calls.append(("find", float(counts[0, 0])))
        if counts[0, 0] < 0:
            raise ZeroDivisionError("unexpected")
        if counts[0, 0] == 0:
            return NoRefraction("the frame holds no light of the field")
        return Refraction(float(counts[0, 0]), 0.1, 1.0, 500.0, (), EDGE, 0.0)

    def add_cylinder(self, found: Refraction) -> Refraction:
        self.calls.append(("cylinder", found.m_dpt))
        return found

    def join(self, found: Refraction, frames: Any, dark: Any) -> Refraction:
        self.calls.append(("join", found.m_dpt))
        return replace(found, m_dpt=float(np.mean([counts[0, 0] for counts in frames])))


def begin(estimator: Any, lock: Lock, m_dpt: float, with_cylinder: bool = True) -> RefractionTask:
    frame = np.full((2, 2), m_dpt, np.float32), None, None
    return RefractionTask(estimator, lock, SystemClock(), frame, with_cylinder)


def m_dpt(task: RefractionTask) -> float:
    found = task.whole()
    assert isinstance(found, Refraction)
    return found.m_dpt


def test_the_cylinder_follows_its_own_search_also_with_other_tasks_waiting() -> None:
    estimator, lock = Estimator(), Lock()
    tasks = [begin(estimator, lock, dpt) for dpt in (1.0, 2.0, 3.0)]
    assert not any(task.is_done for task in tasks)
    estimator.go.set()
    assert [m_dpt(task) for task in tasks] == [1.0, 2.0, 3.0]
    pairs = [tuple(estimator.calls[k : k + 2]) for k in (0, 2, 4)]
    assert sorted(pairs) == [(("find", dpt), ("cylinder", dpt)) for dpt in (1.0, 2.0, 3.0)]


def test_other_frames_join_after_the_cylinder_and_do_not_hold_it_back() -> None:
    """`latest` needs the refraction of the first frame only; another task may come in between."""
    estimator, lock = Estimator(), Lock()
    task = begin(estimator, lock, 1.0)
    task.join([np.full((2, 2), 4.0, np.float32)])
    other = begin(estimator, lock, 2.0)
    estimator.go.set()
    assert m_dpt(other) == 2.0
    assert m_dpt(task) == 2.5
    latest = task.latest()
    assert isinstance(latest, Refraction)
    assert (latest.m_dpt, task.is_done) == (2.5, True)
    assert estimator.calls.index(("cylinder", 1.0)) < estimator.calls.index(("join", 1.0))
    refused = begin(estimator, lock, 0.0)
    refused.join([np.full((2, 2), 4.0, np.float32)])
    assert isinstance(refused.whole(), NoRefraction)


def test_a_refused_frame_and_a_task_without_cylinder_search_for_none() -> None:
    estimator, lock = Estimator(), Lock()
    estimator.go.set()
    assert isinstance(begin(estimator, lock, 0.0).whole(), NoRefraction)
    assert isinstance(begin(estimator, lock, 2.0, with_cylinder=False).whole(), Refraction)
    assert [name for name, _ in estimator.calls] == ["find", "find"]


class RunningClock(VirtualClock):
    """Virtual clock in which every reading takes a second."""

    def now_s(self) -> float:
        self.elapsed_s += 1
        return self.elapsed_s


def test_a_wait_ends_with_its_deadline_and_the_search_goes_on() -> None:
    estimator, took_s = Estimator(), list[float]()
    frame = np.full((2, 2), 2.0, np.float32), None, None
    # not a RefractionEstimator, but one whose end this test decides
    task = RefractionTask(estimator, Lock(), RunningClock(), frame, True, took_s.append)  # type: ignore[arg-type]
    for ends_in_time in (task.has_found_by, task.is_done_by):
        assert not ends_in_time(Deadline.after(RunningClock(), 5))
    assert took_s == []
    estimator.go.set()
    assert task.is_done_by(None)
    assert task.has_found_by(Deadline(RunningClock(), 0.0)), "it is there"
    assert took_s == [1.0]


def test_an_unexpected_error_reaches_who_asks_and_does_not_block_the_next_task() -> None:
    estimator, lock = Estimator(), Lock()
    estimator.go.set()
    failed = begin(estimator, lock, -1.0)
    for ask in (failed.found, failed.whole):
        with pytest.raises(ZeroDivisionError):
            ask()
    assert isinstance(begin(estimator, lock, 2.0).whole(), Refraction)
