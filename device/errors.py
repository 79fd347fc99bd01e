"""Everything that can go wrong, as one tree; every leaf tells the operator what to do.

DiffuscopeError
├── InputError (ValueError)      something that was handed to us is wrong
│   ├── SpecError                a head or scene file
│   ├── FrameError               a raw frame
│   ├── PsfError                 a point spread function
│   └── SettingError             a method, budget or option
├── HardwareError (OSError)      something that we hold is wrong
│   ├── CameraMissing            the camera does not answer
│   ├── CameraStalled            the camera answered, and then stopped
│   ├── CameraWrong              another sensor, mode or count than the head's file says
│   ├── CameraPacked             the camera gives no plain counts
│   ├── LightFault               the lamp does not do what it was told
│   ├── LightLimit               the guard refuses more light
│   │   ├── LightCut             the guard ended a light before its exposure was over
│   │   └── LightDay             an eye has had all the light of a day
│   ├── BusFault                 a chip on the I2C bus does not answer
│   │   └── MemoryDamaged        the head's memory answers, and holds no whole identity
│   ├── HeadMismatch             the head's memory names another head
│   ├── TooHot                   the head is too warm to go on
│   └── PowerLow                 the battery is nearly empty
├── CalibrationError             what the factory measured cannot be used
│   ├── CalibrationMissing       there is none
│   ├── CalibrationDamaged       its files are not what was kept
│   ├── CalibrationOld           it is so long ago that it must be made anew
│   ├── CalibrationStale         ordinary pictures show that the head is no longer as it was measured
│   ├── CalibrationOtherMode     it was measured in another sensor mode than the head's file says
│   ├── CalibrationFormat        it was kept by another version of this software
│   ├── CalibrationUntrusted     nobody whom we trust has signed it as it is
│   ├── CalibrationRefused       what stands before the head is not what this step measures
│   └── CalibrationStopped       the technician stopped it
├── TechnicianError              the technician's door
│   ├── TechnicianLocked         nobody has said the PIN, or too long ago
│   ├── PinWrong                 that is not the PIN, or cannot be one
│   └── PinTooSoon               wrong ones came too often: wait
├── Busy                         the instrument is doing something else
├── Refused                      who asks may not, or not now
│   ├── OtherScreen              another screen is taking pictures
│   ├── Forged                   the request comes from a page that is not ours
│   ├── WrongHost                the instrument was asked by a name that is not its own
│   ├── VisitFinished            the visit is finished
│   ├── ConsentMissing           the person of this visit has not been asked yet
│   └── ConsentDeclined          the person of this visit did not agree
├── StoreError                   the shelf
│   ├── StoreFull                no room left
│   ├── StoreDamaged             a kept file is not what was kept
│   ├── StickFull                the USB stick has no room
│   ├── StickGone                the USB stick is not there, or cannot be written
│   └── NotKept (LookupError)    no such capture
├── SendError                    a visit was not sent, and is kept
│   ├── SendOff                  nothing is sent from here
│   ├── SendUnreachable          the receiver does not answer, or cannot now
│   ├── SendUntrusted            the receiver's certificate is not one that we trust
│   ├── SendLocked               the receiver does not know this device
│   ├── SendRejected             the receiver does not take this visit
│   └── SendUnlike               the receiver has something else than what was sent
└── UpdateError                  another version is not installed
    ├── UpdateBusy               one is under way
    ├── UpdateNotUnderstood      what was asked for is nothing that can be asked for
    ├── UpdateUncommitted        the version that runs is itself being tried
    ├── UpdateDuringExam         a picture is being taken
    ├── UpdatePowerLow           the battery is less than half full
    ├── UpdateAtRisk             captures cannot be read or written
    ├── UpdateNowhere            no update was found where one was looked for
    ├── UpdateUnreachable        the server that has it does not answer, or stopped
    ├── UpdateSourceGone         the stick was pulled out
    ├── UpdateForeign            nobody we trust has signed it
    ├── UpdateDamaged            it is not whole
    ├── UpdateWrongDevice        it is for another device
    ├── UpdateOlder              it is not newer than what runs
    ├── UpdateTooFar             it needs a version in between
    ├── UpdateNoRoom             it does not fit
    └── UpdateFailed             it could not be written, or did not do when it was tried
"""

from typing import ClassVar


class DiffuscopeError(Exception):
    """Something went wrong; `code` names it for the log, `remedy` says in plain words what to do.

    `n` and `wait_s` are what the page's own words need: how many (minutes, people), and how long until it is over.
    """

    code: ClassVar[str] = "fault"
    default_remedy: ClassVar[str] = "Turn the device off and on. If it happens again, call the technician."

    def __init__(
        self, message: str, remedy: str | None = None, *, n: int | None = None, wait_s: float | None = None
    ) -> None:
        super().__init__(message)
        self.message, self.n, self.wait_s = message, n, wait_s
        self.remedy = remedy if remedy is not None else self.default_remedy


