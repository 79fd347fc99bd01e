"""Plans of a reprocessing run: sources, names by content, what is left out, and refusals."""

from pathlib import Path

import pytest
import tifffile

from device.calibration.archive import Archive, Provenance
from device.clock import VirtualClock
from device.errors import SettingError
from device.values import FrameUse
from services.archive.content import NAME_DIGITS, different_versions, result_name, software
from services.archive.plan import Plan, PlanSettings, read_plan, write_plan
from services.archive.planning import make_plan
from services.archive.result import ResultFolder
from services.archive.solve import CalibrationFiles, Solvers, Task, local_names
from services.archive.stored_reports import earlier_figures
from services.records.capture import Capture, CaptureReport, RecordOrigin
from services.records.capture_store import CaptureStore
from tests.datasets import Scene, simulate_tiny
from tests.scenes import calibration, speckle
from tests.stored_captures import write_store


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return simulate_tiny(tmp_path_factory.mktemp("scene"))


def recording(folder: Path, scene: Scene, frames: int = 3) -> Path:
    folder.mkdir(parents=True)
    tifffile.imwrite(folder / "psf.tiff", scene.psf)
    for k in range(frames):
        tifffile.imwrite(folder / f"eye{k}.tiff", scene.raw + k)
    return folder


def plan_of(*sources: Path, settings: PlanSettings | None = None) -> Plan:
    return make_plan(sources, settings or PlanSettings(rounds=2), VirtualClock(), lambda _: None)


def test_a_plan_lists_each_frame_with_its_digests_and_survives_a_file(scene: Scene, tmp_path: Path) -> None:
    plan = plan_of(recording(tmp_path / "a", scene))
    assert [capture.id for capture in plan.captures] == ["eye0", "eye1", "eye2"]
    assert len(plan.calibrations) == 1
    assert len({capture.result for capture in plan.captures}) == 3
    assert all(len(capture.result) == NAME_DIGITS for capture in plan.captures)
    write_plan(plan, tmp_path / "plan.toml")
    assert read_plan(tmp_path / "plan.toml") == plan


def test_a_name_depends_on_capture_calibration_versions_and_settings() -> None:
    first = result_name([("raw", "a", "")], "c", {"code": "1"}, {"rounds": 1})
    assert first == result_name([("raw", "a", "")], "c", {"code": "1"}, {"rounds": 1})
    others = {
        result_name([("raw", "b", "")], "c", {"code": "1"}, {"rounds": 1}),
        result_name([("raw", "a", ""), ("dark", "d", "")], "c", {"code": "1"}, {"rounds": 1}),
        result_name([("raw", "a", "")], "e", {"code": "1"}, {"rounds": 1}),
        result_name([("raw", "a", "")], "c", {"code": "2"}, {"rounds": 1}),
        result_name([("raw", "a", "")], "c", {"code": "1"}, {"rounds": 2}),
    }
    assert len(others | {first}) == 6


def test_versions_of_another_machine_are_named() -> None:
    assert different_versions(software(), software()) == ""
    assert different_versions({"numpy": "2", "code": "a"}, {"numpy": "3", "code": "a"}) == "numpy 2 expected, 3 found"


def test_a_frame_of_equal_content_is_planned_once(scene: Scene, tmp_path: Path) -> None:
    folder = recording(tmp_path / "a", scene, 2)
    (folder / "eye9.tiff").write_bytes((folder / "eye0.tiff").read_bytes())
    plan = plan_of(folder, recording(tmp_path / "b", scene, 1))
    assert len(plan.captures) == 2
    assert {left_out.reason for left_out in plan.left_out} == {"it has the same content as eye0"}


def test_a_scene_and_own_pairs_are_sources_with_their_truth(scene: Scene, tmp_path: Path) -> None:
    plan = plan_of(scene.folder)
    assert plan.captures[0].truth == str(scene.folder / "truth.npy")
    assert plan.captures[0].raw.endswith("raw.tiff")


def test_an_export_has_no_raw_frames(tmp_path: Path) -> None:
    visit = tmp_path / "exports" / "P1-v1"
    visit.mkdir(parents=True)
    (visit / "visit.json").write_text("{}")
    (visit / "od-1.png").write_bytes(b"")
    plan = plan_of(tmp_path / "exports")
    assert plan.captures == ()
    assert "no raw frame" in plan.left_out[0].reason


