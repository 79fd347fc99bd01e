"""Bodies of the endpoints of the accuracy explorer."""

from services.http.schemas.common import RequestBody, ResponseBody
from services.http.schemas.problems import ErrorText
from services.instrument.measured_frontier import MeasuredFrontier
from services.instrument.time_budget import Pace


class TimeBudgetChoice(RequestBody):
    """Request body: the time budget of a picture, by name."""

    pace: Pace


class AccuracyAnswer(ResponseBody):
    """Last measurement, selected time budget, progress of a running computation (`progress`), and last error.

    `shipped`: the measurement was made on another computer and ships with the simulated head. `paces_s`: time budgets
    in seconds by name. `busy`: a computation is running. `scene`: the simulated scene.
    """

    measured: MeasuredFrontier | None
    shipped: bool
    pace: Pace
    paces_s: dict[Pace, float]
    busy: bool
    progress: str
    scene: str
    problem: ErrorText | None
