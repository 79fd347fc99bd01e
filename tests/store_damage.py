"""Damage of a store at rest: one change of one file, and what the next opening shows of the data that was stored.

`filled_store` makes a store, `DAMAGES` are the kinds of change, and `judge` opens a damaged copy with the classes that
the program uses, and compares everything that they show with the undamaged store.
"""

import random
import shutil
import sqlite3
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Literal

from sqlalchemy.exc import SQLAlchemyError

from device.calibration.archive import Archive
from device.clock import VirtualClock
from device.errors import CalibrationDamaged, CalibrationMissing, DiffuscopeError
from services.backup.backup_key import KEY_FILE, key_for_recipients, read_key, write_key
from services.errors import BackupDamaged, RecordNotFound, StoreDamaged
from services.identity.users import ROLES, UserTable
from services.records.capture import Capture, CaptureReport, StoredVerdict
from services.records.capture_journal import CaptureJournal, InterruptedCapture
from services.records.capture_store import CaptureStore
from services.records.dose_ledger_log import LOG
from services.records.dose_ledger_tables import DoseLedgerStore
from services.records.patient_keys import FILES as KEYS
from services.records.programme import load_programme
from services.records.quarantine import REQUIRED_FILES
from services.records.upload_queue import UploadQueue, UploadReceipt
from services.records.visit_document import visit_document
from services.records.visit_repository import VisitRepository
from tests.unit.test_archive import WHO, calibration

VISITS = 4
PIN = "274913"
RECIPIENT = "age1zvkyg2lqzraa2lnjvqej32nkuu0ues2s82hzrye869xeexvn73equnujwj"  # a public key of the tests of age
RECORD_FOLDERS = ("captures", "patients", "visits")
WINDOW_S = 86_400.0
FILES = {name: name.encode() * 40 for name in sorted(REQUIRED_FILES)}
Outcome = Literal["whole", "reported"]
PIECE_BYTES = 4096


@dataclass(frozen=True)
class Shown:
    """What a store shows: captures and visits by id, files by (capture, name), doses (J/cm2) by eye, settings."""

    captures: Mapping[str, Capture]
    visits: Mapping[str, str]
    files: Mapping[tuple[str, str], bytes]
    doses: Mapping[str, float]
    settings: Mapping[str, str] = field(default_factory=dict)


def filled_store(folder: Path, *, with_log: bool, key: bytes | None = None) -> Path:
    """Make a store with visits, captures, a correction of an eye, an upload and doses; return its folder.

    `with_log`: copy it while it is open, so that its last rows are in the write-ahead log only. `key`: of the store.
    """
    keys, clock, original = (f"{number:016x}" for number in count()), VirtualClock(), folder / "original"
    with CaptureStore(original, reserve_bytes=0, key=key) as store:
        people = VisitRepository(store.engine, load_programme(), clock)
        light = DoseLedgerStore(store.engine, clock, WINDOW_S, "boot")
        for number in range(VISITS):
            visit = people.begin(next(keys)).id
            answers: dict[str, object] = {"consent": "agreed", "age": 40 + number, "name": f"Name {number}"}
            for name, value in (answers | {"vision_od": "6/9"}).items():
                people.answer(next(keys), visit, name, value)
            for slot, eye in (("R-centre", "OD"), ("L-centre", "OS")):
                key = next(keys)
                target = people.pictures.capture_target(eye, key, visit, slot)
                verdict = StoredVerdict("good", numbers={"level": 0.25 + number})
                report = CaptureReport(visit=visit, slot=slot, verdict=verdict)
                id = f"2026-{number}-{eye}"
                taken = Capture(id, eye, clock.wall(), True, "00ff", report, {})
                store.save(taken, FILES, target.write_rows, target.request)
                people.pictures.accept_capture(next(keys), id)
                light.reserve((eye,), 0.001 * (number + 1), 10.0)
                clock.sleep(1)
            if number:
                people.finish(next(keys), visit)
        people.pictures.correct_laterality(next(keys), "2026-0-OD", "OS", None)
        store.save(Capture("test", "OD", clock.wall(), True, "00ff", CaptureReport(), {}), FILES)
        queue = UploadQueue(store.engine, clock)
        first = queue.queued()[0]
        queue.record_success(first, UploadReceipt("0" * 64, "sha256"))
        CaptureJournal(store).begin(InterruptedCapture("2026-9-OD", "OD", visit, "R-centre", 1), next(keys))
        Archive(original / "calibrations" / "head").add_and_activate(calibration(), WHO)
        UserTable(original / "access").add("Asha", PIN, ROLES)
        write_key(original, key_for_recipients([RECIPIENT]))
        if with_log:
            return shutil.copytree(original, folder / "with log")
    return original


