"""Endpoints of the accuracy explorer: measured frontier of accuracy and time, time budget, recomputed pictures."""

from collections.abc import Callable

from fastapi import APIRouter, Query

from device.errors import CalibrationMissing
from device.recon.stage import Recipe
from device.values import Calibration
from services.http.media import PngResponse, SvgResponse, file_responses
from services.http.schemas.accuracy import AccuracyAnswer, TimeBudgetChoice
from services.instrument.accuracy_explorer import AccuracyExplorer, StoredCapture
from services.records.capture_store import CaptureStore

PNG = file_responses("image/png")
SVG = file_responses("image/svg+xml")


def accuracy_routes(
    explorer: AccuracyExplorer, store: CaptureStore, calibration: Callable[[], Calibration]
) -> APIRouter:
    """Return the router of the accuracy explorer under /api/technician; `calibration` returns the one in use."""
    router = APIRouter(prefix="/api/technician")
    router.include_router(_accuracy_router(explorer))

    @router.get("/captures/{id}/again.png", response_class=PngResponse, responses=PNG)
    def reconstruct_again(
        id: str, method: str, bin: int = Query(1, ge=1, le=16), rounds: int | None = Query(None, ge=0, le=1000)
    ) -> PngResponse:
        """Reconstruct a stored capture with another method and return it as PNG.

        `bin` is the binning, `rounds` the number of iterations (default: the method's own). Uses the calibration in
        use. 404 for an unknown capture, 409 while another measurement or picture is computed, 422 for an unknown
        method, 423 if the capture was taken with another calibration.
        """
        frames = _stored_frames(store, id, calibration())
        return PngResponse(explorer.reconstruct(frames, Recipe(method, bin, rounds)))

    return router


def _accuracy_router(explorer: AccuracyExplorer) -> APIRouter:
    """Return the router of the measurement and of the time budget."""
    router = APIRouter()

    @router.get("/accuracy")
    def accuracy() -> AccuracyAnswer:
        """Return the measured accuracy and time of every method on this device, and the chosen time budget."""
        return accuracy_answer(explorer)

    @router.get("/accuracy.svg", response_class=SvgResponse, responses=SVG)
    def plot() -> SvgResponse:
        """Return the plot of the measured accuracy and time as SVG; 404 before a measurement."""
        return SvgResponse(explorer.plot())

    @router.post("/accuracy", status_code=202)
    def measure() -> AccuracyAnswer:
        """Start to measure every method on this device, in the background.

        The measurement takes about a minute; captures have priority. Answers 202 with the state; 409 while another
        measurement or picture is computed.
        """
        explorer.measure()
        return accuracy_answer(explorer)

    @router.put("/pace")
    def choose(choice: TimeBudgetChoice) -> AccuracyAnswer:
        """Set the time budget of pictures, from the next capture on; 422 for an unknown name."""
        explorer.choose(choice.pace)
        return accuracy_answer(explorer)

    return router


def accuracy_answer(explorer: AccuracyExplorer) -> AccuracyAnswer:
    """Return the state of the accuracy explorer."""
    return AccuracyAnswer.model_validate(explorer.state())


def _stored_frames(store: CaptureStore, id: str, seen: Calibration) -> StoredCapture:
    """Return the stored frames of a capture; CalibrationMissing unless it was taken with the calibration `seen`."""
    capture = store.get(id)
    if capture.calibration_id != seen.id:
        raise CalibrationMissing(
            f"{id} was taken with calibration {capture.calibration_id}, and {seen.id} is in force",
            "Choose a picture that was taken since, or go back to that calibration.",
        )
    return StoredCapture(store.read(id, "raw.tiff"), store.read(id, "dark.tiff"), seen, capture.simulated)
