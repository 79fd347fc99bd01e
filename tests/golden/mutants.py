"""Seeded mutants of guard, dose ledger, store and exam, each with the test that must fail.

Each is one replacement in one file; the old text occurs there exactly once. `run` applies each to a copy of the tree.
"""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
NEEDED = ("device", "services", "web", "tests", "hardware", "pyproject.toml", "CHANGELOG.md")
LIMIT_S = 300.0  # a mutant that hangs is killed too
GUARD, LEDGER, BOOK, COPY = (
    "device/guard.py", "device/ledger.py", "services/records/light_book.py", "services/records/dose_copy.py",
)  # fmt: skip
STORE, EXAM, EXPOSING = "services/records/store.py", "services/instrument/exam.py", "services/instrument/exposing.py"
T_GUARD, T_BOOK, T_DOSES = (
    "tests/unit/test_guard.py", "tests/unit/test_light_book.py", "tests/property/test_light_doses.py",
)  # fmt: skip
T_RECORDS, T_EXAM, T_TRACE = (
    "tests/unit/test_records.py", "tests/journey/test_exam.py", "tests/golden/test_golden_exam.py",
)  # fmt: skip


def exam(name: str) -> str:
    """Return one test of the exam's test file: all of them take half a minute."""
    return f"{T_EXAM}::{name}"


def scenario(name: str) -> str:
    """Return one scenario of the exam's record."""
    return f"{T_TRACE}::test_a_scenario_is_as_recorded[{name}]"


class Mutant(NamedTuple):
    """One changed place: a file, its exact old text, the new text, and what pytest is asked to run."""

    file: str
    old: str
    new: str
    test: str