def shown(folder: Path, with_settings: bool = False, key: bytes | None = None) -> tuple[Shown, int]:
    """Open a store as the program does; return what it shows, and the number of records reported as damaged.

    `with_settings`: also the journal, the calibration, the login and the key of the backups.
    """
    clock = VirtualClock(elapsed_s=100.0)
    with CaptureStore(folder, reserve_bytes=0, key=key) as store:
        people = VisitRepository(store.engine, load_programme(), clock)
        light = DoseLedgerStore(store.engine, clock, WINDOW_S, "boot")
        journal = CaptureJournal(store).interrupted
        queue = UploadQueue(store.engine, clock)
        queue.status()
        queue.queued(sizes=True)
        people.counts()
        captures = {capture.id: capture for capture in store.captures(1000)}
        reported = store.damaged() + people.damaged() + len(store.quarantine.orphans()) + len(store.recovery.missing)
        files = {}
        for id, capture in captures.items():
            for name in capture.files:
                try:
                    files[id, name] = store.read(id, name)
                except (StoreDamaged, RecordNotFound):
                    reported += 1
        visits = {visit.id: visit_document(visit).model_dump_json() for visit in people.visits(1000)}
        doses = {eye: light.spent_j_per_cm2(eye) for eye in ("OD", "OS")}
        settings = dict[str, str]()
        if with_settings:
            settings, missing = settings_of(folder, journal)
            reported += missing
        return Shown(captures, visits, files, doses, settings), reported


def settings_of(folder: Path, journal: tuple[InterruptedCapture, ...]) -> tuple[dict[str, str], int]:
    """Return what the other files of a store give, and how many of them are reported as damaged or missing.

    A damaged entry of the journal is reported by its missing visit; nothing in it was acknowledged.
    """
    found, reported = (
        {entry.id: repr(entry) for entry in journal if entry.visit},
        sum(entry.visit is None for entry in journal),
    )
    reads: dict[str, Callable[[], object]] = {
        "calibration": lambda: Archive(folder / "calibrations" / "head").load().calibration.id,
        "login": lambda: UserTable(folder / "access").verify("Asha", PIN),
        "key": lambda: read_key(folder),
    }
    for name, read in reads.items():
        try:
            value = read()
        except (CalibrationDamaged, CalibrationMissing, StoreDamaged, BackupDamaged):
            value = None
        reported += value is None
        if value is not None:
            found[name] = repr(value)
    return found, reported


def expected(store: Path, with_settings: bool = False) -> Shown:
    """Return what an undamaged store shows; a copy of it is opened, because an opening empties the write-ahead log."""
    copy = shutil.copytree(store, store.with_name("expected"))
    before, reported = shown(copy, with_settings)
    assert not reported
    assert len(before.settings) == (4 if with_settings else 0)
    shutil.rmtree(copy)
    return before


