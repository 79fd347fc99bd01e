"""Edits of a store by an attacker without its key: audit log, records, dose log and backup; each of 1,000 is found.

Plain digests and checksums are computed again, as anybody can. `python -m tests.hard.test_edits` prints the counts.
"""

import json
import random
import shutil
import sys
import tempfile
import zlib
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pyrage
import pytest

from device.clock import VirtualClock
from device.errors import DiffuscopeError
from services.backup.backup_folder import backup_path, find_folder
from services.backup.backup_key import BackupKey, SecretKey, key_for_recipients, read_header
from services.backup.restore_backup import restore_backup
from services.backup.write_backup import write_backup
from services.records.audit_log import AuditLog
from services.records.dose_ledger_log import LOG
from services.records.record_document import RecordDocument
from services.records.schema import DATABASE
from tests import store_damage
from tests.store_damage import Shown, filled_store, judge, shown
from tests.unit.test_audit_log import DAMAGES, filled
from tests.unit.test_record_key import KEY, edited

IDENTITY = pyrage.x25519.Identity.generate()
TRIALS = {"audit log": 350, "record": 300, "dose log": 150, "backup": 200}


@dataclass(frozen=True)
class Originals:
    """Folders of the audit log, of the store, of its backup and of a forged one; and what the store shows."""

    audit: Path
    store: Path
    stick: Path
    foreign: Path
    before: Shown
    secret: str


def originals(folder: Path) -> Originals:
    store, stick, foreign = (folder / name for name in ("store", "stick", "foreign"))
    shutil.copytree(filled_store(folder / "made", with_log=False, key=KEY), store)
    before, _ = shown(shutil.copytree(store, folder / "shown"), key=KEY)
    for place in (stick, foreign):
        place.mkdir()
    (store / "backup.json").unlink()
    key, quiet = key_for_recipients([str(IDENTITY.to_public())]), lambda done, total: None
    write_backup(store, stick, VirtualClock(), quiet, key)
    foreign_key = BackupKey(header=read_header(find_folder(stick)), secret="0" * 64)
    write_backup(filled_store(folder / "forged", with_log=False), foreign, VirtualClock(), quiet, foreign_key)
    filled(folder / "audit")
    return Originals(folder / "audit", store, stick, foreign, before, key.secret)


def edit_audit_log(its: Originals, folder: Path, source: random.Random) -> tuple[str, bool]:
    shutil.copytree(its.audit, folder)
    damage = source.choice(DAMAGES)
    damage(folder, source)
    return damage.__name__, AuditLog(folder, KEY, VirtualClock()).check().problem is not None


def rewrite_record(folder: Path, paths: list[Path], source: random.Random) -> str:
    """Change one value of a record, with the right digest and the same or a later revision."""
    path = source.choice([path for path in paths if path.suffix == ".json" and path.name != "report.json"])
    entries = json.loads(path.read_bytes())
    document = RecordDocument(
        entries["kind"], entries["revision"] + source.randrange(3), edited(entries["record"], source)
    )
    changed = {"revision": document.revision, "record": document.content, "sha256": document.sha256()}
    path.write_text(json.dumps(entries | changed))
    return str(path.relative_to(folder))


def rewrite_dose(folder: Path, paths: list[Path], source: random.Random) -> str:
    """Change one value of a line of the dose log, with the right checksum; it becomes the last line."""
    lines = [line for line in paths[0].read_bytes().splitlines() if line]
    content = json.dumps(edited(json.loads(source.choice(lines).partition(b" ")[2]), source)).encode()
    paths[0].write_bytes(b"\n".join([*lines, b"%08x %b" % (zlib.crc32(content), content), b""]))
    return LOG


def move_lines(folder: Path, paths: list[Path], source: random.Random) -> str:
    lines = [line for line in paths[0].read_bytes().splitlines() if line]
    source.shuffle(lines)
    paths[0].write_bytes(b"\n".join([*lines[source.randrange(len(lines)) :], b""]))
    return LOG


RECORD_EDITS: dict[str, store_damage.Damage] = {
    "rewritten": rewrite_record,
    "removed": store_damage.remove,
    "truncated": store_damage.truncate,
    "swapped": store_damage.swap,
}
DOSE_EDITS: dict[str, store_damage.Damage] = {
    "rewritten": rewrite_dose,
    "removed": store_damage.remove,
    "truncated": store_damage.truncate,
    "moved": move_lines,
}


