"""`diffuscope archive adopt`: the results of a run become later versions of the captures of a store.

The picture that was taken stays as it is. A result that the store has is not adopted again, so the command may be
repeated after any end.
"""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from device.clock import Clock
from device.errors import DiffuscopeError, SettingError
from device.values import Image
from services.archive.plan import Plan, PlannedCapture, read_plan
from services.archive.result import COLOUR_PICTURE, PICTURE, PLAN, ResultFolder, Stored, encoded_document
from services.archive.solve import read_linear
from services.errors import RecordNotFound, VersionRefused
from services.identity.audit_key import find_audit_key
from services.imaging.colour_rendering import render_colour
from services.imaging.picture_files import DISPLAY, to_png
from services.records import schema
from services.records.capture import Capture
from services.records.capture_store import CaptureStore
from services.records.capture_versions import NewVersion, unknown_capture
from services.records.device_identity import read_device
from services.records.earlier_stores import require_store
from services.records.snapshots import refuse_in_use
from services.records.storage_errors import storage_errors

STEP = 100  # captures between two lines of progress


@dataclass(frozen=True)
class Refused:
    """A result that the store did not adopt: the id of its capture, the reason, and a remedy."""

    id: str
    reason: str
    remedy: str


@dataclass(frozen=True)
class Adopted:
    """Numbers of results adopted now and before, number of captures without a result, and the refused results."""

    adopted: int
    known: int
    missing: int
    refused: tuple[Refused, ...]


def adopt_results(folder: Path, store: Path, clock: Clock, progress: Callable[[str], None]) -> Adopted:
    """Store each result below `folder` as a version of its capture in `store`; idempotent.

    `progress` gets lines of text. SettingError for a folder that holds no run, or if its plan or a result is damaged;
    RecordNotFound for a folder that is no store; StoreError while the instrument runs; StoreFull or StoreReadOnly if
    the disk takes no more. What was adopted before an error stays. A result is refused with the reason, and the others
    are adopted, if the store has no such capture, or has it from another device or with other frames.
    """
    if not (folder / PLAN).is_file():
        raise SettingError(f"{folder} holds no run", "Give the folder of diffuscope archive run.")
    require_store(store / schema.DATABASE)
    plan = read_plan(folder / PLAN)
    results = ResultFolder(folder)
    with ExitStack() as undo:
        with storage_errors():
            refuse_in_use(store / schema.DATABASE)
        kept = undo.enter_context(CaptureStore(store, key=find_audit_key(store)))
        return _adopted(plan, results, kept, clock, progress)


def _adopted(
    plan: Plan, results: ResultFolder, store: CaptureStore, clock: Clock, progress: Callable[[str], None]
) -> Adopted:
    made = known = missing = 0
    refused: list[Refused] = []
    for count, planned in enumerate(plan.captures, 1):
        if not results.has(planned.result):
            missing += 1
            continue
        try:
            if _is_adopted(planned, store):
                known += 1
            else:
                _adopt(planned, results, plan.software, store, clock)
                made += 1
        except (RecordNotFound, VersionRefused) as error:
            refused.append(Refused(planned.id, error.message, error.remedy))
        if count % STEP == 0:
            progress(f"{count}/{len(plan.captures)}: {made} adopted, {known} adopted before, {len(refused)} refused")
    return Adopted(made, known, missing, tuple(refused))


def _is_adopted(planned: PlannedCapture, store: CaptureStore) -> bool:
    """Return whether the store has this result; RecordNotFound for a capture that it does not hold."""
    try:
        versions = store.get(planned.id).report.versions
    except RecordNotFound as error:
        own = read_device(store.folder)
        if planned.origin and own is not None and planned.origin != own.uuid:
            raise VersionRefused(
                f"{planned.id} was taken by the device {planned.origin}, and this store is that of {own.uuid}",
                "Adopt it in the store of that device.",
            ) from error
        raise unknown_capture(planned.id) from error
    return any(version.result == planned.result for version in versions)


def _adopt(
    planned: PlannedCapture, results: ResultFolder, software: Mapping[str, str], store: CaptureStore, clock: Clock
) -> None:
    store.space.refuse_without_room()
    capture = store.get(planned.id)
    stored = results.read(planned.result)
    place = results.place(planned.result)
    try:
        picture = _shown(read_linear(place / PICTURE), stored.field_px)
        colour = read_linear(place / COLOUR_PICTURE) if (place / COLOUR_PICTURE).is_file() else None
    except DiffuscopeError as error:
        raise SettingError(error.message, f"Remove {place}, and run the plan again.") from error
    note = f"{capture.eye} {capture.taken_at:%Y-%m-%d}, reconstructed again"
    coloured = None
    if colour is not None:
        colour = render_colour(colour)
        coloured = to_png(colour, stored.simulated, note, stored.predicted, DISPLAY)
    at = clock.wall()
    store.versions.adopt(
        NewVersion(
            capture=capture.id,
            result=planned.result,
            frames=_frames(planned),
            device=planned.origin,
            method=stored.method,
            software=f"{software['diffuscope']} ({software['code']})",
            picture=to_png(picture, stored.simulated, note),
            report=_report(stored, capture),
            colour=coloured,
        ),
        at,
    )


def _shown(picture: Image, field_px: tuple[int, int, int, int]) -> Image:
    """Return the lit field of a picture, as the instrument shows it."""
    top, bottom, left, right = field_px
    return picture[top:bottom, left:right]


def _frames(planned: PlannedCapture) -> dict[str, str]:
    """Return the SHA-256 of the frames by the names that they have in a store."""
    found = {Path(planned.raw).name: planned.raw_sha256}
    found |= {Path(frame.path).name: frame.sha256 for frame in planned.frames}
    return found | ({Path(planned.dark).name: planned.dark_sha256} if planned.dark else {})


def _report(stored: Stored, capture: Capture) -> bytes:
    """Return the report of a version: that of the result, with the slot of the capture."""
    place = {"id": capture.id, "eye": capture.eye, "visit": capture.report.visit, "slot": capture.report.slot}
    return encoded_document(dict(stored.report) | place)