class InputError(DiffuscopeError, ValueError):
    """Something that was handed to the instrument cannot be used."""

    code = "input"
    default_remedy = "Check the input and try again."


class SpecError(InputError):
    """A head, recording or scene file says something that cannot be."""

    code = "input.spec"
    default_remedy = "Correct the named line of the file and start again."


class FrameError(InputError):
    """A raw frame is not an image that can be reconstructed."""

    code = "input.frame"
    default_remedy = "Give an uncompressed raw image (tiff, png or npy) with rows and columns of counts."


class PsfError(InputError):
    """A point spread function cannot be one."""

    code = "input.psf"
    default_remedy = "Measure the point spread function again, or give the file that belongs to this head."


class SettingError(InputError):
    """A method, budget or option is out of its range."""

    code = "input.setting"
    default_remedy = "See `diffuscope methods` and `diffuscope reconstruct --help` for what can be chosen."


class HardwareError(DiffuscopeError, OSError):
    """A part of the head does not do its work."""

    code = "hardware"


class CameraMissing(HardwareError):
    """The camera does not answer."""

    code = "camera.missing"
    default_remedy = "The camera is not answering. Turn the device off and on."


class CameraStalled(HardwareError):
    """The camera answered once and then stopped giving frames."""

    code = "camera.stalled"
    default_remedy = "The live picture has stopped. Wait a moment; if it stays, turn the device off and on."


class CameraWrong(HardwareError):
    """The camera is not the one that the head's file describes."""

    code = "camera.wrong"
    default_remedy = "This camera does not belong to this head. Start with the head file of the sensor that is fitted."


class CameraPacked(HardwareError):
    """The camera gives packed or compressed counts only, which lose what a measurement needs."""

    code = "camera.packed"
    default_remedy = "The camera's driver gives no plain counts. Update the operating system, then start again."


class LightFault(HardwareError):
    """The lamp does not do what it was told."""

    code = "light.fault"
    default_remedy = "One light is not working. Do not take pictures; call the technician."


class LightLimit(HardwareError):
    """The guard refuses more light."""

    code = "light.limit"
    default_remedy = "This eye has had enough light for now. Let it rest before the next picture."


class LightCut(LightLimit):
    """The guard ended a light before its exposure was over: the computer was late, the eye has had little."""

    code = "light.cut"
    default_remedy = "The light went out too early, so there is no picture. Take it again."


class LightDay(LightLimit):
    """An eye has had all the light of a day."""

    code = "light.day"
    default_remedy = "This eye has had today's full light. Do not take more pictures of it."


class BusFault(HardwareError):
    """A chip on the I2C bus does not answer, or answers nonsense."""

    code = "bus.fault"
    default_remedy = (
        "A sensor inside the device does not answer. Turn the device off and on; if it stays, call the technician."
    )


class MemoryDamaged(BusFault):
    """The head's memory answers, but what it holds is not whole: power went away while it was written."""

    code = "head.memory"
    default_remedy = (
        "The device does not know which head is fitted. Call the technician, who writes the head's memory anew with "
        "`diffuscope calibrations use ID --archive DIR --head HEAD`."
    )


class HeadMismatch(HardwareError):
    """The head's memory names another head or another calibration than the one that is loaded."""

    code = "head.mismatch"
    default_remedy = "This head was calibrated as another one. Do not take pictures; call the technician."


class TooHot(HardwareError):
    """The head is too warm to go on."""

    code = "head.hot"
    default_remedy = "The device is too warm. Turn it off, and let it cool in the shade."


class PowerLow(HardwareError):
    """The battery is nearly empty."""

    code = "power.low"
    default_remedy = "The battery is nearly empty. Charge the device before the next picture."


class CalibrationError(DiffuscopeError):
    """What the factory measured about a head cannot be used."""

    code = "calibration"
    default_remedy = "Calibrate the head again, or go back to an earlier calibration."


class CalibrationMissing(CalibrationError):
    """There is no calibration, or none of that name."""

    code = "calibration.missing"
    default_remedy = "Calibrate the head, or import its calibration from the service centre."


class CalibrationDamaged(CalibrationError):
    """The files of a calibration are missing or are not what was kept."""

    code = "calibration.damaged"
    default_remedy = "This calibration is damaged. Go back to an earlier one, or import it again."


class CalibrationOld(CalibrationError):
    """The calibration was made so long ago that it must be made anew."""

    code = "calibration.old"
    default_remedy = "This calibration is too old. Calibrate the head again before the next patient."


