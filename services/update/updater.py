"""Update procedure: search, fetch, check, install, restart, try, then commit or roll back."""

import subprocess
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

from device.clock import Clock
from device.errors import DiffuscopeError
from services.errors import UpdateBusy, UpdateError, UpdateFailed, UpdateNotFound
from services.update import channel, ipc, preconditions, sources
from services.update.available_updates import AvailableUpdates
from services.update.bootchooser import BootChooser, other
from services.update.ipc import UNDER_WAY, FoundUpdate, StoredError, UpdateState
from services.update.rauc import Rauc
from services.update.settings import UpdateSettings
from services.update.state import StateFile, describe_state
from services.update.trial import Trial


class Updater:
    """Updater of one device; `report` is called with a line per step; `runs` is the running version (default: ours)."""

    def __init__(
        self,
        settings: UpdateSettings,
        clock: Clock,
        report: Callable[[str], None],
        chooser: BootChooser | None = None,
        runs: str | None = None,
    ) -> None:
        self._settings, self._clock, self._report = settings, clock, report
        self._chooser = chooser or BootChooser(state=settings.folder)
        self._rauc = Rauc(settings.rauc)
        self._journal = StateFile(settings.folder)
        self.running_version = runs or version("diffuscope")
        self._available = AvailableUpdates(settings, clock, self._rauc, self.running_version)
        self._reported = (-1, "")

    def check(self, download: bool = False) -> channel.Offer | None:
        """Return the channel's offer if it is newer than the running version, else None.

        The offered version is stored. `download` also fetches the bundle. UpdateNotFound if no channel is set.
        """
        offer = self._available.newer_offer()
        self._journal.write(offered="" if offer is None else offer.version)
        if offer is not None and download:
            with preconditions.update_lock(self._settings.folder):
                self._available.download(offer)
        return offer

    def install(self, place: Path | None, restart: bool = True) -> None:
        """Fetch, check and install a bundle, then (`restart`) restart to try it.

        It comes from `place`; if that is None, from a USB drive, else from the channel. Each refusal is a subclass of
        UpdateError. The running slot and the captures are never written.
        """
        self._install(lambda: self._available.fetch(place, self._progress), restart)

    def install_found(self, id: str) -> None:
        """Install an update that `search` found, by its id, and restart; UpdateSourceRemoved if it is gone."""
        self._install(lambda: self._available.fetch_found(id, self._progress), restart=True)

    def search(self) -> tuple[FoundUpdate, ...]:
        """Return and store the updates on USB drives, in the upload and (if newer) in the channel.

        `trouble` of an entry is the reason why it cannot be installed. An error of the channel is stored only.
        """
        with preconditions.update_lock(self._settings.folder):
            self._journal.write(state="looking", found=(), version="", looked=True)
            found = self._available.on_drives()
        trouble = None
        if self._settings.channel:
            try:
                if (offer := self.check()) is not None:
                    found.append(channel.as_found_update(offer))
            except UpdateError as error:  # updates on a drive can be installed without a network
                trouble = StoredError.of(error)
        self._journal.write(state="none", found=tuple(found), trouble=trouble)
        return tuple(found)

    def answer(self) -> None:
        """Carry out the page's request, if there is one; an error is stored in the state and reported."""
        self.tidy()
        try:
            request = ipc.take_request(self._settings.requests)
            match request and request.do:
                case "check":
                    self.search()
                case "install":
                    assert request is not None
                    assert request.id is not None
                    self.install_found(request.id)
                case "restart":
                    self.restart()
        except DiffuscopeError as error:
            self._journal.write(trouble=StoredError.of(error))
            self._report(f"{error.message}\n{error.remedy}")

    def tidy(self) -> None:
        """Remove a leftover copy, and store "interrupted" for an unfinished update; no effect while an update runs."""
        try:
            with preconditions.update_lock(self._settings.folder):
                sources.remove_copy(self._settings.folder)
                if self._journal.read().state in UNDER_WAY:
                    self._journal.write(state="interrupted")
        except UpdateBusy:  # still running
            return

    def _install(self, fetch: Callable[[], Path], restart: bool) -> None:
        settings = self._settings
        preconditions.refuse_while_trying(self._chooser)
        with preconditions.update_lock(settings.folder), self._journal.record_refusals():
            preconditions.refuse_old_bootloader(settings.bootloader)
            ill = self._at_rest()
            begin_s = self._clock.now_s()
            sources.remove_copy(settings.folder)
            self._journal.write(state="fetching", version="", before=self.running_version, share=0.0, ill=ill)
            bundle = fetch()
            release = self._available.release(bundle)
            preconditions.refuse_unsuitable(
                release, self._rauc.compatible(), self.running_version, self._settings.modules
            )
            self._at_rest()  # the state may have changed during the download
            self._journal.write(state="installing", version=release.version, share=0.0)
            self._rauc.install(bundle, self._progress)
            for done in (bundle, settings.folder / sources.DOWNLOADED_BUNDLE):
                done.unlink(missing_ok=True)
            (settings.tablet / ipc.UPLOAD).unlink(missing_ok=True)
            spent_s = self._clock.now_s() - begin_s
            self._journal.write(state="installed", offered="", found=(), looked=False, spent_s=spent_s)
            self._report(f"Version {release.version} is installed.")
            if restart:
                self._restart()

    def restart(self) -> None:
        """Restart into the installed version to try it; UpdateNotFound if none waits for that."""
        with preconditions.update_lock(self._settings.folder):
            preconditions.refuse_while_trying(self._chooser)
            self._at_rest()
            waiting = self._journal.read().state in ("installed", "trying")
            if not waiting or not self._chooser.is_good(other(self._chooser.committed())):
                raise UpdateNotFound("nothing that is installed waits to be tried")
            self._rauc.mark("active", "other")
            self._restart()

    def settle(self) -> None:
        """Commit the version that is being tried once its health checks pass; UpdateFailed after `patience_s`."""
        Trial(self._settings, self._clock, self._rauc, self._chooser, self.running_version, self._report).settle()

    def status(self) -> tuple[UpdateState, str]:
        """Return the stored state, and its description in sentences."""
        entry = self._journal.read()
        return entry, describe_state(
            entry,
            self.running_version,
            preconditions.is_trying(self._chooser),
            preconditions.is_under_way(self._settings.folder),
        )

    def _at_rest(self) -> tuple[str, ...]:
        settings = self._settings
        return preconditions.refuse_while_in_use(settings.instrument, settings.lowest_battery, self._clock.wall())

    def _progress(self, share: float, what: str) -> None:
        """Store and report the progress at each twentieth of `share` (0 to 1) and at each new step `what`."""
        step = int(share * 20), what
        if step != self._reported:
            self._reported = step
            self._journal.write(share=share)
            self._report(f"{share:>4.0%}  {what}")

    def _restart(self) -> None:
        self._journal.write(state="trying")
        self._report("Restarting to try it.")
        try:
            subprocess.run(self._settings.restart, check=True, timeout=60)
        except (OSError, subprocess.SubprocessError) as error:
            raise UpdateFailed(f"the device does not restart: {error}", "Turn it off and on.") from error