def judge(folder: Path, before: Shown, with_settings: bool, key: bytes | None = None) -> tuple[Outcome, list[str]]:
    """Return the outcome of opening a damaged store, and its violations; `with_settings` as in `shown`.

    A violation is a silent loss, a silent change of what is shown, a lower dose, or an exception.
    """
    try:
        after, reported = shown(folder, with_settings, key)
    except (DiffuscopeError, SQLAlchemyError, sqlite3.Error, OSError, ValueError, TypeError, KeyError) as error:
        return "reported", [f"failed start: {type(error).__name__}: {error}"]
    violations = []
    for name in ("captures", "visits", "files", "settings"):
        expected, found = getattr(before, name), getattr(after, name)
        violations += [f"silent change: {name} {key}" for key, value in found.items() if expected.get(key) != value]
        if len(found) < len(expected) and not reported and name != "settings":
            violations.append(f"silent loss: {name} {sorted(expected.keys() - found.keys())}")
    violations += [f"lower dose: {eye}" for eye, dose in before.doses.items() if after.doses[eye] < dose - 1e-9]
    complete = (after.captures, after.visits, after.files) == (before.captures, before.visits, before.files)
    if with_settings:
        complete = complete and after.settings == before.settings
    return ("whole" if complete else "reported"), violations


# Kinds of damage: each changes one file, or swaps two, and returns what it did.

Damage = Callable[[Path, list[Path], random.Random], str]


def flip_bit(folder: Path, paths: list[Path], source: random.Random) -> str:
    path = source.choice([file for file in paths if file.stat().st_size])
    content = bytearray(path.read_bytes())
    place, bit = source.randrange(len(content)), source.randrange(8)
    content[place] ^= 1 << bit
    path.write_bytes(content)
    return f"bit {bit} of byte {place} of {path.relative_to(folder)}"


def truncate(folder: Path, paths: list[Path], source: random.Random) -> str:
    path = source.choice(paths)
    length = source.randrange(path.stat().st_size + 1)
    with path.open("r+b") as file:
        file.truncate(length)
    return f"{path.relative_to(folder)} cut to {length} bytes"


def zero_block(folder: Path, paths: list[Path], source: random.Random) -> str:
    path = source.choice([file for file in paths if file.stat().st_size])
    content = bytearray(path.read_bytes())
    place = source.randrange(0, len(content), PIECE_BYTES)
    piece = content[place : place + PIECE_BYTES]
    content[place : place + PIECE_BYTES] = bytes(len(piece))
    path.write_bytes(content)
    return f"{len(piece)} zeros at {place} of {path.relative_to(folder)}"


def remove(folder: Path, paths: list[Path], source: random.Random) -> str:
    path = source.choice(paths)
    path.unlink()
    return f"{path.relative_to(folder)} removed"


def swap(folder: Path, paths: list[Path], source: random.Random) -> str:
    left, right = source.sample(sorted(paths), 2)
    first, second = left.read_bytes(), right.read_bytes()
    left.write_bytes(second)
    right.write_bytes(first)
    return f"{left.relative_to(folder)} and {right.relative_to(folder)} swapped"


def lose_table(folder: Path, _: list[Path], source: random.Random) -> str:
    """Drop one table, or remove all its rows while no trigger sees it, as damage does."""
    with closing(sqlite3.connect(folder / "store.sqlite", isolation_level=None)) as tables:
        names = [name for (name,) in tables.execute("SELECT name FROM sqlite_schema WHERE type = 'table'")]
        name = source.choice(sorted(set(names) - {"alembic_version"}))
        if source.random() < 0.5:
            tables.execute(f"DROP TABLE {name}")
            return f"table {name} dropped"
        triggers = tables.execute("SELECT name, sql FROM sqlite_schema WHERE type = 'trigger'").fetchall()
        for trigger, _sql in triggers:
            tables.execute(f"DROP TRIGGER {trigger}")
        tables.execute(f"DELETE FROM {name}")
        for _trigger, sql in triggers:
            tables.execute(sql)
    return f"rows of {name} removed"


DAMAGES: dict[str, Damage] = {
    "bit": flip_bit,
    "truncated": truncate,
    "zeros": zero_block,
    "removed": remove,
    "swapped": swap,
    "table": lose_table,
}