def test_a_store_is_read_by_its_records_and_left_as_it_is(scene: Scene, tmp_path: Path) -> None:
    store, made = tmp_path / "store", calibration(speckle(scene.raw.shape))
    kept = Archive(store / "calibrations" / "tiny-head")
    id = kept.add_and_activate(made, Provenance("D1", VirtualClock().wall(), "test", "0"))
    write_store(store, scene.raw, id, ("a", "b"))
    write_store(store, scene.raw, "0123456789abcdef", ("c",))
    (store / "captures" / "b" / "raw.tiff").unlink()
    before = {path: path.stat().st_mtime_ns for path in store.rglob("*")}
    plan = plan_of(store)
    assert {path: path.stat().st_mtime_ns for path in store.rglob("*")} == before
    (planned,) = plan.captures
    assert (planned.id, planned.device, planned.eye) == ("a", "tiny-head", "OD")
    assert planned.dark.endswith("dark.tiff")
    assert plan.calibrations[0].id == id
    assert [left_out.id for left_out in plan.left_out] == ["b", "c"]
    assert "was removed" in plan.left_out[0].reason
    assert "0123456789abcdef is in no source" in plan.left_out[1].reason


def test_calibrations_of_another_folder_are_used(scene: Scene, tmp_path: Path) -> None:
    made = calibration(speckle(scene.raw.shape))
    id = Archive(tmp_path / "kept").add_and_activate(made, Provenance("D1", VirtualClock().wall(), "test", "0"))
    write_store(tmp_path / "store", scene.raw, id, ("a",))
    assert len(plan_of(tmp_path / "store", tmp_path / "kept").captures) == 1


def test_an_empty_frame_is_left_out_and_a_folder_without_psf_says_so(scene: Scene, tmp_path: Path) -> None:
    folder = recording(tmp_path / "a", scene, 2)
    (folder / "eye1.tiff").write_bytes(b"")
    plan = plan_of(folder)
    assert [left_out.reason for left_out in plan.left_out] == ["its raw frame is an empty file"]
    (folder / "psf.tiff").unlink()
    with pytest.raises(SettingError, match=r"2 images, but no psf\.tiff"):
        plan_of(folder)


def test_an_archive_of_none_is_a_plan(tmp_path: Path) -> None:
    (tmp_path / "captures").mkdir()
    assert plan_of(tmp_path).captures == ()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"rounds": 2, "budget_s": 1.0}, "limit the same"),
        ({"rounds": 0}, "cannot be run"),
        ({"budget_s": -1.0}, "not a time"),
        ({"method": "magic"}, "no method"),
    ],
)
def test_impossible_settings_are_refused(settings: dict[str, float | str], message: str, tmp_path: Path) -> None:
    (tmp_path / "captures").mkdir()
    with pytest.raises(SettingError, match=message):
        plan_of(tmp_path, settings=PlanSettings.model_validate(settings))