class CalibrationStale(CalibrationError):
    """Ordinary pictures show that the head is no longer as it was when it was calibrated."""

    code = "calibration.stale"
    default_remedy = "Something in the head has moved or aged since it was calibrated. Calibrate it again."


class CalibrationOtherMode(CalibrationError):
    """The calibration was measured in another mode of the sensor than the head's file says."""

    code = "calibration.mode"
    default_remedy = "Start with the head file that the head was calibrated with, or calibrate it in this mode."


class CalibrationFormat(CalibrationError):
    """The calibration was kept in a format that this version of the software does not read."""

    code = "calibration.format"
    default_remedy = "Export it again with the version of the software that is installed here, or calibrate the head."


class CalibrationUntrusted(CalibrationError):
    """A calibration from elsewhere that nobody whom we trust has signed as it is now."""

    code = "calibration.untrusted"
    default_remedy = "Do not use this file. Ask the service centre for it again, and for its public key."


class CalibrationRefused(CalibrationError):
    """A step of a calibration saw what it cannot measure by; earlier steps are kept, the old calibration stays."""

    code = "calibration.refused"
    default_remedy = "Put right what stands before the head, then start `diffuscope calibrate` again: it goes on here."


class CalibrationStopped(CalibrationError):
    """The technician stopped a calibration; what was measured is kept, and the old one stays in force."""

    code = "calibration.stopped"
    default_remedy = "Start the calibration again when you are ready: it goes on where it was."


class TechnicianError(DiffuscopeError):
    """The technician's door stays shut."""

    code = "technician"
    default_remedy = "Go back to the pictures, or call the technician."


class TechnicianLocked(TechnicianError):
    """Nobody has said the PIN, or nobody has touched the page for too long."""

    code = "technician.locked"
    default_remedy = "Give the technician's PIN."


class PinWrong(TechnicianError):
    """That is not the PIN, or it cannot be one."""

    code = "technician.pin"
    default_remedy = "Give the PIN that was set on this device: 4 to 12 digits."


class PinTooSoon(TechnicianError):
    """Too many wrong PINs: the next try has to wait."""

    code = "technician.wait"
    default_remedy = "Wait until the time is over, then try again."


class Busy(DiffuscopeError):
    """The instrument is taking another picture."""

    code = "busy"
    default_remedy = "A picture is being taken. Wait until it is done, then press again."


class Refused(DiffuscopeError):
    """Who asks may not do this, or not now."""

    code = "refused"
    default_remedy = "Reload the page and try again."


class OtherScreen(Refused):
    """Another screen holds the instrument."""

    code = "link.other"
    default_remedy = "Another screen is taking pictures."


class Forged(Refused):
    """A request that changes something comes from a page that this instrument did not serve."""

    code = "link.forged"
    default_remedy = "Close the other page, and open the camera's own page again."


class WrongHost(Refused):
    """The instrument was asked by a name that is not its own."""

    code = "link.host"
    default_remedy = "Open the page by the camera's address, as it is written on the device."


class VisitFinished(Refused):
    """The visit is finished, and nothing can be changed in it."""

    code = "visit.finished"
    default_remedy = "This visit is finished. Begin a new visit for this person."


class ConsentMissing(Refused):
    """No consent is recorded for the visit: no light, neither for a picture nor for aiming."""

    code = "consent.missing"
    default_remedy = "First ask the person: may we take pictures of the eyes? Then choose the answer."


class ConsentDeclined(Refused):
    """The recorded answer of the visit is no, at first or later: no light, neither for a picture nor for aiming."""

    code = "consent.declined"
    default_remedy = "This person did not agree. Take no pictures, and finish the visit."


class StoreError(DiffuscopeError):
    """The shelf cannot do what was asked."""

    code = "store"
    default_remedy = "The picture could not be kept. Call the technician."


class StoreFull(StoreError):
    """There is no room for another capture."""

    code = "store.full"
    default_remedy = "No space left. Nothing that was kept is lost. Copy pictures to a USB stick and remove old ones."


class StoreDamaged(StoreError):
    """A kept file is missing or is not what was kept."""

    code = "store.damaged"
    default_remedy = "This kept file is damaged. Copy what can be read and call the technician."


class StickFull(StoreError):
    """The USB stick has no room for what should be copied."""

    code = "stick.full"
    default_remedy = "The USB stick is full. Nothing was lost. Use another stick, or make room on this one."


class StickGone(StoreError):
    """The USB stick is not there any more, or cannot be written."""

    code = "stick.gone"
    default_remedy = "The USB stick cannot be written. Nothing was lost. Put it in again, and copy once more."


class NotKept(StoreError, LookupError):
    """There is no capture with this name."""

    code = "store.unknown"
    default_remedy = "Choose a picture from the list."


