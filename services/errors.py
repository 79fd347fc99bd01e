"""Errors of services, which the device never raises: authentication, requests, records, uploads and updates.

HTTP status codes: `HTTP_STATUS` in services/http.

DiffuscopeError                       base class in device/errors.py
├── AuthenticationError               authentication and rights of a user
│   ├── LoginRequired                 not signed in, or the login ended
│   ├── SetupRequired                 no user exists yet
│   ├── ConfirmationRequired          PIN to be typed again before a risk
│   ├── AccessDenied                  the roles of the user do not permit it
│   ├── SecretWrong                   wrong name, PIN, passphrase or set-up code
│   ├── PresenceRequired              set-up of a device with users, and no user is seen at the device
│   └── SignInLockedOut               lock-out after repeated wrong secrets
├── Busy                              the instrument is occupied
├── RequestRefused                    request not permitted, or not now
│   ├── ControlLeaseHeld              another screen holds the control lease
│   ├── CrossOriginRequest            cross-origin request (CSRF check)
│   ├── UntrustedHost                 Host header is not a name of the instrument
│   ├── ServerFull                    too many clients at once
│   ├── ClockRefused                  the clock has a source already
│   ├── ClockBackwards                a time before that of the device
│   ├── TooManyRequests               more often than the rate of an operation
│   ├── IdempotencyKeyConflict        idempotency key of another request
│   ├── VisitFinished                 the visit is finished
│   ├── ConsentMissing                no consent recorded for the visit
│   └── ConsentDeclined               consent declined or withdrawn
├── StoreError                        base class in device/errors.py
│   ├── StoreDamaged                  stored file missing or changed
│   ├── StoreLocked                   database locked by another program
│   ├── BackupKeyWrong                passphrase or key does not fit the backup
│   ├── BackupDamaged                 backup incomplete or changed
│   ├── RestoreRefused                the store holds records already
│   ├── VersionRefused                later picture of other frames
│   ├── UsbDriveFull                  no space on the USB drive
│   ├── UsbDriveUnavailable           USB drive removed or not writable
│   │   └── UsbDriveReadOnly          USB drive write-protected
│   ├── RecordRemoved                 file removed to make room
│   ├── RecordErased                  data of the patient were erased
│   └── RecordNotFound (LookupError)  no such capture
├── UploadError                       upload of a visit failed
│   ├── UploadDisabled                no receiver configured
│   ├── ReceiverUnreachable           receiver unreachable, retried later
│   ├── ReceiverUntrusted             receiver's TLS certificate not trusted
│   ├── UploadUnauthorised            device not authorised by the receiver
│   ├── UploadRejected                visit rejected by the receiver
│   └── UploadMismatch                uploaded archive differs (SHA-256 or length)
└── UpdateError                       update not installed
    ├── UpdateBusy                    another update in progress
    ├── UpdateRequestInvalid          invalid update request
    ├── UpdateUncommitted             running version not yet committed
    ├── UpdateDuringExam              exam in progress
    ├── UpdatePowerLow                battery below one half
    ├── UpdateCapturesAtRisk          captures not readable or writable
    ├── UpdateNotFound                no update found
    ├── UpdateUnreachable             update server unreachable or connection lost
    ├── UpdateSourceRemoved           USB drive removed
    ├── UpdateUntrusted               no trusted signature
    ├── UpdateDamaged                 file incomplete or changed
    ├── UpdateWrongDevice             made for another device type
    ├── UpdateOlder                   not newer than the running version
    ├── UpdateStale                   old file of the update channel
    ├── UpdateStepMissing             needs an intermediate version
    ├── UpdateNoRoom                  no space for the update
    └── UpdateFailed                  write or trial of the update failed
"""

from device.errors import DiffuscopeError, StoreError

# Remedy of StoreFull where free files (inodes) lack, not free bytes.
NO_FILES_REMEDY = (
    "The disk takes no more files, although it has free bytes. Nothing that was saved is lost. Copy pictures to a USB "
    "stick and remove old ones, or call the technician: another program may have filled the disk with small files."
)