def test_a_folder_that_is_no_source_is_refused(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "none"):
        with pytest.raises(SettingError):
            plan_of(folder)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "format None"),
        ("format = 9", "format 9"),
        ("format = 1", "is no plan: made_at"),
        ("format = ", "not whole TOML"),
    ],
)
def test_a_damaged_plan_is_refused(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "plan.toml"
    path.write_text(text)
    with pytest.raises(SettingError, match=message):
        read_plan(path)


def test_frames_of_one_name_are_one_capture_in_every_kind_of_folder(scene: Scene, tmp_path: Path) -> None:
    flat, pairs, scenes = recording(tmp_path / "flat", scene, 2), tmp_path / "pairs", tmp_path / "scenes"
    recording(pairs / "raw", scene, 2).joinpath("psf.tiff").rename(pairs / "psf.tiff")
    (scenes / "a").mkdir(parents=True)
    for name in ("raw.tiff", "psf.tiff"):
        (scenes / "a" / name).write_bytes((scene.folder / name).read_bytes())
    for place, stem in ((flat, "eye0"), (pairs / "raw", "eye0"), (scenes / "a", "raw")):
        for k, name in enumerate(("1", "2", "4", "red", "blue")):
            tifffile.imwrite(place / f"{stem}-{name}.tiff", scene.raw + 10 + k)
    for place in (flat, pairs, scenes / "a"):
        tifffile.imwrite(place / "psf-red.tiff", scene.psf)
    for source, first, ids in (
        (flat, "eye0", ["eye0", "eye0-4", "eye1"]),
        (pairs, "eye0", ["eye0", "eye0-4", "eye1"]),
        (scenes, "a", ["a"]),
    ):
        plan = plan_of(source)
        assert [capture.id for capture in plan.captures] == ids
        frames = plan.captures[ids.index(first)].frames
        assert [Path(frame.path).stem.rpartition("-")[2] for frame in frames] == ["1", "2", "red", "blue"]
        assert [frame.colour for frame in frames] == ["", "", "red", "blue"]
        assert [file.role for file in plan.calibrations[0].files] == ["psf", "psf-red"]


def test_captures_of_a_store_are_solved_from_their_plain_content_and_erased_ones_are_not(
    scene: Scene, tmp_path: Path
) -> None:
    store = tmp_path / "store"
    kept = Archive(store / "calibrations" / "tiny-head")
    id = kept.add_and_activate(
        calibration(speckle(scene.raw.shape)), Provenance("D1", VirtualClock().wall(), "test", "0")
    )
    write_store(store, scene.raw, id, ("a", "b"))
    plan, results = plan_of(store, settings=PlanSettings(method="tikhonov")), ResultFolder(tmp_path / "out")
    results.prepare(plan)
    files = CalibrationFiles(tmp_path / "calibrations")
    (planned,) = plan.calibrations
    named = zip(local_names(planned), planned.files, strict=True)
    files.add(planned.digest, {name: Path(file.path).read_bytes() for (_, name), file in named})
    first, second = (Task(capture, planned, plan.settings, plan.software) for capture in plan.captures)
    before = {path: path.stat().st_mtime_ns for path in store.rglob("*")}
    assert Solvers(files).solve(first, results, "worker").failure is None
    assert earlier_figures(first.capture.report)["before_method"] == "none"
    assert {path: path.stat().st_mtime_ns for path in store.rglob("*")} == before
    with CaptureStore(store, reserve_bytes=0) as opened:
        opened.keys.erase("")
    failure = Solvers(files).solve(second, results, "worker").failure
    assert failure is not None
    assert "erased" in failure.reason
    assert earlier_figures(second.capture.report) == {}


def test_a_stored_burst_is_planned_whole_with_what_the_instrument_left_out(scene: Scene, tmp_path: Path) -> None:
    made = calibration(speckle(scene.raw.shape))
    kept = Archive(tmp_path / "calibrations" / "tiny-head")
    id = kept.add_and_activate(made, Provenance("D1", VirtualClock().wall(), "test", "0"))
    uses = tuple(FrameUse(k, k != 1, None, 0.0, "frame quality: shot.moved" if k == 1 else None) for k in range(3))
    report = CaptureReport("variation", frames=uses, device=RecordOrigin(uuid="here"))
    files = {f"{name}.tiff": name.encode() for name in ("raw", "raw-1", "raw-2", "raw-red", "dark")}
    with CaptureStore(tmp_path, reserve_bytes=0) as store:
        for name in ("a", "b"):
            capture = Capture(name, "OD", VirtualClock().wall(), True, id, report, {})
            store.save(capture, files | {"raw.tiff": name.encode(), "report.json": b"{}"})
    (first, second) = plan_of(tmp_path).captures
    assert [(Path(frame.path).name, frame.colour, frame.unusable) for frame in first.frames] == [
        ("raw-1.tiff", "", "frame quality: shot.moved"),
        ("raw-2.tiff", "", ""),
        ("raw-red.tiff", "red", ""),
    ]
    assert first.origin == "here"
    assert first.result != second.result
    (tmp_path / "captures" / "b" / "raw-2.tiff").unlink()
    plan = plan_of(tmp_path)
    assert (len(plan.captures), plan.left_out[0].reason) == (1, "its raw frame raw-2.tiff was removed")


def test_the_name_of_a_result_depends_on_every_frame(scene: Scene, tmp_path: Path) -> None:
    folder = recording(tmp_path / "a", scene, 1)
    names = [plan_of(folder).captures[0].result]
    for k, name in enumerate(("eye0-1", "eye0-red")):
        tifffile.imwrite(folder / f"{name}.tiff", scene.raw + 20 + k)
        names.append(plan_of(folder).captures[0].result)
    tifffile.imwrite(folder / "eye0-1.tiff", scene.raw + 30)
    names.append(plan_of(folder).captures[0].result)
    assert len(set(names)) == 4