class SendError(DiffuscopeError):
    """A visit was not sent; it stays on this device, whole."""

    code = "send"
    default_remedy = "Nothing is lost. Copy the visit to a USB stick, and call the technician."


class SendOff(SendError):
    """No receiver is set up."""

    code = "send.off"
    default_remedy = "Nothing is sent from this device. Copy visits to a USB stick, or save them as files."


class SendUnreachable(SendError):
    """The receiver does not answer, or answers that it cannot take anything now: that passes."""

    code = "send.link"
    default_remedy = "It is tried again by itself. Look whether this device is connected to the internet."


class SendUntrusted(SendError):
    """Whoever answers cannot prove to be the receiver; a wrong clock looks the same."""

    code = "send.certificate"
    default_remedy = "Look whether the date of this device is right. If it is, call the technician."


class SendLocked(SendError):
    """The receiver does not let this device in."""

    code = "send.key"
    default_remedy = "The receiver does not know this device. Call the technician: its key must be renewed."


class SendRejected(SendError):
    """The receiver refuses this visit, and would again."""

    code = "send.refused"
    default_remedy = "The receiver does not take this visit. Copy it to a USB stick, and call the technician."


class SendUnlike(SendError):
    """What the receiver has under the name of this visit is not what was sent."""

    code = "send.unlike"
    default_remedy = (
        "The receiver has only a part of it, or something else. Copy it to a USB stick, and call the technician."
    )


class UpdateError(DiffuscopeError):
    """Another version cannot be installed; the one that runs stays."""

    code = "update"


class UpdateBusy(UpdateError):
    """Another update is under way."""

    code = "update.busy"
    default_remedy = "An update is under way already. Wait until it is done."


class UpdateNotUnderstood(UpdateError):
    """What was asked for is nothing that can be asked for."""

    code = "update.request"
    default_remedy = "Reload the page, look for updates once more, and choose one of those that are listed."


class UpdateUncommitted(UpdateError):
    """The version that runs is being tried and is not committed yet."""

    code = "update.uncommitted"
    default_remedy = (
        "The version before this one must stay until this one has shown that it works. Wait some minutes, "
        "then try again."
    )


class UpdateDuringExam(UpdateError):
    """A picture is being taken."""

    code = "update.exam"
    default_remedy = "Finish the examination first, then start the update again."


class UpdatePowerLow(UpdateError):
    """The battery is less than half full."""

    code = "update.power"
    default_remedy = "Connect the charger, and start the update again when the battery is half full."


class UpdateAtRisk(UpdateError):
    """The captures on this device cannot be read or written as they should."""

    code = "update.captures"
    default_remedy = "Copy the pictures to a USB stick first, and call the technician."


class UpdateNowhere(UpdateError):
    """There is no update where it was looked for."""

    code = "update.nowhere"
    default_remedy = "Put in the USB stick that holds the update, a file whose name ends in .raucb."


class UpdateUnreachable(UpdateError):
    """The server that has the update does not answer, or stopped answering."""

    code = "update.link"
    default_remedy = "The connection was lost. What has arrived is kept: try again later, and it goes on from there."


class UpdateSourceGone(UpdateError):
    """What the update was read from is gone."""

    code = "update.stick"
    default_remedy = "Put the USB stick back in and leave it there until the update is done. Nothing has changed yet."


class UpdateForeign(UpdateError):
    """The update is not signed by anybody whom this device trusts."""

    code = "update.foreign"
    default_remedy = "Do not use this file. Get the update from the maker of the device."


class UpdateDamaged(UpdateError):
    """The update is not whole, or was changed on its way."""

    code = "update.damaged"
    default_remedy = "This file is damaged. Copy it to the stick again, or download it again."


class UpdateWrongDevice(UpdateError):
    """The update is for another kind of device."""

    code = "update.device"
    default_remedy = "Get the update for this device: the file's name says which one it is for."


class UpdateOlder(UpdateError):
    """The update is not newer than the version that runs."""

    code = "update.older"
    default_remedy = "Nothing needs to be done: this device has that version or a newer one."


class UpdateTooFar(UpdateError):
    """The update cannot be installed on a version as old as the one that runs."""

    code = "update.step"
    default_remedy = "Install the version in between first; the message names it."


class UpdateNoRoom(UpdateError):
    """There is no room for the update."""

    code = "update.room"
    default_remedy = "Copy pictures to a USB stick and remove old ones, then try again. Nothing that was kept is lost."


class UpdateFailed(UpdateError):
    """The update could not be written, or did not work when it was tried."""

    code = "update.failed"
    default_remedy = (
        "This device works on with the version that it had. Try again; if it happens again, call the technician."
    )
