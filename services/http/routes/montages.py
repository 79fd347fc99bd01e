"""Endpoints of the montage of one eye of a visit."""

from dataclasses import asdict

from fastapi import APIRouter

from device.values import Eye
from services.errors import RecordNotFound
from services.http.media import PngResponse, file_responses
from services.http.problem_responses import error_text
from services.http.schemas.visits import MontageAnswer, PlacedPicture
from services.instrument.visit_montage import MontageMaker, VisitMontage
from services.records.visit_repository import VisitRepository


def montage_router(repository: VisitRepository, montages: MontageMaker) -> APIRouter:
    """Return the router of the montages of a visit."""
    router = APIRouter()

    def found(id: str, eye: Eye) -> VisitMontage:
        return montages.montage(repository.get(id), repository.programme, eye)

    @router.get("/api/visits/{id}/montage/{eye}")
    def montage(id: str, eye: Eye) -> MontageAnswer:
        """Return how the chosen pictures of one eye of a visit are joined, and request their montage if it is unknown.

        It is computed beside the exam, never while the camera is used; ask again while `state` is `computing`. 404 for
        an unknown visit, 422 for another eye than OD or OS.
        """
        return montage_answer(found(id, eye))

    @router.get(
        "/api/visits/{id}/montage/{eye}/picture.png", response_class=PngResponse, responses=file_responses("image/png")
    )
    def montage_picture(id: str, eye: Eye) -> PngResponse:
        """Return the montage of one eye of a visit as PNG, around its first picture.

        404 for an unknown visit, or while the `state` of the montage is not `joined`.
        """
        made = found(id, eye).made
        if made is None or made.png is None:
            raise RecordNotFound(f"there is no montage of {eye} in this visit", "Look at the pictures one by one.")
        return PngResponse(made.png)

    return router


def montage_answer(montage: VisitMontage) -> MontageAnswer:
    """Return the state of a montage and the places of its pictures."""
    placed = montage.made.placed if montage.made is not None else ()
    return MontageAnswer(
        state=montage.state,
        digest=montage.digest,
        pictures=len(montage.pictures),
        problem=error_text(montage.problem),
        projection=None if montage.made is None else montage.made.projection,
        placed=[
            PlacedPicture(slot=taken.slot, capture=taken.capture, **asdict(at))
            for taken, at in zip(montage.pictures, placed, strict=False)
        ],
    )
