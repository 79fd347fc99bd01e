"""States of the exam: every declared transition, every undeclared one, and the diagram drawn from the table."""

import re
from itertools import product
from pathlib import Path
from textwrap import indent

import pytest

from services.instrument import exam_state
from services.instrument.exam_state import TRANSITIONS, ExamEvent, ExamState, transition
from services.instrument.time_budget import MAX_IN_PROGRESS

README = Path(exam_state.__file__).with_name("README.md")
EXPOSURE_ENDS = (ExamEvent.EXPOSED, ExamEvent.EXPOSURE_FAILED)
CAPTURE_BEGINS = (ExamEvent.PRESS, ExamEvent.RESUMED)
CAPTURE_ENDS = (ExamEvent.STORED, ExamEvent.FAILED, ExamEvent.EXPOSURE_FAILED)


@pytest.mark.parametrize(("state", "event"), list(product(ExamState, ExamEvent)))
def test_a_transition_is_the_declared_one_or_an_error(state: ExamState, event: ExamEvent) -> None:
    if (state, event) in TRANSITIONS:
        assert transition(state, event) is TRANSITIONS[state, event]
    else:
        with pytest.raises(RuntimeError, match=f"{event.name}.*{state.name}"):
            transition(state, event)


def test_every_state_is_reached_and_every_running_state_can_end() -> None:
    assert {ExamState.STARTING, *TRANSITIONS.values()} == set(ExamState)
    assert {state for state, event in TRANSITIONS if event is ExamEvent.END} == set(ExamState) - {ExamState.ENDED}


def test_a_press_is_declared_exactly_where_it_is_accepted() -> None:
    assert {state for state in ExamState if state.accepts_press} == {
        state for state, event in TRANSITIONS if event is ExamEvent.PRESS
    }


@pytest.mark.parametrize(("before", "event", "after"), [(*pair, after) for pair, after in TRANSITIONS.items()])
def test_a_transition_changes_the_number_of_captures_by_the_event(
    before: ExamState, event: ExamEvent, after: ExamState
) -> None:
    if event is not ExamEvent.END:
        begun, done = event in CAPTURE_BEGINS, event in CAPTURE_ENDS
        assert after.captures == before.captures + begun - done
        assert after.captures <= MAX_IN_PROGRESS


def test_light_for_a_capture_belongs_to_the_exposing_states_only() -> None:
    for (before, event), after in TRANSITIONS.items():
        if event in EXPOSURE_ENDS:
            assert "EXPOSING" in before.name
            assert "EXPOSING" not in after.name


def test_the_names_on_the_wire_stay() -> None:
    assert {state.wire_state for state in ExamState} == {"starting", "aim", "busy", "making", None}


def diagram() -> str:
    """Return the state diagram as Mermaid text, drawn from the table; END is drawn once for all running states."""
    events: dict[tuple[str, str], list[str]] = {}
    for (state, event), after in TRANSITIONS.items():
        if event is not ExamEvent.END:
            events.setdefault((state.name, after.name), []).append(event.name)
    inner = [f"        {before} --> {after} : {' or '.join(names)}" for (before, after), names in events.items()]
    frame = "stateDiagram-v2", "    [*] --> STARTING", "    state running {"
    return "\n".join([*frame, *inner, "    }", "    running --> ENDED : END"])


def test_the_diagram_of_the_docstring_is_drawn_from_the_table() -> None:
    assert indent(diagram(), "    ") in (exam_state.__doc__ or "")


def test_the_readme_shows_every_transition_of_a_press() -> None:
    drawing = README.read_text(encoding="utf-8").split("## From a press to a picture")[1].split("```")[1]
    drawn = set()
    for events, arrows in re.findall(r"on ([A-Z_]+(?: or [A-Z_]+)*): ((?:[A-Z_]+ -> [A-Z_]+(?:, )?)+)", drawing):
        for before, after in re.findall(r"([A-Z_]+) -> ([A-Z_]+)", arrows):
            drawn |= {(before, event, after) for event in events.split(" or ")}
    table = {(before.name, event.name, after.name) for (before, event), after in TRANSITIONS.items()}
    assert drawn == {row for row in table if row[1] != "END"}
    assert "on END: every state -> ENDED" in drawing
