"""Trial of a new version: it is committed once its health checks pass, else the device goes back."""

from collections.abc import Callable

from device.clock import Clock, Deadline
from services.errors import UpdateFailed
from services.health import probe
from services.health.checks import Check
from services.update import preconditions
from services.update.bootchooser import BootChooser
from services.update.ipc import StoredError
from services.update.rauc import Rauc
from services.update.settings import UpdateSettings
from services.update.state import StateFile

POLL_INTERVAL_S = 2.0
# Checks of the head: a failure before the update is no failure of the new version.
EXEMPT_CHECKS = ("camera", "calibration")


class Trial:
    """Trial of the running version `runs`; `report` is called with a line per step."""

    def __init__(
        self,
        settings: UpdateSettings,
        clock: Clock,
        rauc: Rauc,
        chooser: BootChooser,
        runs: str,
        report: Callable[[str], None],
    ) -> None:
        self._settings, self._clock, self._rauc, self._chooser = settings, clock, rauc, chooser
        self._runs, self._report = runs, report
        self._journal = StateFile(settings.folder)

    def settle(self) -> None:
        """Commit the version that is being tried once its health checks pass; UpdateFailed after `patience_s`.

        Checks of the head that failed before the update may fail. If no version is being tried, only report that. On
        UpdateFailed systemd restarts the device, and the firmware boots the committed version.
        """
        if not preconditions.is_trying(self._chooser):
            self._report(f"Version {self._runs} is committed already.")
            return
        entry = self._journal.write(version=self._runs, state="trying", settling=True)
        forgiven = set(EXEMPT_CHECKS) & set(entry.ill)
        deadline = Deadline.after(self._clock, self._settings.patience_s)
        while failed := self._failed_checks(forgiven):
            if deadline.left_s() <= 0:
                reasons = "; ".join(f"{check.name}: {check.value}. {check.remedy}" for check in failed)
                self._journal.write(state="went back", trouble=StoredError.of(UpdateFailed(reasons)))
                self._rauc.mark("bad")
                raise UpdateFailed(f"version {self._runs} is not well: {reasons}")
            self._clock.sleep(POLL_INTERVAL_S)
        self._rauc.mark("good")
        self._journal.write(state="committed", took_s=entry.spent_s + self._clock.now_s())  # the clock is 0 at boot
        self._report(f"Version {self._runs} is well, and committed.")

    def _failed_checks(self, forgiven: set[str]) -> list[Check]:
        settings = self._settings
        checks = probe.probe_instrument(
            settings.instrument, with_picture="camera" not in forgiven, timeout_s=settings.answer_s
        )
        return [check for check in checks if check.of_release and not check.ok and check.name not in forgiven]
