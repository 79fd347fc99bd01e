"""Stores with a patient who is erased, and another one who is not.

Run as a script, this file is the victim of kills: it forks for each copy of a store, and the child erases ZQ-77120 in
it until its process ends within the modules of the erasure, after a given number of lines.
"""

import os
import sys
from collections.abc import Mapping
from itertools import count
from pathlib import Path
from types import FrameType
from typing import Any

from device import atomic_io
from device.clock import VirtualClock
from services.identity.audit_key import load_or_create_audit_key
from services.records import blobs, erasure, patient_keys
from services.records.capture import Capture, CaptureReport
from services.records.capture_journal import CaptureJournal, InterruptedCapture
from services.records.capture_store import CaptureStore
from services.records.export_records import ExportRecords
from services.records.patient_rows import patient_of_visit
from services.records.programme import load_programme
from services.records.removed_captures import Removal
from services.records.visit_repository import VisitRepository

CLOCK = VirtualClock()
NUMBER, OTHER = "ZQ-77120", "ZQ-31415"
PEOPLE: Mapping[str, Mapping[str, str]] = {
    NUMBER: {"name": "Meenakshisundaram", "phone": "9840012345", "village": "Thiruppullani"},
    OTHER: {"name": "Venkataraghavan", "phone": "9444098765", "village": "Uthirakosamangai"},
}
NAMES = ("raw.tiff", "dark.tiff", "picture.png", "quick.jpg", "report.json")
WATCHED = {erasure.__file__, patient_keys.__file__, atomic_io.__file__}


def capture_id(number: str, visit: int) -> str:
    """Return the id of a capture, which does not hold the number of the patient."""
    return f"2026-{list(PEOPLE).index(number)}-{visit}-OD"


def plain_files(number: str, visit: int) -> dict[str, bytes]:
    """Return the files of a capture: 2,000 bytes each that no other file has."""
    return {name: f"{number} {visit} {name} ".encode() * 80 for name in NAMES}


def opened(folder: Path) -> CaptureStore:
    """Open a store that `filled` made, or make a new one."""
    return CaptureStore(folder, reserve_bytes=0, key=load_or_create_audit_key(folder))


def repository(store: CaptureStore) -> VisitRepository:
    return VisitRepository(store.engine, load_programme(), CLOCK)


def filled(folder: Path) -> Path:
    """Make a store of two patients with two visits each: removed, incomplete, interrupted and exported captures."""
    keys = (f"{number:016x}" for number in count(1))
    with opened(folder) as store:
        people = repository(store)
        for number, fields in PEOPLE.items():
            for which in range(2):
                visit = people.begin(next(keys), number).id
                for name, value in (fields | {"consent": "agreed", "name": fields["name"] + "x" * which}).items():
                    people.answer(next(keys), visit, name, value)
                key = next(keys)
                target = people.pictures.capture_target("OD", key, visit, "R-centre")
                report = CaptureReport(visit=visit, slot="R-centre")
                taken = Capture(capture_id(number, which), "OD", CLOCK.wall(), True, "00ff", report, {})
                store.save(taken, plain_files(number, which), target.write_rows, target.request)
                people.finish(next(keys), visit)
                CLOCK.sleep(1)
            ExportRecords(store.folder).write(visit, CLOCK.wall(), CLOCK.wall())
            people.requests.run_once(next(keys), f"export {visit} stick", lambda visit=visit: f"stick/{visit}-2")
            store.removed.remove([capture_id(number, 0)], Removal("exported", CLOCK.wall()))
            CaptureJournal(store).begin(
                InterruptedCapture(capture_id(number, 9), "OD", visit, "R-centre", 1), next(keys)
            )
            patient = patient_of_visit(store.engine, visit)
            encrypted = {"frame-0.tiff": blobs.encrypted(store.keys, patient, plain_files(number, 9)["raw.tiff"])}
            for place in (f"journal/{capture_id(number, 9)}", f"quarantine/{capture_id(number, 8)}"):
                atomic_io.write_folder(store.folder / place, encrypted)
            atomic_io.make_folder(store.folder / "conflicts")
            atomic_io.write_file(store.folder / "conflicts" / f"visit-{visit}-3-00000000.json", b"{}")
    return folder


def _end_after(lines: int) -> Any:
    """Return a trace function that ends the process after a number of lines of WATCHED; 0: never, they are printed."""
    seen = 0

    def trace(frame: FrameType, event: str, _: object) -> Any:
        nonlocal seen
        if frame.f_code.co_filename not in WATCHED:
            return None
        seen += event == "line"
        if lines and seen == lines:
            os._exit(9)
        return trace

    sys.settrace(trace)
    return lambda: seen


def _erase_until(folder: Path, lines: int) -> None:
    with opened(folder) as store:
        seen = _end_after(lines)
        store.erasures.erase(NUMBER, "requested", CLOCK.wall())
        sys.settrace(None)
        sys.stdout.write(str(seen()))


if __name__ == "__main__":
    for argument in sys.argv[1:]:
        folder, _, lines = argument.rpartition(":")
        if (child := os.fork()) == 0:
            _erase_until(Path(folder), int(lines))
            sys.stdout.flush()
            os._exit(0)
        os.waitpid(child, 0)
