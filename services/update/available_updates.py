"""Available updates: those on USB drives, in the page's upload and in the channel, and their transfer to the device."""

import logging
from pathlib import Path

from device.clock import Clock
from services.errors import UpdateError, UpdateNotFound, UpdateSourceRemoved
from services.update import channel, preconditions, signers, sources
from services.update.channel_memory import ChannelMemory, SeenChannel
from services.update.ipc import FoundUpdate, StoredError
from services.update.rauc import Rauc, Release
from services.update.settings import UpdateSettings
from services.update.sources import Progress

log = logging.getLogger(__name__)

BUNDLE_READS = (2, 3)  # reads and writes of a bundle (copy, signature, slot), at least and at most
RESTART_S = (30.0, 180.0)  # estimate of restart to commit, until this device has measured one
REMOVED_DRIVE_REMEDY = "Put the USB stick back in, look for updates once more, and choose again."


class AvailableUpdates:
    """Updates that this device can reach; `runs` is the running version.

    The caller holds the update lock during `on_drives`, `fetch`, `fetch_found` and `download`.
    """

    def __init__(self, settings: UpdateSettings, clock: Clock, rauc: Rauc, runs: str) -> None:
        self._settings, self._clock, self._rauc, self._runs = settings, clock, rauc, runs
        self._memory = ChannelMemory(settings.folder)

    def newer_offer(self) -> channel.Offer | None:
        """Return the channel's offer if it is newer than the running version, else None.

        UpdateNotFound if no channel is set, UpdateStale for an old file of the channel.
        """
        offer = self._offer()[1]
        is_newer = preconditions.parse_version(offer.version) > preconditions.parse_version(self._runs)
        return offer if is_newer else None

    def download(self, offer: channel.Offer) -> Path:
        """Download the offered bundle and return its path."""
        return self._server().download(offer, self._settings.folder, _log_progress)

    def on_drives(self) -> list[FoundUpdate]:
        """Return the updates on USB drives and in the upload; `trouble` is the reason why one cannot be installed."""
        there = sources.list_bundles(self._settings.sticks, self._settings.tablet)
        return [self._assessed(found, path) for found, path in there]

    def fetch(self, place: Path | None, progress: Progress) -> Path:
        """Copy or download a bundle and return its path.

        It comes from `place`; if that is None, from a USB drive, else from the channel.
        """
        folder = self._settings.folder
        if place is not None:
            return sources.copy_bundle(sources.find_bundle(place), folder, progress)
        try:
            return sources.copy_bundle(sources.find_bundle(self._settings.sticks), folder, progress)
        except UpdateNotFound:
            if not self._settings.channel:
                raise
        web, offer = self._offer()
        return web.download(offer, folder, progress)

    def fetch_found(self, id: str, progress: Progress) -> Path:
        """Copy or download the update with this id and return its path; UpdateSourceRemoved if it is gone."""
        for found, path in sources.list_bundles(self._settings.sticks, self._settings.tablet):
            if found.id == id:
                return sources.copy_bundle(path, self._settings.folder, progress)
        if self._settings.channel:
            web, offer = self._offer()
            if channel.as_found_update(offer).id == id:
                return web.download(offer, self._settings.folder, progress)
        raise UpdateSourceRemoved("what was chosen is not there any more", REMOVED_DRIVE_REMEDY)

    def release(self, bundle: Path) -> Release:
        """Return the metadata of a bundle; errors of `Rauc.release`, UpdateUntrusted also for a revoked signer."""
        release = self._rauc.release(bundle)
        if revoked := self._memory.read().revoked:
            signers.refuse_revoked(signers.bundle_certificates(bundle), revoked)
        return release

    def _assessed(self, found: FoundUpdate, path: Path) -> FoundUpdate:
        """Return the entry with version, estimated duration and reason for refusal of the bundle at `path`.

        RAUC accepts only files that no other user can change, so a private copy is checked.
        """
        folder = self._settings.folder
        try:
            begin_s = self._clock.now_s()
            copy = sources.copy_bundle(path, folder, _log_progress)
            copy_s = self._clock.now_s() - begin_s
            takes_s = tuple(times * copy_s + more_s for times, more_s in zip(BUNDLE_READS, RESTART_S, strict=True))
            release = self.release(copy)
            found = found.model_copy(update={"version": release.version, "takes_s": takes_s})
            preconditions.refuse_unsuitable(release, self._rauc.compatible(), self._runs, self._settings.modules)
        except UpdateError as error:
            return found.model_copy(update={"trouble": StoredError.of(error)})
        finally:
            sources.remove_copy(folder)
        return found

    def _offer(self) -> tuple[sources.UpdateServer, channel.Offer]:
        server, seen = self._server(), self._memory.read()
        content = server.read_small_file(channel.CHANNEL_FILE)
        offer = channel.verify_channel(content, self._settings.keyring, seen.revoked)
        channel.refuse_stale(offer, seen.number, self._clock.wall().date())
        now_seen = SeenChannel(number=offer.number, revoked=tuple(sorted({*seen.revoked, *offer.revoked})))
        if now_seen != seen:
            self._memory.write(now_seen)
        return server, offer

    def _server(self) -> sources.UpdateServer:
        if not self._settings.channel:
            raise UpdateNotFound("no channel is set: this device is updated from a USB stick")
        return sources.UpdateServer(self._settings.channel, self._settings.authority, self._clock)


def _log_progress(share: float, what: str) -> None:
    log.info("%s %.0f %%", what, 100 * share)
