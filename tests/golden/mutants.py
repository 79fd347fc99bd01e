"""Seeded mutants of guard, dose ledger, store, exam and marks of pictures, each with the test that must fail.

Each mutant is one replacement in one file, whose old text occurs there exactly once. `run` applies each mutant to a
copy of the tree.
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
LIMIT_S = 300.0  # a hanging mutant counts as killed
GUARD, LEDGER, BOOK, COPY = (
    "device/light_safety/guard.py",
    "device/light_safety/dose_ledger.py",
    "services/records/dose_ledger_tables.py",
    "services/records/dose_ledger_log.py",
)
STORE, QUARANTINE, EXAM, REQUESTS, STATES, LOOP, LIVE, PIPELINE, PRESS = (
    "services/records/capture_store.py",
    "services/records/quarantine.py",
    "services/instrument/exam.py",
    "services/instrument/exam_requests.py",
    "services/instrument/exam_state.py",
    "services/instrument/exam_loop.py",
    "services/instrument/live_pictures.py",
    "services/instrument/capture_pipeline.py",
    "services/instrument/press_exposure.py",
)
SIGNING, RECOVERY = "services/records/record_signing.py", "services/records/recovery.py"
JOURNAL, WRITER = "services/records/capture_journal.py", "services/records/frame_writer.py"
T_INTERRUPTED, T_WRITER = "tests/journey/test_interrupted_press.py", "tests/unit/test_frame_writer.py"
T_LOG, T_RECOVERY = "tests/unit/test_dose_ledger_log.py", "tests/unit/test_recovery.py"
T_LIGHT = "tests/journey/test_light_requests.py"
T_GUARD, T_BOOK, T_DOSES = (
    "tests/unit/test_guard.py",
    "tests/unit/test_dose_ledger_tables.py",
    "tests/property/test_light_sequences.py",
)
T_RECORDS, T_EXAM, T_TRACE = (
    "tests/unit/test_capture_store.py",
    "tests/journey/test_exam.py",
    "tests/golden/test_golden_exam.py",
)


def exam(name: str) -> str:
    """Return one test of the exam's test file; all of them take half a minute."""
    return f"{T_EXAM}::{name}"


def scenario(name: str) -> str:
    """Return one scenario of the exam's record."""
    return f"{T_TRACE}::test_a_scenario_is_as_recorded[{name}]"


def mark(name: str) -> str:
    """Return one test of the mark of simulated pictures."""
    return f"tests/property/test_simulated_mark.py::test_{name}"


class Mutant(NamedTuple):
    """One changed place: a file, its exact old text, the new text, and the pytest arguments."""

    file: str
    old: str
    new: str
    test: str