class AuthenticationError(DiffuscopeError):
    """Authentication failed, or the right is missing."""

    code = "access"
    default_remedy = "Sign in again, or ask an administrator."


class LoginRequired(AuthenticationError):
    """No user is signed in: no login, or it expired, was locked or was revoked."""

    code = "access.none"
    default_remedy = "Sign in with your name and PIN."


class SetupRequired(AuthenticationError):
    """No user exists yet, and the request does not come from a demonstration."""

    code = "access.setup"
    default_remedy = "Create the first administrator with the set-up code of this device."


class ConfirmationRequired(AuthenticationError):
    """An action with a risk, and the secret was typed too long ago."""

    code = "access.confirm"
    default_remedy = "Type your PIN once more, then repeat it."


class AccessDenied(AuthenticationError):
    """The roles of the signed-in user do not permit the request."""

    code = "access.role"
    default_remedy = "Ask an administrator for this right, or let another user do it."


class SecretWrong(AuthenticationError):
    """Name and secret do not belong together, or the set-up code is wrong."""

    code = "access.wrong"
    default_remedy = "Type name and PIN again. An administrator can give a new PIN."


class PresenceRequired(AuthenticationError):
    """A risk without a recent press of the device's button; without a button, from another screen than its own."""

    code = "access.presence"
    default_remedy = "Hold the button of the camera for three seconds. Send this again within half a minute."


class SignInLockedOut(AuthenticationError):
    """Lock-out after repeated wrong secrets; `wait_s` is the time until the next attempt."""

    code = "access.wait"
    default_remedy = "Wait until the time is over, then try again."


class Busy(DiffuscopeError):
    """The instrument is occupied, for example by another picture or a calibration, or the request is out of turn."""

    code = "busy"
    default_remedy = "A picture is being taken. Wait until it is done, then press again."


class RequestRefused(DiffuscopeError):
    """The request is not permitted, or not now."""

    code = "refused"
    default_remedy = "Reload the page and try again."


class ControlLeaseHeld(RequestRefused):
    """Another screen holds the control lease."""

    code = "link.other"
    default_remedy = "Another tablet is using the camera."


class CrossOriginRequest(RequestRefused):
    """Cross-origin request, refused by the CSRF check: the page is not served by this instrument."""

    code = "link.forged"
    default_remedy = "Close the other page, and open the camera's own page again."


class UntrustedHost(RequestRefused):
    """The Host header of the request is not a name of this instrument."""

    code = "link.host"
    default_remedy = "Open the page by the camera's address, as it is written on the device."


class IdempotencyKeyConflict(RequestRefused):
    """The idempotency key of the request was used for another request."""

    code = "refused.key"
    default_remedy = "Reload the page and try again."


class ServerFull(RequestRefused):
    """As many clients as permitted use the endpoint already; `wait_s` is the time until a retry."""

    code = "link.full"
    default_remedy = "Too many screens are connected. Close the page on the others, then wait a little."


class TooManyRequests(RequestRefused):
    """One client sends an operation more often than permitted; `wait_s` is the time until the next one."""

    code = "link.often"
    default_remedy = "Wait until the time is over, then try again. If you did nothing so often, call the technician."


class ClockRefused(RequestRefused):
    """The clock of the device has a source, or the time is impossible."""

    code = "clock.refused"
    default_remedy = "Set date and time in the settings of this computer, or connect it to a network."


class ClockBackwards(RequestRefused):
    """The time is before that of the device."""

    code = "clock.back"
    default_remedy = "Look whether the date of this screen is right. Only an administrator sets the clock back."


class VisitFinished(RequestRefused):
    """The visit is finished and read-only."""

    code = "visit.finished"
    default_remedy = "This visit is finished. Begin a new visit for this patient."


class ConsentMissing(RequestRefused):
    """No consent is recorded for the visit: no light, neither for a picture nor for aiming."""

    code = "consent.missing"
    default_remedy = "Ask the patient first. Then choose the answer."


