"""A tried version is judged by its page, and an update waits for an examination: RAUC is real, the page is made up.

What a real instrument answers is in `test_versions.py`; here it hangs, is ill, examines, or has an empty battery.
"""

from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import pytest

from device.clock import SystemClock
from device.errors import UpdateAtRisk, UpdateDuringExam, UpdateError, UpdateFailed, UpdatePowerLow, UpdateWrongDevice
from services.update.updater import Updater
from tests.appliance import bench as benches
from tests.appliance import releases
from tests.appliance.bench import Bench
from tests.appliance.instrument import Page, check, served

pytestmark = [pytest.mark.systemd, pytest.mark.timeout(60)]


@pytest.fixture
def page() -> Iterator[Page]:
    with served() as page:
        yield page


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> tuple[releases.Workshop, Path]:
    workshop = releases.opened(tmp_path_factory.mktemp("workshop"))
    return workshop, workshop.small("two", "2.0")


@pytest.fixture
def bench(two: tuple[releases.Workshop, Path], tmp_path: Path) -> Iterator[Bench]:
    with benches.opened(tmp_path / "bench", two[0]) as bench:
        yield bench


def updater(bench: Bench, page: Page, runs: str) -> Updater:
    settings = bench.settings(instrument=page.at, answer_s=0.3, patience_s=2.5)
    return Updater(settings, SystemClock(), bench.said.append, bench.chooser, runs)


def tried(bench: Bench, page: Page, bundle: Path) -> Updater:
    """Version 2.0 is installed and its slot boots for the first time."""
    with bench.service():
        updater(bench, page, "1.0").install(bundle)
    assert bench.boot() == "B"
    return updater(bench, page, "2.0")


def test_a_version_that_is_well_is_committed(bench: Bench, page: Page, two: tuple[object, Path]) -> None:
    second = tried(bench, page, two[1])
    with bench.service():
        second.settle()
    assert (bench.chooser.committed(), second.status()[1]) == (
        "B", "Updated to 2.0. It was tried, found well, and stays.",
    )  # fmt: skip
    second.settle()  # the next boots have nothing to settle
    assert bench.said[-1] == "Version 2.0 is committed already."


@pytest.mark.parametrize("how", ["hangs", "ill", "blind", "for ever starting"])
def test_a_version_that_is_not_well_goes_back_and_says_why(
    bench: Bench, page: Page, two: tuple[object, Path], how: str
) -> None:
    second = tried(bench, page, two[1])
    match how:
        case "hangs":
            page.hangs, why = True, "page: does not answer"
        case "ill":
            page.checks, why = [check("captures", ok=False)], "captures: broken. Mend it first."
        case "blind":
            page.sees, why = False, "picture: none came"
        case _:
            page.state, page.checks, why = "starting", [check("camera", ok=False)], "camera: broken"
    with bench.service(), pytest.raises(UpdateFailed):
        second.settle()
    assert bench.boot() == "A"
    said = updater(bench, page, "1.0").status()[1]
    assert said.startswith("Version 1.0 runs. Version 2.0 was tried and was not well, so 1.0 is back: ")
    assert why in said
    assert not bench.chooser.is_good("B")


def test_a_camera_that_was_broken_before_is_not_blamed_on_the_update(
    bench: Bench, page: Page, two: tuple[object, Path]
) -> None:
    page.checks, page.sees = [check("camera", ok=False), check("captures")], False
    second = tried(bench, page, two[1])
    with bench.service():
        second.settle()
    assert bench.chooser.committed() == "B"


def test_a_boot_that_never_came_to_an_end_is_told_as_such(bench: Bench, page: Page, two: tuple[object, Path]) -> None:
    """Neither committed nor judged: the kernel, a hang, or the power."""
    tried(bench, page, two[1])
    assert bench.boot() == "A"
    assert "Version 2.0 did not finish starting, or lost power: 1.0 is back." in updater(bench, page, "1.0").status()[1]
    with bench.service():
        updater(bench, page, "1.0").restart()  # and it can be tried once more
    assert bench.boot() == "B"


def test_a_computer_without_slots_is_told_so(bench: Bench, page: Page) -> None:
    (bench.here / "cmdline").write_text("console=tty1 quiet\n")
    device = updater(bench, page, "1.0")
    for ask in (device.status, device.settle, device.restart):
        with pytest.raises(UpdateWrongDevice, match="no slots"):
            ask()


def not_now(exam: str = "aim", battery: float | None = None, well: bool = True) -> Page:
    return Page(state=exam, battery=battery, checks=[check("captures", ok=well)])


@pytest.mark.parametrize(
    ("now", "kind"),
    [
        (not_now(exam="busy"), UpdateDuringExam),
        (not_now(exam="making"), UpdateDuringExam),
        (Page(visit_begun=timedelta(minutes=3)), UpdateDuringExam),
        (not_now(battery=0.49), UpdatePowerLow),
        (not_now(well=False), UpdateAtRisk),
    ],
)
def test_an_update_waits_for_examination_charger_and_captures(
    bench: Bench, page: Page, two: tuple[object, Path], now: Page, kind: type[UpdateError]
) -> None:
    page.state, page.battery, page.checks, page.visit_begun = now.state, now.battery, now.checks, now.visit_begun
    with pytest.raises(kind):
        updater(bench, page, "1.0").install(two[1])
    assert bench.chooser.primary() == "A"
    page.state, page.battery, page.checks = "aim", 0.51, [check("captures")]
    page.visit_begun = timedelta(hours=1)  # somebody left it so, and will finish it another time
    with bench.service():
        updater(bench, page, "1.0").install(two[1])
    assert bench.chooser.primary() == "B"