def targets(folder: Path, which: str) -> list[Path]:
    """Return the files of a class: "database", "log", "ledger", "files" of records, or "settings" (all others)."""
    every = sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    database = {"database": "store.sqlite", "log": "store.sqlite-wal"}
    if which in database:
        return [path for path in every if path.name == database[which]]
    if which == "ledger":
        return [path for path in every if path.name == LOG]
    of_records = [path for path in every if path.relative_to(folder).parts[0] in RECORD_FOLDERS]
    if which == "files":
        return of_records
    others = {"calibrations", "journal", "access", KEY_FILE, *KEYS}
    return [path for path in every if path.relative_to(folder).parts[0] in others]


@dataclass(frozen=True)
class Planned:
    """A damage of one class of targets, to be made with a seed; `with_log`: of the copy of an open store."""

    damage: str
    target: str
    seed: int

    @property
    def with_log(self) -> bool:
        return self.target == "log"


SHARES = {  # of the trials, in thousandths
    ("bit", "database"): 450,
    ("bit", "log"): 150,
    ("bit", "files"): 150,
    ("bit", "ledger"): 65,
    ("truncated", "database"): 20,
    ("truncated", "log"): 20,
    ("truncated", "files"): 25,
    ("truncated", "ledger"): 10,
    ("zeros", "database"): 20,
    ("zeros", "log"): 15,
    ("zeros", "files"): 15,
    ("zeros", "ledger"): 5,
    ("removed", "files"): 20,
    ("removed", "database"): 2,
    ("removed", "log"): 1,
    ("removed", "ledger"): 2,
    ("swapped", "files"): 20,
    ("table", "database"): 10,
    ("bit", "settings"): 90,
    ("truncated", "settings"): 15,
    ("zeros", "settings"): 10,
    ("removed", "settings"): 10,
    ("swapped", "settings"): 10,
}


def plan(number: int) -> list[Planned]:
    """Return about `number` seeded trials, at least one of each kind."""
    return [
        Planned(damage, target, seed)
        for (damage, target), share in SHARES.items()
        for seed in range(max(1, round(share * number / 1000)))
    ]


@dataclass(frozen=True)
class Trial:
    """One damage, what it changed, and its outcome."""

    damage: str
    target: str
    change: str
    outcome: Outcome
    violations: tuple[str, ...]


def run_trial(stores: Mapping[bool, Path], before: Mapping[bool, Shown], planned: Planned, scratch: Path) -> Trial:
    """Copy the store, damage the copy, open it, every tenth time once more, and return what was found.

    `stores` and `before`: the stores by `with_log`, and what they show undamaged.
    """
    damage, target, seed = planned.damage, planned.target, planned.seed
    folder = shutil.copytree(stores[planned.with_log], scratch / f"{damage}-{target}-{seed}")
    change = DAMAGES[damage](folder, targets(folder, target), random.Random(f"{damage} {target} {seed}"))
    with_settings = target == "settings"
    outcome, violations = judge(folder, before[planned.with_log], with_settings)
    if seed % 10 == 0:
        second, more = judge(folder, before[planned.with_log], with_settings)
        violations += more if second == outcome else [*more, f"the second opening shows another state: {second}"]
    shutil.rmtree(folder)
    return Trial(damage, target, change, outcome, tuple(violations))


def table(trials: list[Trial]) -> str:
    """Return the trials as a table (Markdown): target, damage, number, whole, reported, violations."""
    lines = [
        "| target | damage | trials | all shown unchanged | some reported as damaged | silent or failed |",
        "|---|---|---|---|---|---|",
    ]
    for target, damage in sorted({(trial.target, trial.damage) for trial in trials}):
        some = [trial for trial in trials if (trial.target, trial.damage) == (target, damage)]
        counts = [sum(trial.outcome == outcome for trial in some) for outcome in ("whole", "reported")]
        violations = sum(bool(trial.violations) for trial in some)
        lines.append(f"| {target} | {damage} | {len(some)} | {counts[0]} | {counts[1]} | {violations} |")
    return "\n".join(lines)