MARKS = (  # file, old text, new text, and test of the mark of simulated pictures
    (
        "device/calibration/procedure/raw_recorder.py",
        "write_side_file(path, frame.simulated,",
        "write_side_file(path, False,",
        "raw_frames_of_a_calibration",
    ),
    ("device/calibration/import_psf.py", "simulated=simulated)", "simulated=False)", "calibrations"),
    (
        "device/config/marked_files.py",
        "write_npy(path, picture, simulated)",
        "write_npy(path, picture, False)",
        "reconstruct",
    ),
    ("device/config/marked_files.py", "tiff_bytes(picture, simulated)", "tiff_bytes(picture, False)", "reconstruct"),
    ("device/config/marked_files.py", "simulated and for_eyes", "False", "reconstruct"),
    ("device/config/marked_files.py", "{KEY: _WORDS[simulated]} |", '{KEY: "false"} |', "reconstruct"),
    (
        "device/config/marked_files.py",
        'comment = f"{KEY}={_WORDS[simulated]}"',
        'comment = f"{KEY}=false"',
        "files_of_a_capture",
    ),
    ("device/sim/scene_files.py", "tiff_bytes(counts, True)", "tiff_bytes(counts, False)", "simulate_and_frame"),
    ("device/sim/scene_files.py", "world.truth(colour), True)", "world.truth(colour), False)", "simulate_and_frame"),
    ("device/sim/scene_files.py", "world.shape), True)", "world.shape), False)", "simulate_and_frame"),
    ("device/sim/scene_files.py", "255, True, for_eyes", "255, False, for_eyes", "simulate_and_frame"),
    (
        "services/imaging/picture_files.py",
        "png_bytes(pixels, simulated, texts, note)",
        "png_bytes(pixels, False, texts, note)",
        "reconstruct",
    ),
    (
        "services/imaging/picture_files.py",
        "png_bytes(np.asarray(image), simulated, texts",
        "png_bytes(np.asarray(image), False, texts",
        "export_after_a_correction_of_the_eye",
    ),
    (
        "services/imaging/picture_files.py",
        "jpeg_bytes(np.asarray(image), simulated, quality)",
        "jpeg_bytes(np.asarray(image), False, quality)",
        "files_of_a_capture",
    ),
    (
        "services/imaging/picture_files.py",
        "jpeg_bytes(pixels, simulated, 80)",
        "jpeg_bytes(pixels, False, 80)",
        "live_picture_of_a_calibration",
    ),
    (
        "services/imaging/picture_files.py",
        "tiff_bytes(counts, metadata.simulated,",
        "tiff_bytes(counts, False,",
        "files_of_a_capture",
    ),
    (
        "services/instrument/accuracy_explorer.py",
        "to_png(shown, made.simulated,",
        "to_png(shown, False,",
        "picture_of_another_method",
    ),
    (
        "services/instrument/camera_tap.py",
        "LONGEST_SIDE_PX, frame.simulated)",
        "LONGEST_SIDE_PX, False)",
        "live_picture_of_a_calibration",
    ),
    (
        "services/instrument/capture.py",
        "simulated=frame.simulated)",
        "simulated=False)",
        "encoded_files_of_a_capture",
    ),
    (
        "services/instrument/capture.py",
        "to_png(shown, capture.simulated,",
        "to_png(shown, False,",
        "encoded_files_of_a_capture",
    ),
    (
        "services/instrument/capture.py",
        "to_png(colour, capture.simulated,",
        "to_png(colour, False,",
        "encoded_files_of_a_capture",
    ),
    (
        "services/instrument/capture.py",
        "to_jpeg(shown, THUMBNAIL_PX, capture.simulated)",
        "to_jpeg(shown, THUMBNAIL_PX, False)",
        "encoded_files_of_a_capture",
    ),
    (
        "services/instrument/capture.py",
        "to_jpeg(colour, THUMBNAIL_PX, capture.simulated, window",
        "to_jpeg(colour, THUMBNAIL_PX, False, window",
        "encoded_files_of_a_capture",
    ),
    (
        "services/instrument/capture.py",
        '{"simulated": capture.simulated}',
        '{"simulated": False}',
        "encoded_files_of_a_capture",
    ),
    (
        "services/instrument/capture_pipeline.py",
        "PREVIEW_PX, simulated)",
        "PREVIEW_PX, False)",
        "quick_look_and_live_picture",
    ),
    (
        "services/instrument/capture_pipeline.py",
        "simulated = shot.frame.simulated\n",
        "simulated = False\n",
        "files_of_a_capture",
    ),
    (
        "services/instrument/exam_events.py",
        "to_jpeg(look, THUMBNAIL_PX, simulated)",
        "to_jpeg(look, THUMBNAIL_PX, False)",
        "quick_look_in_progress",
    ),
    (
        "services/instrument/visit_montage.py",
        'to_png(joined.picture, simulated, "montage")',
        'to_png(joined.picture, False, "montage")',
        "montage_of_a_visit",
    ),
    ("services/archive/adopt.py", "to_png(colour, stored.simulated,", "to_png(colour, False,", "adopted_pictures"),
    (
        "services/archive/adopt.py",
        "to_png(picture, stored.simulated,",
        "to_png(picture, False,",
        "adopted_pictures",
    ),
    (
        "services/archive/solve.py",
        "tiff_bytes(made.solved.made.picture, simulated)",
        "tiff_bytes(made.solved.made.picture, False)",
        "pictures_of_an_archive",
    ),
    (
        "services/research/frontier_thumbnails.py",
        ".astype(np.uint8), simulated)",
        ".astype(np.uint8), False)",
        "thumbnails_of_a_frontier",
    ),
    ("services/research/montage_files.py", "joined.picture, simulated)", "joined.picture, False)", "montage"),
    ("services/research/montage_files.py", "KEY: simulated,", "KEY: False,", "montage"),
    ("tests/paper/pictures.py", "png_bytes(grey, True)", "png_bytes(grey, False)", "pictures_of_the_paper"),
    (
        "services/research/reconstruct_burst.py",
        "solved.picture, solved.simulated)",
        "solved.picture, False)",
        "reconstruct_burst",
    ),
    (
        "services/research/reconstruct_capture.py",
        "FileReconstruction(made.picture, report, simulated)",
        "FileReconstruction(made.picture, report, False)",
        "reconstruct_burst",
    ),
    (
        "services/research/reconstruct_burst.py",
        "picture, made.simulated)",
        "picture, False)",
        "reconstruct_channels",
    ),
    (
        "services/research/reconstruct_each.py",
        "made.picture), made.simulated)",
        "made.picture), False)",
        "reconstruct_each",
    ),
    (
        "services/research/reconstruct_file.py",
        "write_picture(place, self.picture, self.simulated)",
        "write_picture(place, self.picture, False)",
        "python",
    ),
    ("services/research/reconstruct_file.py", "made.picture), made.simulated)", "made.picture), False)", "reconstruct"),
    ("services/research/reconstruct_file.py", "{KEY: self.simulated}", "{KEY: False}", "reconstruct"),
    (
        "services/research/reconstruct_inputs.py",
        "if isinstance(source, Raw) else source, SimulatedCounts)",
        "if isinstance(source, Raw) else source, type(None))",
        "python",
    ),
    ("services/workshop/take_frames.py", "simulated=frame.simulated", "simulated=False", "simulate_and_frame"),
)
MUTANTS: tuple[Mutant, ...] = (
    # Guard
    Mutant(GUARD, "  # when it had ended this stretch\n        light.off()\n", "\n", T_GUARD),
    Mutant(GUARD, "self._lit_at_s >= self.max_on_s", "self._lit_at_s > self.max_on_s", T_GUARD),
    Mutant(
        GUARD,
        "        if self._held is not None:\n            raise",
        "        if False:\n            raise",
        T_GUARD,
    ),
    Mutant(GUARD, "if self._debt_s >= self.max_on_s:", "if self._debt_s > 2 * self.max_on_s:", T_GUARD),
    Mutant(GUARD, "max(0.0, self._debt_s - (now_s - self._dark_at_s))", "self._debt_s", T_GUARD),
    Mutant(GUARD, "        self._dark_at_s = now_s  # counts once\n", "", T_GUARD),
    Mutant(GUARD, "        self._timer.start()\n", "", T_GUARD),
    Mutant(GUARD, "if self._late:  # the timer", "if False:  # the timer", T_GUARD),
    Mutant(GUARD, "        self._light.off()\n        self._cut_at_s =", "        self._cut_at_s =", T_GUARD),
    Mutant(GUARD, "self._cut_at_s = self._clock.now_s()", "self._cut_at_s = None", T_GUARD),
    Mutant(GUARD, "self._timer.cancel()", "pass", T_GUARD),
    Mutant(GUARD, "self._debt_s += given_s", "self._debt_s = given_s", T_GUARD),
    Mutant(GUARD, "            self._light.off()\n            raise", "            raise", T_GUARD),
    Mutant(GUARD, "self.max_on_s + LIT_AFTER_KILL_S)", "self.max_on_s)", T_BOOK),
    Mutant(GUARD, "self.ledger.settle(reserved, self.given_j_per_cm2)", "pass", T_BOOK),
    Mutant(GUARD, "        self.hazard.refuse(illumination)\n", "", T_GUARD),
    Mutant(GUARD, "limits.stop_j_per_cm2 if in_visit else", "limits.stop_j_per_cm2 if True else", T_GUARD),
    Mutant(GUARD, "if in_visit or total_j_per_cm2 > limits.stop_j_per_cm2:", "if in_visit:", T_GUARD),
    Mutant(LOOP, "in_visit=target.visit is not None", "in_visit=True", T_LIGHT),
    Mutant(LIVE, "in_visit=wanted.visit is not None", "in_visit=True", T_LIGHT),
    Mutant(LOOP, "in_visit=target.visit is not None", "in_visit=False", T_LIGHT),
    Mutant(LIVE, "in_visit=wanted.visit is not None", "in_visit=False", T_LIGHT),
    # Dose ledger
    Mutant(LEDGER, "if boot == self.boot else 0.0)", "if True else 0.0)", T_BOOK),
    Mutant(LEDGER, "self.left_s(key[1], window_s) <= 0]", "self.left_s(key[1], window_s) <= 2 * SLOT_S]", T_BOOK),
    Mutant(LEDGER, "return (interval + 2) * INTERVAL_S", "return (interval + 3) * INTERVAL_S", T_BOOK),
    Mutant(LEDGER, "self.doses.items() if whose == eye)", "self.doses.items())", T_BOOK),
    Mutant(
        LEDGER,
        "        for eye in eyes:\n            wait_s",
        "        for eye in eyes[:1]:\n            wait_s",
        T_BOOK,
    ),
    Mutant(LEDGER, "        self.add(reserved.eyes, reserved.interval, dose_j_per_cm2)\n", "", T_BOOK),
    Mutant(LEDGER, "given_j_per_cm2 - reserved.dose_j_per_cm2)", "given_j_per_cm2)", T_BOOK),
    Mutant(LEDGER, "total = self.spent(eye) + dose_j_per_cm2\n", "total = self.spent(eye)\n", T_BOOK),
    Mutant(LEDGER, "DailyLightLimit if wait_s > LONGEST_REST_S", "DailyLightLimit if wait_s < LONGEST_REST_S", T_BOOK),
    Mutant(BOOK, "            raise_doses(state, copy)\n", "", T_LOG),
    Mutant(BOOK, "row.eye in EYES else EYES", "row.eye in EYES else ()", T_BOOK),
    Mutant(BOOK, "now_s=state.now_s, observed_s=state.observed_s)", "now_s=state.now_s, observed_s=0.0)", T_LOG),
    Mutant(COPY, "= max(state.doses.get(", "= min(state.doses.get(", T_LOG),
    Mutant(COPY, "for line in reversed(lines):", "for line in lines:", T_LOG),
    # Records
    Mutant(SIGNING, "elif document.sha256() != row.record_sha256:", "elif False:", T_RECOVERY),
    Mutant(RECOVERY, "if signed and in_file.revision > in_rows.revision:", "if False:", T_RECOVERY),
    Mutant(RECOVERY, "schema.schema_checksum(tables) if tables else 0", "checksum", T_RECOVERY),
    # Store
    Mutant(STORE, "if hashlib.sha256(content).hexdigest() != files[name]:", "if False:", T_RECORDS),
    Mutant(STORE, "            self._refuse_duplicate(part, kept)\n", "", T_RECORDS),
    Mutant(
        "services/records/store_space.py",
        "has_room(need_bytes, free, self._reserve_bytes):",
        "has_room(need_bytes, free, 0):",
        T_RECORDS,
    ),
    Mutant(STORE, "if limit < 1:", "if limit < 0:", T_RECORDS),
    Mutant(STORE, "before).kept)", "before).kept - 1)", T_RECORDS),
    Mutant(
        QUARANTINE,
        'stray.name.startswith(".") or not _is_complete(stray)',
        'stray.name.startswith(".")',
        T_RECORDS,
    ),
    Mutant(QUARANTINE, 'stray.name.startswith(".") or not _is_complete(stray)', "not _is_complete(stray)", T_RECORDS),
    Mutant(STORE, "if missing and files_in(", "if False and files_in(", T_RECORDS),
    Mutant(STORE, "        if not (self._captures / capture.id).is_dir():", "        if False:", T_RECORDS),
    Mutant(
        STORE,
        "atomic_io.replace_durably(part, kept)",
        "part.rename(kept)",
        "tests/hard/test_capture_store_kills.py",
    ),
    Mutant(
        STORE,
        "shutil.rmtree(folder, ignore_errors=True)  # a folder that stays",
        "pass  # a folder that stays",
        "tests/hard/test_capture_store_full.py",
    ),
    Mutant(
        STORE,
        "                    if write_rows is not None:",
        "                    if False:",
        "tests/journey/test_idempotency_keys.py",
    ),
    # Exam
    Mutant(
        EXAM,
        "        future.set_running_or_notify_cancel()",
        "        #",
        exam("test_a_press_cannot_be_cancelled_by_a_disconnected_client"),
    ),
    Mutant(
        REQUESTS,
        "            if not self._snapshot.state.accepts_press:",
        "            if False:",
        exam("test_a_second_press_while_one_is_under_way_is_refused_and_the_first_is_kept"),
    ),
    Mutant(
        STATES,
        'MAKING_TWO = "two exposed captures", "busy", 2, False',
        'MAKING_TWO = "two exposed captures", "busy", 2, True',
        exam("test_a_press_is_refused_while_two_exposed_pictures_wait_to_be_made"),
    ),
    Mutant(
        REQUESTS,
        "            self._pending = press\n            self._idempotency_keys.remember(press)",
        "            self._pending = press",
        exam("test_the_same_key_is_the_same_picture_while_it_is_made_and_afterwards"),
    ),
    Mutant(LOOP, "        target.permit()  # again", "        #", "tests/journey/test_consent.py"),
    Mutant(
        LOOP,
        "            on_failure()\n",
        "            pass\n",
        exam("test_a_lamp_that_cannot_be_darkened_ends_the_process"),
    ),
    Mutant(
        LOOP,
        "while not (now := self._requests.snapshot).is_closing or self._exposed:",
        "while not (now := self._requests.snapshot).is_closing:",
        exam("test_close_completes_a_waiting_press_and_refuses_the_next"),
    ),
    Mutant(
        LOOP,
        "        if self._requests.snapshot.has_press:\n            self._expose_during_refinement()",
        "        if False:\n            self._expose_during_refinement()",
        exam("test_a_press_suspends_a_refinement_which_resumes_to_the_same_picture"),
    ),
    Mutant(
        PIPELINE,
        "yield unreconstructed(shot.frame, error)",
        "raise",
        exam("test_a_capture_without_reconstruction_is_stored"),
    ),
    Mutant(LOOP, " journal.fail(id)", " pass", scenario("camera_stalled")),
    Mutant(JOURNAL, '{press.id}.json", digested', '{press.id}.text", digested', scenario("press")),
    Mutant(
        REQUESTS,
        "self._change(replace(self._snapshot, live_until_s=0.0))  # aiming is over",
        "pass  # aiming is over",
        scenario("press_while_aiming"),
    ),
    Mutant(
        LIVE,
        "self._pause(2 * seen.dark_s - seen.exposed_s - self._clock.now_s())",
        "self._pause(0.0)",
        scenario("press_while_aiming"),
    ),
    Mutant(REQUESTS, "            self._live_request = wanted\n", "", "tests/journey/test_consent.py"),
    Mutant(
        PRESS,
        "    head.check()\n    run = _Exposing(",
        "    run = _Exposing(",
        scenario("head_lost"),
    ),
    Mutant(
        PRESS,
        "head.light.on(Illumination(head.spec.light.preview_colour), eyes",
        "head.light.on(Illumination(head.spec.light.colour), eyes",
        scenario("press_while_aiming"),
    ),
    # Interrupted presses
    Mutant(
        LOOP,
        "            press.target.permit()  # the consent may",
        "            pass  # the consent may",
        f"{T_INTERRUPTED}::test_frames_of_a_patient_who_has_declined_since_are_deleted",
    ),
    Mutant(
        WRITER,
        "(file.sha256, file.length_bytes) != ",
        "file.length_bytes != file.length_bytes and ",
        f"{T_WRITER}::test_one_changed_bit_is_not_taken_for_a_frame",
    ),
    Mutant(
        EXAM,
        "            requests.remember(resumption.press)\n",
        "            pass\n",
        f"{T_INTERRUPTED}::test_the_next_start_stores_a_shorter_burst_under_the_same_id_and_key",
    ),
    *(Mutant(file, old, new, mark(test)) for file, old, new, test in MARKS),
)


