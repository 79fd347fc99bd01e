"""What the instrument knows of itself, gathered for `services/health`: the one place that may ask the head's parts.

Reading a chip is one transfer, which the kernel keeps apart from those of the loop that owns the head; nothing here
shines, and nothing here writes to the head.
"""

from collections.abc import Callable
from pathlib import Path

from device.calibration.check import refuse
from device.clock import Clock
from device.errors import CalibrationError, DiffuscopeError, StoreError
from device.head import Chips, Head
from device.values import Capture
from services.health.checks import Facts
from services.instrument.owner import Owner
from services.instrument.pace import BUDGET_S
from services.instrument.sending import Sender
from services.records.people import People
from services.records.store import Store

COMPUTER_HEAT = Path("/sys/class/thermal/thermal_zone0/temp")
CLOCK_WAS_SET = Path("/run/systemd/timesync/synchronized")
GLANCE_S = 0.02
PRESSES = 100


def facts(owner: Owner, people: People, sender: Sender | None = None) -> Facts:
    """Collect the current inputs of the checks; without those of the head's parts while the head is calibrated."""
    house, head = owner.house, owner.head
    chips, bus = head.chips if head is not None else Chips(), house.spec.bus
    newest, orphans, damaged, store = _shelf(house.store, people)
    battery, thermometer = chips.battery, chips.thermometer
    return Facts(
        state=owner.state, problem=owner.problem, lamp_is_dark=head is None or _goes_dark(head, house.clock),
        calibration=_calibration(owner), store=store,
        captures_left=house.store.space_left(), people_left=house.store.people_left(len(people.protocol.slots)),
        battery=_told(lambda: battery.read().fraction) if battery else None, emptiest=bus.emptiest if bus else 0.0,
        head_c=_told(thermometer.read_c) if thermometer else None, warmest_c=bus.warmest_c if bus else 100.0,
        computer_c=int(COMPUTER_HEAT.read_text()) / 1000 if COMPUTER_HEAT.exists() else None,
        now=house.clock.wall(), clock_was_set=CLOCK_WAS_SET.exists(),
        newest=newest[0].taken_at if newest else None,
        presses=[(spent_s, spent_s - _budget_s(one)) for one in newest if (spent_s := _press_s(one)) > 0],
        unsent=None if sender is None else sender.in_need(),
        torn_bytes=list(house.store.torn().values()), orphans=orphans, damaged=damaged,
    )  # fmt: skip


def _told(read: Callable[[], float]) -> DiffuscopeError | float:
    try:
        return read()
    except DiffuscopeError as error:
        return error


def _goes_dark(head: Head, clock: Clock) -> bool:
    """Whether the lamp is dark at least once within 2 `max_on_s`; while aiming it is lit half of the time."""
    begin_s = clock.now_s()
    while head.light.glow is not None:
        if clock.now_s() - begin_s > 2 * head.light.max_on_s:
            return False
        clock.sleep(GLANCE_S)
    return True


def _calibration(owner: Owner) -> DiffuscopeError | None:
    """Return the error that forbids captures with this calibration; None if it is valid."""
    if owner.needed is not None:
        return owner.needed
    try:
        refuse(owner.findings)
    except CalibrationError as error:
        return error
    return None


def _shelf(store: Store, people: People) -> tuple[list[Capture], int, int, StoreError | None]:
    """Return the last captures, the numbers of capture folders without a row and of damaged rows, and an error.

    The StoreError is None if the store accepts a file and returns the newest capture.
    """
    try:
        newest = store.captures(PRESSES)
        store.try_out()
        for name in newest[0].files if newest else ():
            store.read(newest[0].id, name)
        return newest, len(store.orphans()), store.damaged() + people.damaged(), None
    except StoreError as error:
        return [], 0, 0, error


def _press_s(capture: Capture) -> float:
    """From the button to the kept picture; 0 where its report does not say."""
    return float(sum(spent_s or 0.0 for spent_s in (capture.report.get("seconds") or {}).values()))


def _budget_s(capture: Capture) -> float:
    """What it was allowed to take; reports did not say before a person could choose."""
    return float(capture.report.get("budget_s") or BUDGET_S)
