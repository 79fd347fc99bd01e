"""Settling of a tried version, and preconditions of an update: real RAUC, fake page.

`test_versions.py` runs a real instrument; here the page hangs, fails checks, is busy, or reports an empty battery.
"""

from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import pytest

from device.clock import SystemClock
from services.errors import (
    UpdateCapturesAtRisk,
    UpdateDuringExam,
    UpdateError,
    UpdateFailed,
    UpdatePowerLow,
    UpdateWrongDevice,
)
from services.update.updater import Updater
from tests.appliance import bench as benches
from tests.appliance import releases
from tests.appliance.bench import Bench
from tests.appliance.instrument import Page, check, served

pytestmark = pytest.mark.systemd


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
    settings = bench.settings(instrument=page.at, answer_s=1.0, patience_s=5.0)
    return Updater(settings, SystemClock(), bench.reports.append, bench.chooser, runs)


def install_and_boot(bench: Bench, page: Page, bundle: Path) -> Updater:
    """Install version 2.0 and boot its slot; return its updater."""
    with bench.service():
        updater(bench, page, "1.0").install(bundle)
    assert bench.boot() == "B"
    return updater(bench, page, "2.0")


def test_healthy_version_is_committed(bench: Bench, page: Page, two: tuple[object, Path]) -> None:
    second = install_and_boot(bench, page, two[1])
    with bench.service():
        second.settle()
    assert (bench.chooser.committed(), second.status()[1]) == (
        "B",
        "Updated to 2.0. It was tried, found well, and stays.",
    )
    second.settle()  # nothing to settle at later boots
    assert bench.reports[-1] == "Version 2.0 is committed already."


@pytest.mark.parametrize("how", ["hangs", "ill", "blind", "for ever starting"])
def test_unhealthy_version_is_rolled_back_with_the_reason(
    bench: Bench, page: Page, two: tuple[object, Path], how: str
) -> None:
    second = install_and_boot(bench, page, two[1])
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
    sentence = updater(bench, page, "1.0").status()[1]
    assert sentence.startswith("Version 1.0 runs. Version 2.0 was tried and was not well, so 1.0 is back: ")
    assert why in sentence
    assert not bench.chooser.is_good("B")


def test_camera_fault_before_the_update_does_not_prevent_the_commit(
    bench: Bench, page: Page, two: tuple[object, Path]
) -> None:
    page.checks, page.sees = [check("camera", ok=False), check("captures")], False
    second = install_and_boot(bench, page, two[1])
    with bench.service():
        second.settle()
    assert bench.chooser.committed() == "B"


def test_unfinished_boot_of_a_try_is_reported_and_can_be_repeated(
    bench: Bench, page: Page, two: tuple[object, Path]
) -> None:
    """Neither committed nor rolled back: a kernel failure, a hang or a power cut."""
    install_and_boot(bench, page, two[1])
    assert bench.boot() == "A"
    assert "Version 2.0 did not finish starting, or lost power: 1.0 is back." in updater(bench, page, "1.0").status()[1]
    with bench.service():
        updater(bench, page, "1.0").restart()  # a second try is possible
    assert bench.boot() == "B"


def test_computer_without_boot_slots_is_an_error(bench: Bench, page: Page) -> None:
    (bench.here / "cmdline").write_text("console=tty1 quiet\n")
    device = updater(bench, page, "1.0")
    for ask in (device.status, device.settle, device.restart):
        with pytest.raises(UpdateWrongDevice, match="no slots"):
            ask()


def blocking_page(exam: str = "aim", battery: float | None = None, well: bool = True) -> Page:
    return Page(state=exam, battery=battery, checks=[check("captures", ok=well)])


@pytest.mark.parametrize(
    ("now", "kind"),
    [
        (blocking_page(exam="busy"), UpdateDuringExam),
        (blocking_page(exam="making"), UpdateDuringExam),
        (Page(pictured=timedelta(minutes=3)), UpdateDuringExam),
        (blocking_page(battery=0.49), UpdatePowerLow),
        (blocking_page(well=False), UpdateCapturesAtRisk),
    ],
)
def test_update_is_refused_during_exam_low_battery_or_damaged_captures(
    bench: Bench, page: Page, two: tuple[object, Path], now: Page, kind: type[UpdateError]
) -> None:
    page.state, page.battery, page.checks, page.pictured = now.state, now.battery, now.checks, now.pictured
    with pytest.raises(kind):
        updater(bench, page, "1.0").install(two[1])
    assert bench.chooser.primary() == "A"
    page.state, page.battery, page.checks = "aim", 0.51, [check("captures")]
    page.pictured = timedelta(hours=1)  # an old picture is no examination
    with bench.service():
        updater(bench, page, "1.0").install(two[1])
    assert bench.chooser.primary() == "B"