MUTANTS: tuple[Mutant, ...] = (
    # Guard
    Mutant(GUARD, "  # when it had ended this stretch\n        light.off()\n", "\n", T_GUARD),
    Mutant(GUARD, "self._lit_at_s >= self.max_on_s", "self._lit_at_s > self.max_on_s", T_GUARD),
    Mutant(
        GUARD, "        if self._held is not None:\n            raise",
        "        if False:\n            raise", T_GUARD,
    ),
    Mutant(GUARD, "if self._debt_s >= self.max_on_s:", "if self._debt_s > 2 * self.max_on_s:", T_GUARD),
    Mutant(GUARD, "max(0.0, self._debt_s - (now_s - self._dark_at_s)), now_s", "self._debt_s, now_s", T_GUARD),
    Mutant(GUARD, "- self._dark_at_s)), now_s  # counts once", "- self._dark_at_s)), self._dark_at_s", T_GUARD),
    Mutant(GUARD, "        self._timer.start()\n", "", T_GUARD),
    Mutant(GUARD, "if self._late:  # the timer", "if False:  # the timer", T_GUARD),
    Mutant(GUARD, "        self._light.off()\n        self._cut_at_s =", "        self._cut_at_s =", T_GUARD),
    Mutant(GUARD, "self._cut_at_s = self._clock.now_s()", "self._cut_at_s = None", T_GUARD),
    Mutant(GUARD, "self._timer.cancel()", "pass", T_GUARD),
    Mutant(GUARD, "self._debt_s += given_s", "self._debt_s = given_s", T_GUARD),
    Mutant(GUARD, "            self._light.off()\n            raise", "            raise", T_GUARD),
    Mutant(GUARD, "self.max_on_s + AFTERGLOW_S)", "self.max_on_s)", T_BOOK),
    Mutant(GUARD, "self.ledger.settle(reserved, self.given_j_per_cm2)", "pass", T_BOOK),
    Mutant(GUARD, "        self.hazard.refuse(glow)\n", "", T_GUARD),
    # Dose ledger
    Mutant(LEDGER, "if boot == self.boot:", "if True:", T_BOOK),
    Mutant(LEDGER, "self.left_s(key[1], window_s) <= 0]", "self.left_s(key[1], window_s) <= 2 * SLOT_S]", T_BOOK),
    Mutant(LEDGER, "return (slot + 2) * SLOT_S", "return (slot + 3) * SLOT_S", T_BOOK),
    Mutant(LEDGER, "self.doses.items() if whose == eye)", "self.doses.items())", T_BOOK),
    Mutant(
        LEDGER, "        for eye in eyes:\n            wait_s",
        "        for eye in eyes[:1]:\n            wait_s", T_BOOK,
    ),
    Mutant(LEDGER, "        self.add(reserved.eyes, reserved.slot, dose_j_per_cm2)\n", "", T_BOOK),
    Mutant(LEDGER, "given_j_per_cm2 - reserved.dose_j_per_cm2)", "given_j_per_cm2)", T_BOOK),
    Mutant(LEDGER, "total = self.spent(eye) + dose_j_per_cm2\n", "total = self.spent(eye)\n", T_BOOK),
    Mutant(LEDGER, "LightDay if wait_s > LONGEST_REST_S", "LightDay if wait_s < LONGEST_REST_S", T_BOOK),
    Mutant(BOOK, "            self._copy.higher(page)\n", "", "tests/unit/test_checkpoints.py"),
    Mutant(BOOK, "row.eye in EYES else EYES", "row.eye in EYES else ()", "tests/unit/test_damaged_rows.py"),
    Mutant(BOOK, "now_s=page.now_s, observed_s=page.observed_s)", "now_s=page.now_s, observed_s=0.0)", T_BOOK),
    Mutant(COPY, "= max(page.doses.get(", "= min(page.doses.get(", "tests/unit/test_checkpoints.py"),
    Mutant(COPY, "self._number % 2 * BLOCK_BYTES", "0", "tests/unit/test_checkpoints.py"),
    # Store
    Mutant(STORE, "if hashlib.sha256(content).hexdigest() != files[name]:", "if False:", T_RECORDS),
    Mutant(STORE, "            self._refuse_twice(part, kept)\n", "", T_RECORDS),
    Mutant(STORE, "< need_bytes + self._reserve_bytes:", "< need_bytes:", T_RECORDS),
    Mutant(STORE, "if limit < 1:", "if limit < 0:", T_RECORDS),
    Mutant(STORE, "before).kept)", "before).kept - 1)", T_RECORDS),
    Mutant(
        STORE, 'if stray.name.startswith(".") or not _is_whole(stray)]',
        'if stray.name.startswith(".")]', T_RECORDS,
    ),
    Mutant(STORE, 'if stray.name.startswith(".") or not _is_whole(stray)]', "if not _is_whole(stray)]", T_RECORDS),
    Mutant(STORE, "if missing and any(", "if False and any(", T_RECORDS),
    Mutant(STORE, "        if not (self._captures / capture.id).is_dir():", "        if False:", T_RECORDS),
    Mutant(
        STORE, "                disk.settle(self._captures)\n                with",
        "                with", "tests/hard/test_keep_kill.py",
    ),
    Mutant(
        STORE, "shutil.rmtree(folder, ignore_errors=True)  # what stays",
        "pass  # what stays", "tests/hard/test_keep_full.py",
    ),
    Mutant(
        STORE, "                    if beside is not None:",
        "                    if False:", "tests/journey/test_request_keys.py",
    ),
    # Exam
    Mutant(
        EXAM, "            future.set_running_or_notify_cancel()",
        "            #", exam("test_a_press_cannot_be_cancelled_by_a_page_that_goes_away"),
    ),
    Mutant(
        EXAM, "            if self._is_busy():",
        "            if False:", exam("test_a_second_press_while_one_is_under_way_is_refused_and_the_first_is_kept"),
    ),
    Mutant(
        EXAM, " or self._in_the_making == SEATS",
        "", exam("test_a_press_is_refused_while_two_exposed_pictures_wait_to_be_made"),
    ),
    Mutant(
        EXAM, "self._pressed.remember(key, self._press)",
        "pass", exam("test_the_same_key_is_the_same_picture_while_it_is_made_and_afterwards"),
    ),
    Mutant(EXAM, "            press.errand.permit()  # again", "            #", "tests/journey/test_consent.py"),
    Mutant(
        EXAM, "                self._died()\n",
        "                pass\n", exam("test_a_lamp_that_cannot_be_darkened_ends_the_process"),
    ),
    Mutant(
        EXAM, "while not self._closing or self._exposed:",
        "while not self._closing:", exam("test_closing_answers_a_press_that_waits_and_refuses_the_next"),
    ),
    Mutant(
        EXAM, "        if self._press is not None and not self._closing:\n            self._let_in()",
        "        if False:\n            self._let_in()",
        exam("test_a_press_pauses_a_refinement_which_then_goes_on_to_the_same_picture"),
    ),
    Mutant(
        EXAM, "made = unmade(shot.frame, error)",
        "raise", exam("test_a_shot_of_which_no_picture_can_be_made_is_kept_as_it_is"),
    ),
    Mutant(EXAM, "            self._over(id, kept=False)\n", "", scenario("camera_stalled")),
    Mutant(EXAM, "            self.underway.begin(press.under_way(id), press.key)\n", "", scenario("press")),
    Mutant(
        EXAM, "self._wanted_until_s = 0.0  # aiming is over",
        "pass  # aiming is over", scenario("press_while_aiming"),
    ),
    Mutant(
        EXAM, "self._pause(2 * dark_s - self._preview.exposed_s - self.clock.now_s())",
        "self._pause(0.0)", scenario("press_while_aiming"),
    ),
    Mutant(EXAM, "            self._wanted = wanted\n", "", "tests/journey/test_consent.py"),
    Mutant(
        EXPOSING, "    head.check()\n    shot = Shot(head.spec.camera.exposure_s)",
        "    shot = Shot(head.spec.camera.exposure_s)", scenario("head_lost"),
    ),
    Mutant(
        EXPOSING, "head.light.on(Glow(head.spec.light.preview_colour), eyes)",
        "head.light.on(Glow(head.spec.light.colour), eyes)", scenario("press_while_aiming"),
    ),
)  # fmt: skip


