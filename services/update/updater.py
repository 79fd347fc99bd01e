"""The story of an update: look, fetch, refuse or install, restart, be tried, be committed or go back."""

import logging
import subprocess
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

from device.clock import Clock, Deadline
from device.errors import DiffuscopeError, UpdateBusy, UpdateError, UpdateFailed, UpdateNowhere, UpdateSourceGone
from services.health import probe
from services.health.checks import Check
from services.records import update_notes
from services.records.update_notes import UNDER_WAY, Entry, Found, Trouble
from services.update import channel, gate, sources
from services.update.bootchooser import BootChooser, other
from services.update.engine import Rauc
from services.update.journal import Journal, in_words
from services.update.settings import UpdateSettings

log = logging.getLogger(__name__)

ASK_AGAIN_S = 2.0
READS = (2, 3)  # a copy, the signature, the slot: how many times a bundle is read or written, at best and at most
RESTART_S = (30.0, 180.0)  # from the restart to the commit; a guess, until this device has timed one
GONE = "Put the USB stick back in, look for updates once more, and choose again."
FORGIVEN = ("camera", "calibration")  # of the head: if they failed before, another version is not to blame


class Updater:
    """One device and where its updates come from; `tell` hears each step in words."""

    def __init__(
        self, settings: UpdateSettings, clock: Clock, tell: Callable[[str], None], chooser: BootChooser | None = None,
        runs: str | None = None,
    ) -> None:  # fmt: skip
        self._settings, self._clock, self._tell = settings, clock, tell
        self._chooser = chooser or BootChooser(state=settings.folder)
        self._rauc, self._journal = Rauc(settings.rauc), Journal(settings.folder)
        self.runs = runs or version("diffuscope")
        self._told = (-1, "")

    def check(self, download: bool = False) -> channel.Offer | None:
        """What the channel offers that is newer than what runs, None if nothing; `download` fetches it already."""
        web, offer = self._offer()
        newer = gate.number(offer.version) > gate.number(self.runs)
        self._journal.write(offered=offer.version if newer else "")
        if not newer:
            return None
        if download:
            with gate.alone(self._settings.folder):
                web.download(offer, self._settings.folder, self._quietly)
        return offer

    def install(self, place: Path | None, restart: bool = True) -> None:
        """Fetch, check and install what is at a place, on a stick, or in the channel; then restart to try it.

        Every refusal is an UpdateError of its own; the slot that runs, and the data, are never written.
        """
        self._install(lambda: self._fetched(place), restart)

    def install_found(self, id: str) -> None:
        """The same with something that is found now under a name that `look` gave it; UpdateSourceGone if it is not."""
        self._install(lambda: self._fetched_found(id), restart=True)

    def look(self) -> tuple[Found, ...]:
        """What could be installed, from sticks, tablet and channel, each judged by what it says of itself."""
        with gate.alone(self._settings.folder):
            self._journal.write(state="looking", found=(), version="", looked=True)
            there = sources.listed(self._settings.sticks, self._settings.tablet)
            found = [self._judged(one, path) for one, path in there]
        trouble = None
        if self._settings.channel:
            try:
                if (offer := self.check()) is not None:
                    found.append(channel.as_found(offer))
            except UpdateError as error:  # what is on the stick can be installed without a network
                trouble = Trouble.of(error)
        self._journal.write(state="none", found=tuple(found), trouble=trouble)
        return tuple(found)

    def answer(self) -> None:
        """Do what the page wished; why it was not done stands in the journal."""
        self.tidy()
        try:
            wish = update_notes.take(self._settings.wishes)
            match wish and wish.do:
                case "check":
                    self.look()
                case "install":
                    assert wish is not None
                    assert wish.id is not None
                    self.install_found(wish.id)
                case "restart":
                    self.restart()
        except DiffuscopeError as error:
            self._journal.write(trouble=Trouble.of(error))
            self._tell(f"{error.message}\n{error.remedy}")

    def tidy(self) -> None:
        """After an update that was interrupted: say so, and give back the room that it took."""
        try:
            with gate.alone(self._settings.folder):
                sources.clear(self._settings.folder)
                if self._journal.read().state in UNDER_WAY:
                    self._journal.write(state="interrupted")
        except UpdateBusy:  # it goes on
            return

    def _install(self, fetch: Callable[[], Path], restart: bool) -> None:
        settings = self._settings
        gate.refuse_while_trying(self._chooser)
        with gate.alone(settings.folder), self._journal.refusals():
            ill, begin_s = self._at_rest(), self._clock.now_s()
            sources.clear(settings.folder)
            self._journal.write(state="fetching", version="", before=self.runs, share=0.0, ill=ill)
            bundle = fetch()
            release = self._rauc.release(bundle)
            gate.refuse_wrong(release, self._rauc.compatible(), self.runs, self._settings.modules)
            self._at_rest()  # fetching took a while
            self._journal.write(state="installing", version=release.version, share=0.0)
            self._rauc.install(bundle, self._progress)
            for done in (bundle, settings.folder / sources.WHOLE):
                done.unlink(missing_ok=True)
            (settings.tablet / update_notes.UPLOAD).unlink(missing_ok=True)
            spent_s = self._clock.now_s() - begin_s
            self._journal.write(state="installed", offered="", found=(), looked=False, spent_s=spent_s)
            self._tell(f"Version {release.version} is installed.")
            if restart:
                self._restart()

    def restart(self) -> None:
        """Try what is installed and waits; UpdateNowhere if nothing does."""
        with gate.alone(self._settings.folder):
            gate.refuse_while_trying(self._chooser)
            self._at_rest()
            waiting = self._journal.read().state in ("installed", "trying")
            if not waiting or not self._chooser.is_good(other(self._chooser.committed())):
                raise UpdateNowhere("nothing that is installed waits to be tried")
            self._rauc.mark("active", "other")
            self._restart()

    def settle(self) -> None:
        """In a version that is being tried: commit it as soon as it is well; UpdateFailed if it is not in time.

        systemd answers that failure with a restart, and the firmware with the version before.
        """
        if not gate.is_trying(self._chooser):
            self._tell(f"Version {self.runs} is committed already.")
            return
        entry = self._journal.write(version=self.runs, state="trying", settling=True)
        forgiven = set(FORGIVEN) & set(entry.ill)
        deadline = Deadline.after(self._clock, self._settings.patience_s)
        while wrong := self._wrong(forgiven):
            if deadline.left_s() <= 0:
                said = "; ".join(f"{check.name}: {check.value}. {check.remedy}" for check in wrong)
                self._journal.write(state="went back", trouble=Trouble.of(UpdateFailed(said)))
                self._rauc.mark("bad")
                raise UpdateFailed(f"version {self.runs} is not well: {said}")
            self._clock.sleep(ASK_AGAIN_S)
        self._rauc.mark("good")
        self._journal.write(state="committed", took_s=entry.spent_s + self._clock.now_s())  # whose zero is the start
        self._tell(f"Version {self.runs} is well, and committed.")

    def status(self) -> tuple[Entry, str]:
        """How far the last update is, and that in words."""
        entry = self._journal.read()
        return entry, in_words(
            entry, self.runs, gate.is_trying(self._chooser), gate.is_under_way(self._settings.folder)
        )

    def _wrong(self, forgiven: set[str]) -> list[Check]:
        settings = self._settings
        checks = probe.examine(settings.instrument, look="camera" not in forgiven, patience_s=settings.answer_s)
        return [check for check in checks if check.of_release and not check.ok and check.name not in forgiven]

    def _at_rest(self) -> tuple[str, ...]:
        settings = self._settings
        return gate.refuse_unless_at_rest(settings.instrument, settings.lowest_battery, self._clock.wall())

    def _fetched(self, place: Path | None) -> Path:
        folder = self._settings.folder
        if place is not None:
            return sources.copied(sources.on_stick(place), folder, self._progress)
        try:
            return sources.copied(sources.on_stick(self._settings.sticks), folder, self._progress)
        except UpdateNowhere:
            if not self._settings.channel:
                raise
        web, offer = self._offer()
        return web.download(offer, folder, self._progress)

    def _fetched_found(self, id: str) -> Path:
        for found, path in sources.listed(self._settings.sticks, self._settings.tablet):
            if found.id == id:
                return sources.copied(path, self._settings.folder, self._progress)
        if self._settings.channel:
            web, offer = self._offer()
            if channel.as_found(offer).id == id:
                return web.download(offer, self._settings.folder, self._progress)
        raise UpdateSourceGone("what was chosen is not there any more", GONE)

    def _judged(self, found: Found, path: Path) -> Found:
        """RAUC reads only what belongs to root and cannot change: so a copy, which nobody else can reach."""
        folder = self._settings.folder
        try:
            begin_s = self._clock.now_s()
            copy = sources.copied(path, folder, self._quietly)
            copy_s = self._clock.now_s() - begin_s
            takes_s = tuple(times * copy_s + more_s for times, more_s in zip(READS, RESTART_S, strict=True))
            release = self._rauc.release(copy)
            found = found.model_copy(update={"version": release.version, "takes_s": takes_s})
            gate.refuse_wrong(release, self._rauc.compatible(), self.runs, self._settings.modules)
        except UpdateError as error:
            return found.model_copy(update={"trouble": Trouble.of(error)})
        finally:
            sources.clear(folder)
        return found

    def _offer(self) -> tuple[sources.Web, channel.Offer]:
        if not self._settings.channel:
            raise UpdateNowhere("no channel is set: this device is updated from a USB stick")
        web = sources.Web(self._settings.channel, self._settings.authority, self._clock)
        return web, channel.opened(web.small(channel.NAME), self._settings.keyring)

    def _progress(self, share: float, what: str) -> None:
        """Said and written down at every twentieth, and whenever something else begins."""
        step = int(share * 20), what
        if step != self._told:
            self._told = step
            self._journal.write(share=share)
            self._tell(f"{share:>4.0%}  {what}")

    def _quietly(self, share: float, what: str) -> None:
        log.info("%s %.0f %%", what, 100 * share)

    def _restart(self) -> None:
        self._journal.write(state="trying")
        self._tell("Restarting to try it.")
        try:
            subprocess.run(self._settings.restart, check=True, timeout=60)
        except (OSError, subprocess.SubprocessError) as error:
            raise UpdateFailed(f"the device does not restart: {error}", "Turn it off and on.") from error
