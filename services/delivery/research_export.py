"""Research export: pictures, raw frames and answers without what identifies a patient, by lists of what may be in it.

A folder for each finished visit with consent: `visit.json`, and of each capture the pictures as taken, raw frames with
the id of their calibration, and the report. There is no table of the pseudonyms, and their order says nothing.
"""

import dataclasses
import json
import secrets
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress

from device.clock import SystemClock
from device.values import Report
from services.errors import RecordRemoved
from services.imaging.picture_files import raw_tiff, read_raw_tiff, with_note
from services.records.capture import COLOUR, Capture
from services.records.capture_store import CaptureStore
from services.records.programme import load_programme
from services.records.visit import Visit
from services.records.visit_repository import VisitRepository

ANSWERS = ("age", "sex", "diabetes", "diabetes_years", "vision_od", "vision_os", "glasses", "complaints")
REPORT = {field.name for field in dataclasses.fields(Report)} - {"warnings"} | {"slot", "verdict"}  # no free text
MAX_AGE_YEARS = 90  # older patients are rare enough to be known by their age


def research_folders(store: CaptureStore) -> Iterator[tuple[str, dict[str, bytes]]]:
    """Yield name and files of the folder of each visit: random pseudonym of its patient, and number of the visit.

    StoreDamaged if a visit or file is damaged; raw frames that were removed are left out.
    """
    repository = VisitRepository(store.engine, load_programme(), SystemClock())
    taken = defaultdict[str, list[Capture]](list)
    for capture in reversed(store.captures(sys.maxsize)):
        if capture.report.visit is not None:
            taken[capture.report.visit].append(capture)
    visits = [
        visit for visit in map(repository.get, taken) if visit.finished_at and visit.fields.get("consent") == "agreed"
    ]
    pseudonyms = {visit.patient_id: secrets.token_hex(8) for visit in visits}
    numbers = Counter[str]()
    for visit in sorted(visits, key=lambda visit: (pseudonyms[visit.patient_id], visit.begun_at)):
        numbers[visit.patient_id] += 1
        yield f"{pseudonyms[visit.patient_id]}-{numbers[visit.patient_id]}", _files(store, visit, taken[visit.id])


def _files(store: CaptureStore, visit: Visit, captures: Sequence[Capture]) -> dict[str, bytes]:
    answers = {name: visit.fields[name] for name in ANSWERS if name in visit.fields}
    if isinstance(age := answers.get("age"), int):
        answers["age"] = min(age, MAX_AGE_YEARS)
    outcome = None if visit.outcome is None else visit.outcome.code
    files = {"visit.json": json.dumps({"year": visit.begun_at.year, "fields": answers, "outcome": outcome}).encode()}
    for number, capture in enumerate(captures, 1):
        for name in capture.files:
            with suppress(RecordRemoved):
                if (content := _anonymised(store, capture, name)) is not None:
                    files[f"{number}-{name}"] = content
        report = {name: value for name, value in capture.report.as_json().items() if name in REPORT}
        more = {"eye": capture.eye, "simulated": capture.simulated, "calibration_id": capture.calibration_id}
        files[f"{number}-report.json"] = json.dumps(report | more).encode()
    return files


def _anonymised(store: CaptureStore, capture: Capture, name: str) -> bytes | None:
    """Return a picture or raw frame with other texts in its file, None for any other file."""
    if name in ("picture.png", COLOUR):
        return with_note(store.read(capture.id, name), capture.eye)
    if not name.endswith(".tiff"):
        return None
    counts, metadata = read_raw_tiff(store.read(capture.id, name))
    return raw_tiff(counts, dataclasses.replace(metadata, id=None, taken_at=None, head=None))