def run(only: Sequence[int] | None = None) -> int:
    """Run the test of each mutant and print a line for each; return 1 if one survived or its test cannot run."""
    chosen = [number for number in range(1, len(MUTANTS) + 1) if not only or number in only]
    survived = []
    with copied_tree() as tree:
        for number in chosen:
            begin_s = time.monotonic()
            verdict = tried(tree, MUTANTS[number - 1])
            if verdict != "killed":
                survived.append(number)
            mutant = MUTANTS[number - 1]
            took_s = time.monotonic() - begin_s
            sys.stdout.write(
                f"{number:3} {verdict:9} {took_s:5.1f} s  {mutant.file}  {mutant.old.strip()[:40]!r}  {mutant.test}\n"
            )
            sys.stdout.flush()
    sys.stdout.write(f"{len(chosen) - len(survived)} of {len(chosen)} mutants killed\n")
    if survived:
        sys.stdout.write(f"not killed: {', '.join(map(str, survived))}\n")
    return int(bool(survived))


@contextmanager
def copied_tree() -> Iterator[Path]:
    """Yield a copy of the tree with its compiled files."""
    with TemporaryDirectory(prefix="mutants") as place:
        for name in NEEDED:
            source, target = ROOT / name, Path(place) / name
            shutil.copytree(source, target) if source.is_dir() else shutil.copy2(source, target)
        yield Path(place)


def tried(tree: Path, mutant: Mutant) -> str:
    """Return `killed`, `survived`, or `broken` if pytest could not run the test; restore the tree."""
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
    """Return the text with the mutant applied; ValueError unless its old text occurs exactly once."""
    if (count := text.count(mutant.old)) != 1:
        raise ValueError(f"{mutant.file}: {mutant.old!r} occurs {count} times: correct tests/golden/mutants.py")
    return text.replace(mutant.old, mutant.new)