class ConsentDeclined(RequestRefused):
    """Consent was declined or withdrawn: no light, neither for a picture nor for aiming."""

    code = "consent.declined"
    default_remedy = "This patient did not agree. Take no pictures, and finish the visit."


class StoreDamaged(StoreError):
    """A stored file or database row is missing, unreadable or invalid, or a digest differs from the stored one."""

    code = "store.damaged"
    default_remedy = "This saved file is damaged. Copy what can be read and call the technician."


class StoreLocked(StoreError):
    """Another program holds the write lock of the database, longer than a writer waits."""

    code = "store.locked"
    default_remedy = (
        "Another program is writing to the database of this device: close it, a database viewer or a copy of the "
        "folder, then try again. Nothing that was saved is lost."
    )


class BackupKeyWrong(StoreError):
    """A passphrase or a key does not decrypt a backup, or cannot be used for one."""

    code = "backup.key"
    default_remedy = "Give the passphrase or the key that was chosen when the backups were set up."


class BackupDamaged(StoreError):
    """A backup is incomplete or changed, or none was found."""

    code = "backup.damaged"
    default_remedy = "Use another copy of the backup, and another stick for the next one."


class RestoreRefused(StoreError):
    """A backup is not restored over records that are stored already."""

    code = "backup.used"
    default_remedy = "Restore on a new device, or into a new folder with --data."


class VersionRefused(StoreError):
    """A later picture was not made from the frames of this capture."""

    code = "version.refused"
    default_remedy = "Plan and run the archive again, with this store as its source."


class UsbDriveFull(StoreError):
    """The USB drive has no space for the export."""

    code = "stick.full"
    default_remedy = "The USB stick is full. Nothing was lost. Use another stick, or make room on this one."


class UsbDriveUnavailable(StoreError):
    """The USB drive is not present, was removed, or cannot be written."""

    code = "stick.gone"
    default_remedy = "The USB stick cannot be written. Nothing was lost. Put it in again, and copy once more."


class UsbDriveReadOnly(UsbDriveUnavailable):
    """The USB drive is mounted read-only: it is write-protected, or damaged."""

    code = "stick.readonly"
    default_remedy = (
        "The USB stick is write-protected, or damaged. Nothing was lost. Move its switch if it has one, or use another."
    )


class RecordRemoved(StoreError):
    """The file of a capture was removed to make room, after its visit was exported or sent."""

    code = "store.removed"
    default_remedy = "Look at the copy that was exported or sent, or in a backup."


class RecordErased(StoreError):
    """The data of the patient were erased: their key is gone, and with it the content of every copy."""

    code = "store.erased"
    default_remedy = "The data of this patient were erased on request. If the patient comes again, begin a new visit."


class RecordNotFound(StoreError, LookupError):
    """There is no capture, visit or picture slot with this id, or no measurement yet."""

    code = "store.unknown"
    default_remedy = "Choose a picture from the list."


class UploadError(DiffuscopeError):
    """The upload of a visit failed; the visit stays on this device."""

    code = "send"
    default_remedy = "Nothing is lost. Copy the visit to a USB stick, and call the technician."


class UploadDisabled(UploadError):
    """No receiver is configured."""

    code = "send.off"
    default_remedy = "Nothing is sent from this device. Copy visits to a USB stick, or save them as files."


class ReceiverUnreachable(UploadError):
    """The receiver does not answer or is temporarily unavailable; the upload is retried."""

    code = "send.link"
    default_remedy = "It is tried again by itself. Look whether this device is connected to the internet."


class ReceiverUntrusted(UploadError):
    """The receiver's TLS certificate is not trusted; a wrong clock has the same effect."""

    code = "send.certificate"
    default_remedy = "Look whether the date of this device is right. If it is, call the technician."


class UploadUnauthorised(UploadError):
    """The receiver does not authorise this device."""

    code = "send.key"
    default_remedy = "The receiver does not know this device. Call the technician: its key must be renewed."


