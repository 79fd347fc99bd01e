"""What a technician asks about accuracy and time on this device."""

from collections.abc import Callable
from typing import Any

from fastapi import APIRouter, Query, Response
from pydantic import BaseModel, ConfigDict

from device.errors import CalibrationMissing
from device.recon.reconstructor import Recipe
from device.values import Calibration
from services.instrument.explorer import Explorer, Kept
from services.instrument.pace import Pace
from services.records.store import Store


class Choice(BaseModel):
    """How long a picture may take, by its name."""

    model_config = ConfigDict(extra="forbid")
    pace: Pace


def explorer_routes(explorer: Explorer, store: Store, calibration: Callable[[], Calibration]) -> APIRouter:
    """Addresses under /api/technician; `calibration` says with what the head sees now."""
    router = APIRouter(prefix="/api/technician")

    @router.get("/explorer")
    def explored() -> dict[str, Any]:
        """What was measured on this device, and what is chosen."""
        return explorer.state()

    @router.post("/explorer", status_code=202)
    def measure() -> dict[str, Any]:
        """Begin to measure every method on this device; minutes, and whoever presses comes first."""
        explorer.measure()
        return explorer.state()

    @router.put("/pace")
    def choose(choice: Choice) -> dict[str, Any]:
        """Let pictures take as long as that, from the next press on."""
        explorer.choose(choice.pace)
        return explorer.state()

    @router.get("/captures/{id}/again.png")
    def again(
        id: str, method: str, bin: int = Query(1, ge=1, le=16), rounds: int | None = Query(None, ge=0, le=1000)
    ) -> Response:
        """A kept capture as another method makes it, with the calibration that is in force now."""
        kept = _kept(store, id, calibration())
        return Response(explorer.picture(kept, Recipe(method, bin, rounds)), media_type="image/png")

    return router


def _kept(store: Store, id: str, seen: Calibration) -> Kept:
    """A capture's frames; CalibrationMissing if the head sees by another calibration now."""
    capture = store.get(id)
    if capture.calibration_id != seen.id:
        raise CalibrationMissing(
            f"{id} was taken with calibration {capture.calibration_id}, and {seen.id} is in force",
            "Choose a picture that was taken since, or go back to that calibration.",
        )
    return Kept(store.read(id, "raw.tiff"), store.read(id, "dark.tiff"), seen, capture.simulated)
