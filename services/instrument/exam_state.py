"""States of the exam, the events that change them, and the one function that applies an event.

The diagram is that of the table; a test draws it and compares it with this docstring.

    stateDiagram-v2
        [*] --> STARTING
        state running {
            STARTING --> STARTING_PRESSED : PRESS
            STARTING --> AIM : PLANNED
            STARTING_PRESSED --> PRESSED : PLANNED
            AIM --> PRESSED : PRESS
            AIM --> MAKING : RESUMED
            PRESSED --> EXPOSING : EXPOSE
            PRESSED --> MAKING_PRESSED : RESUMED
            EXPOSING --> AIM : EXPOSURE_FAILED
            EXPOSING --> MAKING : EXPOSED
            MAKING --> AIM : STORED or FAILED
            MAKING --> MAKING_PRESSED : PRESS
            MAKING_PRESSED --> PRESSED : STORED or FAILED
            MAKING_PRESSED --> MAKING_EXPOSING : EXPOSE
            MAKING_EXPOSING --> MAKING : EXPOSURE_FAILED
            MAKING_EXPOSING --> MAKING_TWO : EXPOSED
            MAKING_TWO --> MAKING : STORED or FAILED
        }
        running --> ENDED : END
"""

from enum import Enum, auto
from typing import Literal

WireState = Literal["starting", "aim", "busy", "making"]  # what status, events and systemd show


class ExamState(Enum):
    """State of the exam: the capture that is being made, and the press that waits or is exposed beside it.

    Each state has its `wire_state`, `captures` (number of captures in progress, 0 to 2) and whether it `accepts_press`.
    Its text differs from that of each state with equal attributes, which would be an alias without it.
    """

    STARTING = "FFT plans are made", "starting", 0, True
    STARTING_PRESSED = "FFT plans are made, and a press waits for them", "starting", 1, False
    AIM = "live pictures on request", "aim", 0, True
    PRESSED = "a press waits for its exposure", "busy", 1, False
    EXPOSING = "frames of a press: dark, lit, other colours", "busy", 1, False
    MAKING = "one exposed capture: reconstruction and storage", "making", 1, True
    MAKING_PRESSED = "one exposed capture, and a press waits for its exposure", "busy", 2, False
    MAKING_EXPOSING = "one exposed capture, suspended during the exposure of a press", "busy", 2, False
    MAKING_TWO = "two exposed captures", "busy", 2, False
    ENDED = "no further exposure; waiting presses are answered; the last state stays on the wire", None, 0, False

    def __init__(self, _: str, wire_state: WireState | None, captures: int, accepts_press: bool) -> None:
        self.wire_state, self.captures, self.accepts_press = wire_state, captures, accepts_press

    @property
    def has_press(self) -> bool:
        """Whether an accepted press waits for its exposure."""
        return self in (ExamState.STARTING_PRESSED, ExamState.PRESSED, ExamState.MAKING_PRESSED)


class ExamEvent(Enum):
    """Event that changes the state of the exam."""

    PRESS = auto()  # a press is accepted
    PLANNED = auto()  # the FFT plans are made
    EXPOSE = auto()  # the exposure of the waiting press begins
    EXPOSED = auto()  # its frames are taken and wait for their reconstruction
    RESUMED = auto()  # the frames of a press that a kill has interrupted wait for their reconstruction
    EXPOSURE_FAILED = auto()  # its press has failed, nothing is stored
    STORED = auto()  # the exposed capture is stored
    FAILED = auto()  # the exposed capture is lost: its press has failed
    END = auto()  # the exam closes or stops


_RUNNING = tuple(state for state in ExamState if state is not ExamState.ENDED)
TRANSITIONS: dict[tuple[ExamState, ExamEvent], ExamState] = {
    (ExamState.STARTING, ExamEvent.PRESS): ExamState.STARTING_PRESSED,
    (ExamState.STARTING, ExamEvent.PLANNED): ExamState.AIM,
    (ExamState.STARTING_PRESSED, ExamEvent.PLANNED): ExamState.PRESSED,
    (ExamState.AIM, ExamEvent.PRESS): ExamState.PRESSED,
    (ExamState.AIM, ExamEvent.RESUMED): ExamState.MAKING,
    (ExamState.PRESSED, ExamEvent.EXPOSE): ExamState.EXPOSING,
    (ExamState.PRESSED, ExamEvent.RESUMED): ExamState.MAKING_PRESSED,
    (ExamState.EXPOSING, ExamEvent.EXPOSURE_FAILED): ExamState.AIM,
    (ExamState.EXPOSING, ExamEvent.EXPOSED): ExamState.MAKING,
    (ExamState.MAKING, ExamEvent.STORED): ExamState.AIM,
    (ExamState.MAKING, ExamEvent.FAILED): ExamState.AIM,
    (ExamState.MAKING, ExamEvent.PRESS): ExamState.MAKING_PRESSED,
    (ExamState.MAKING_PRESSED, ExamEvent.STORED): ExamState.PRESSED,
    (ExamState.MAKING_PRESSED, ExamEvent.FAILED): ExamState.PRESSED,
    (ExamState.MAKING_PRESSED, ExamEvent.EXPOSE): ExamState.MAKING_EXPOSING,
    (ExamState.MAKING_EXPOSING, ExamEvent.EXPOSURE_FAILED): ExamState.MAKING,
    (ExamState.MAKING_EXPOSING, ExamEvent.EXPOSED): ExamState.MAKING_TWO,
    (ExamState.MAKING_TWO, ExamEvent.STORED): ExamState.MAKING,
    (ExamState.MAKING_TWO, ExamEvent.FAILED): ExamState.MAKING,
} | {(state, ExamEvent.END): ExamState.ENDED for state in _RUNNING}


def transition(state: ExamState, event: ExamEvent) -> ExamState:
    """Return the state after an event; RuntimeError if the table has no entry for this pair (a program error)."""
    try:
        return TRANSITIONS[state, event]
    except KeyError:
        raise RuntimeError(f"{event.name} is not declared in the state {state.name}") from None
