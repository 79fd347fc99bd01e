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
from services.records.store import Store

COMPUTER_HEAT = Path("/sys/class/thermal/thermal_zone0/temp")
CLOCK_WAS_SET = Path("/run/systemd/timesync/synchronized")
GLANCE_S = 0.02
PRESSES = 100


def facts(owner: Owner, pictures: int, sender: Sender | None = None) -> Facts:
    """Everything that the checks judge, as it is now; while the head is calibrated, nothing of its parts.

    `pictures` is how many the protocol takes of a person.
    """
    house, head = owner.house, owner.head
    chips, bus = head.chips if head is not None else Chips(), house.spec.bus
    newest, store = _shelf(house.store)
    battery, thermometer = chips.battery, chips.thermometer
    return Facts(
        state=owner.state, problem=owner.problem, lamp_is_dark=head is None or _goes_dark(head, house.clock),
        calibration=_calibration(owner), store=store,
        captures_left=house.store.space_left(), people_left=house.store.people_left(pictures),
        battery=_told(lambda: battery.read().fraction) if battery else None, emptiest=bus.emptiest if bus else 0.0,
        head_c=_told(thermometer.read_c) if thermometer else None, warmest_c=bus.warmest_c if bus else 100.0,
        computer_c=int(COMPUTER_HEAT.read_text()) / 1000 if COMPUTER_HEAT.exists() else None,
        now=house.clock.wall(), clock_was_set=CLOCK_WAS_SET.exists(),
        newest=newest[0].taken_at if newest else None,
        presses=[(spent_s, spent_s - _budget_s(one)) for one in newest if (spent_s := _press_s(one)) > 0],
        unsent=None if sender is None else sender.in_need(),
        torn_bytes=list(house.store.torn().values()),
    )  # fmt: skip


def _told(read: Callable[[], float]) -> DiffuscopeError | float:
    try:
        return read()
    except DiffuscopeError as error:
        return error


def _goes_dark(head: Head, clock: Clock) -> bool:
    """Seen dark once within as long as it may shine at a stretch; while somebody aims it is lit half of the time."""
    begin_s = clock.now_s()
    while head.light.glow is not None:
        if clock.now_s() - begin_s > 2 * head.light.max_on_s:
            return False
        clock.sleep(GLANCE_S)
    return True


def _calibration(owner: Owner) -> DiffuscopeError | None:
    """Why no picture should rest on it."""
    if owner.needed is not None:
        return owner.needed
    try:
        refuse(owner.findings)
    except CalibrationError as error:
        return error
    return None


def _shelf(store: Store) -> tuple[list[Capture], StoreError | None]:
    """The last captures, and what is wrong with the shelf: it must take a file and give the newest capture back."""
    try:
        newest = store.captures(PRESSES)
        store.try_out()
        for name in newest[0].files if newest else ():
            store.read(newest[0].id, name)
    except StoreError as error:
        return [], error
    return newest, None


def _press_s(capture: Capture) -> float:
    """From the button to the kept picture; 0 where its report does not say."""
    return float(sum(capture.report.get("seconds", {}).values()))


def _budget_s(capture: Capture) -> float:
    """What it was allowed to take; reports did not say before a person could choose."""
    return float(capture.report.get("budget_s", BUDGET_S))