def run(only: Sequence[int] | None = None) -> int:
    """Run the test of each mutant, print a line for each, and return 1 if one survived or its test cannot be run."""
    chosen = [number for number in range(1, len(MUTANTS) + 1) if not only or number in only]
    survived = []
    with copied_tree() as tree:
        for number in chosen:
            begin_s = time.monotonic()
            verdict = tried(tree, MUTANTS[number - 1])
            if verdict != "killed":
                survived.append(number)
            one = MUTANTS[number - 1]
            took_s = time.monotonic() - begin_s
            sys.stdout.write(
                f"{number:3} {verdict:9} {took_s:5.1f} s  {one.file}  {one.old.strip()[:40]!r}  {one.test}\n"
            )
            sys.stdout.flush()
    sys.stdout.write(f"{len(chosen) - len(survived)} of {len(chosen)} mutants killed\n")
    if survived:
        sys.stdout.write(f"not killed: {', '.join(map(str, survived))}\n")
    return int(bool(survived))


@contextmanager
def copied_tree() -> Iterator[Path]:
    """Give a copy of the tree, with what was compiled of it."""
    with TemporaryDirectory(prefix="mutants") as place:
        for name in NEEDED:
            source, target = ROOT / name, Path(place) / name
            shutil.copytree(source, target) if source.is_dir() else shutil.copy2(source, target)
        yield Path(place)


def tried(tree: Path, mutant: Mutant) -> str:
    """Return `killed`, `survived`, or `broken` where pytest could not run the test at all; the tree is as before."""
    path = tree / mutant.file
    before, stat = path.read_text(encoding="utf-8"), path.stat()
    path.write_text(mutated(before, mutant), encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-x", "--no-header", "-p", "no:cacheprovider", mutant.test]
    own = os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(command, cwd=tree, env=own, capture_output=True, timeout=LIMIT_S, check=False)
        status = done.returncode
    except subprocess.TimeoutExpired:
        status = 1
    finally:
        path.write_text(before, encoding="utf-8")
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    return {0: "survived", 1: "killed"}.get(status, "broken")


def mutated(text: str, mutant: Mutant) -> str:
    """Return the text with the mutant in it; ValueError unless its old text occurs exactly once."""
    if (count := text.count(mutant.old)) != 1:
        raise ValueError(f"{mutant.file}: {mutant.old!r} occurs {count} times: correct tests/golden/mutants.py")
    return text.replace(mutant.old, mutant.new)