class UploadRejected(UploadError):
    """The receiver rejects this visit permanently."""

    code = "send.refused"
    default_remedy = "The receiver does not take this visit. Copy it to a USB stick, and call the technician."


class UploadMismatch(UploadError):
    """The receiver's copy of the visit differs from the sent archive in SHA-256 or length."""

    code = "send.unlike"
    default_remedy = (
        "The receiver has only a part of it, or something else. Copy it to a USB stick, and call the technician."
    )


class UpdateError(DiffuscopeError):
    """An update cannot be installed; the running version stays."""

    code = "update"


class UpdateBusy(UpdateError):
    """Another update, or the transfer of another update file, is in progress."""

    code = "update.busy"
    default_remedy = "An update is under way already. Wait until it is done."


class UpdateRequestInvalid(UpdateError):
    """The page's update request cannot be read or is invalid."""

    code = "update.request"
    default_remedy = "Reload the page, look for updates once more, and choose one of those that are listed."


class UpdateUncommitted(UpdateError):
    """The running version is on trial and not yet committed."""

    code = "update.uncommitted"
    default_remedy = (
        "The version before this one must stay until this one has shown that it works. Wait some minutes, "
        "then try again."
    )


class UpdateDuringExam(UpdateError):
    """An examination is in progress: a picture is being taken, or was taken in the last minutes."""

    code = "update.exam"
    default_remedy = "Finish the examination first, then start the update again."


class UpdatePowerLow(UpdateError):
    """The battery charge is below the minimum for an update, normally one half."""

    code = "update.power"
    default_remedy = "Connect the charger, and start the update again when the battery is half full."


class UpdateCapturesAtRisk(UpdateError):
    """The captures on this device cannot be read or written."""

    code = "update.captures"
    default_remedy = "Copy the pictures to a USB stick first, and call the technician."


class UpdateNotFound(UpdateError):
    """No update was found: none or several at the source, no update server set, or none installed that awaits trial."""

    code = "update.nowhere"
    default_remedy = "Put in the USB stick that holds the update, a file whose name ends in .raucb."


class UpdateUnreachable(UpdateError):
    """The update server does not answer, or the connection was lost."""

    code = "update.link"
    default_remedy = "The connection was lost. What has arrived is saved: try again later, and it goes on from there."


class UpdateSourceRemoved(UpdateError):
    """The source of the update (USB drive or chosen file) was removed."""

    code = "update.stick"
    default_remedy = "Put the USB stick back in and leave it there until the update is done. Nothing has changed yet."


class UpdateUntrusted(UpdateError):
    """The update has no trusted signature."""

    code = "update.foreign"
    default_remedy = "Do not use this file. Get the update from the maker of the device."


class UpdateDamaged(UpdateError):
    """The update file is incomplete or was changed."""

    code = "update.damaged"
    default_remedy = "This file is damaged. Copy it to the stick again, or download it again."


class UpdateWrongDevice(UpdateError):
    """The update is made for another type of device."""

    code = "update.device"
    default_remedy = "Get the update for this device: the file's name says which one it is for."


class UpdateOlder(UpdateError):
    """The update is not newer than the running version."""

    code = "update.older"
    default_remedy = "Nothing needs to be done: this device has that version or a newer one."


class UpdateStale(UpdateError):
    """The update channel has an old file: another was seen before, or its last day is over."""

    code = "update.stale"
    default_remedy = "Look whether the date of this device is right, then tell the maker; or use a USB stick."


class UpdateStepMissing(UpdateError):
    """The update needs an intermediate version first."""

    code = "update.step"
    default_remedy = "Install the version in between first; the message names it."


class UpdateNoRoom(UpdateError):
    """There is no space for the update."""

    code = "update.room"
    default_remedy = "Copy pictures to a USB stick and remove old ones, then try again. Nothing that was saved is lost."


class UpdateFailed(UpdateError):
    """The update could not be written, or its trial failed."""

    code = "update.failed"
    default_remedy = (
        "This device works on with the version that it had. Try again; if it happens again, call the technician."
    )