def edit_store(
    which: str, kinds: Mapping[str, store_damage.Damage], its: Originals, folder: Path, source: random.Random
) -> tuple[str, bool]:
    """Edit a store, at times without its note of the key; found if no value that it shows differs.

    At times also without its database: found if the store shows what it shows without the rewritten file.
    """
    shutil.copytree(its.store, folder)
    kind = source.choice(["rewritten", "rewritten", *kinds])
    change = kinds[kind](folder, store_damage.targets(folder, which), source)
    if kind == "rewritten" and source.random() < 0.3:
        (folder / "record-key-id").unlink()
    if kind == "rewritten" and which == "files" and source.random() < 0.3:
        without = shutil.copytree(its.store, folder.with_name(f"{folder.name} without"))
        (without / change).unlink()
        for place in (folder, without):
            (place / DATABASE).unlink()
        expected, _ = shown(without, key=KEY)
        shutil.rmtree(without)
        return "rewritten, without database", shown(folder, key=KEY)[0] == expected
    _, violations = judge(folder, its.before, False, KEY)
    return kind, not violations


def forge(stick: Path, its: Originals, source: random.Random) -> None:
    """Add a later backup that was encrypted with the public key, with its objects, or an older one once more."""
    folder, foreign = find_folder(stick), find_folder(its.foreign)
    for path in foreign.rglob("objects/*"):
        shutil.copy(path, folder / "objects")
    forged = source.choice([backup_path(foreign, 1), backup_path(folder, 1)])
    shutil.copy(forged, backup_path(folder, source.randrange(2, 1_000_000)))


def edit_backup(its: Originals, folder: Path, source: random.Random) -> tuple[str, bool]:
    """Edit a backup and restore it: refused, or no value that the restored store shows differs."""
    stick = shutil.copytree(its.stick, folder / "stick")
    kinds: dict[str, Callable[..., object]] = {
        "changed": store_damage.flip_bit,
        "removed": store_damage.remove,
        "truncated": store_damage.truncate,
        "swapped": store_damage.swap,
        "forged": lambda place, _paths, chance: forge(place, its, chance),
    }
    kind = source.choice(list(kinds))
    kinds[kind](stick, [path for path in stick.rglob("*") if path.is_file()], source)
    try:
        key = SecretKey(str(IDENTITY), its.secret)
        result = restore_backup(find_folder(stick), key, folder / "new", lambda done, total: None)
    except DiffuscopeError:
        return kind, kind != "forged"
    after, _ = shown(folder / "new", key=KEY)
    is_whole = (after.captures, after.visits, after.files) == (
        its.before.captures,
        its.before.visits,
        its.before.files,
    )
    if kind == "forged":
        return kind, is_whole and len(result.damaged_backups) == 1
    changed = [id for id, value in after.visits.items() if its.before.visits.get(id) != value]
    changed += [id for id, value in after.files.items() if its.before.files.get(id) != value]
    return kind, not changed and (is_whole or bool(result.damaged_units))


EDITS: dict[str, Callable[[Originals, Path, random.Random], tuple[str, bool]]] = {
    "audit log": edit_audit_log,
    "record": partial(edit_store, "files", RECORD_EDITS),
    "dose log": partial(edit_store, "ledger", DOSE_EDITS),
    "backup": edit_backup,
}


def tried(its: Originals, scratch: Path, planned: tuple[str, int]) -> tuple[str, str, int, bool]:
    target, seed = planned
    folder = scratch / f"{target} {seed}"
    kind, is_found = EDITS[target](its, folder, random.Random(f"{target} {seed}"))
    shutil.rmtree(folder)
    return target, kind, seed, is_found


def run_all(folder: Path, trials: Mapping[str, int]) -> list[tuple[str, str, int, bool]]:
    """Return target, kind, seed, and whether it was found, of each edit; in two processes."""
    its = originals(folder)
    (folder / "scratch").mkdir()
    planned = [(target, seed) for target, number in trials.items() for seed in range(number)]
    with ProcessPoolExecutor(2) as pool:
        return list(pool.map(partial(tried, its, folder / "scratch"), planned, chunksize=10))


@pytest.mark.timeout(900)  # 650 openings of a store, beside other tests
def test_every_edit_of_a_thousand_is_found(tmp_path: Path) -> None:
    found = run_all(tmp_path, TRIALS)
    assert len(found) == 1000
    assert [trial for trial in found if not trial[3]] == []
    assert len({trial[:2] for trial in found}) >= 20, "each kind of edit was tried"


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        results = run_all(Path(scratch), TRIALS)
    counts = Counter((target, kind, is_found) for target, kind, _, is_found in results)
    sys.stdout.write("| target | edit | edits | found |\n|---|---|---|---|\n")
    for target, kind in sorted({(target, kind) for target, kind, _ in counts}):
        hits, misses = counts[target, kind, True], counts[target, kind, False]
        sys.stdout.write(f"| {target} | {kind} | {hits + misses} | {hits} |\n")
    sys.stdout.write("".join(f"missed: {result}\n" for result in results if not result[3]))
