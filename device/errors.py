"""Exception hierarchy of the device; every class carries an error code and a remedy for the operator.

The errors that only services raise are in services/errors.py.

DiffuscopeError
├── InputError (ValueError)      invalid input
│   ├── SpecError                of a head or scene file
│   ├── FrameError               of a raw frame
│   ├── PsfError                 of a point spread function
│   └── SettingError             of a method, budget or option
├── HardwareError (OSError)      failure of a part of the head
│   ├── CameraMissing            no answer from the camera
│   ├── CameraStalled            the camera stopped giving frames
│   ├── CameraMismatch           another sensor, mode or size than in the head file
│   ├── CameraPacked             only packed or compressed counts
│   ├── LightFault               the lamp does not execute its commands
│   ├── LightLimit               light refused by the light guard
│   │   ├── LightCut             light ended by the guard during an exposure
│   │   ├── DailyLightLimit      daily light limit of an eye reached
│   │   └── LightWithoutVisit    limit of light without a visit reached
│   ├── BusFault                 no answer from a chip on the I2C bus
│   │   └── MemoryDamaged        incomplete identity in the head's memory
│   ├── HeadMismatch             another head or calibration in the head's memory
│   ├── TooHot                   head above its temperature limit
│   └── PowerLow                 battery nearly empty
├── CalibrationError             calibration not usable
│   ├── CalibrationMissing       no calibration
│   ├── CalibrationDamaged       files missing or changed (digest mismatch)
│   ├── CalibrationExpired       validity period over
│   ├── CalibrationStale         head changed since the calibration
│   ├── CalibrationModeMismatch  measured in another sensor mode
│   ├── CalibrationFormat        format of another software version
│   ├── CalibrationUntrusted     no valid signature by a trusted key
│   ├── CalibrationRefused       frames do not show the target of the step
│   └── CalibrationStopped       cancelled by the technician
└── StoreError                   failure of a write to the disk
    ├── StoreFull                no space left
    └── StoreReadOnly            the disk takes no changes
"""

from typing import ClassVar


class DiffuscopeError(Exception):
    """Base class of all errors: `code` identifies the error in the log.

    Parameters
    ----------
    message
        Sentence that describes the cause.
    remedy
        Instruction for the operator; by default `default_remedy` of the class.
    n
        Number of minutes or patients in the page's message; None: the message has none.
    wait_s
        Seconds until a retry in the page's message; None: the message has none.
    """

    code: ClassVar[str] = "fault"
    default_remedy: ClassVar[str] = "Turn the device off and on. If it happens again, call the technician."

    def __init__(
        self, message: str, remedy: str | None = None, *, n: int | None = None, wait_s: float | None = None
    ) -> None:
        super().__init__(message)
        self.message, self.n, self.wait_s = message, n, wait_s
        self.remedy = remedy if remedy is not None else self.default_remedy
        self.add_note(self.remedy)  # so that a Python traceback ends with it


class InputError(DiffuscopeError, ValueError):
    """Invalid input to the instrument."""

    code = "input"
    default_remedy = "Check the input and try again."


class SpecError(InputError):
    """Missing or invalid value in a head, recording or scene file, or a specification that cannot be fulfilled."""

    code = "input.spec"
    default_remedy = "Correct the named line of the file and start again."


class FrameError(InputError):
    """Raw frame that is no valid image, does not fit its buffer, or cannot be reconstructed."""

    code = "input.frame"
    default_remedy = "Give an uncompressed raw image (tiff, png or npy) with rows and columns of counts."


class PsfError(InputError):
    """Invalid point spread function (PSF)."""

    code = "input.psf"
    default_remedy = "Measure the point spread function again, or give the file that belongs to this head."


class SettingError(InputError):
    """Method, budget, option or other setting that is unknown or out of its range."""

    code = "input.setting"
    default_remedy = "See `diffuscope methods` and `diffuscope reconstruct --help` for what can be chosen."


class HardwareError(DiffuscopeError, OSError):
    """Failure of a part of the head."""

    code = "hardware"


class CameraMissing(HardwareError):
    """The camera cannot be opened, does not answer, or has been closed."""

    code = "camera.missing"
    default_remedy = "The camera is not answering. Turn the device off and on."


class CameraStalled(HardwareError):
    """The camera was opened and gives no usable frames."""

    code = "camera.stalled"
    default_remedy = "The live picture has stopped. Wait a moment; if it stays, turn the device off and on."


class CameraMismatch(HardwareError):
    """The camera differs from the head file in sensor, mode or size."""

    code = "camera.wrong"
    default_remedy = "This camera does not belong to this head. Start with the head file of the sensor that is fitted."


class CameraPacked(HardwareError):
    """The camera gives packed or compressed counts only, which lose precision that a measurement needs."""

    code = "camera.packed"
    default_remedy = "The camera's driver gives no plain counts. Update the operating system, then start again."


class LightFault(HardwareError):
    """The lamp does not execute its commands."""

    code = "light.fault"
    default_remedy = "One light is not working. Do not take pictures; call the technician."


class LightLimit(HardwareError):
    """The light guard refuses light: too much in a short time, too bright, or the lamp is on already."""

    code = "light.limit"
    default_remedy = "This eye has had enough light for now. Let it rest before the next picture."


class LightCut(LightLimit):
    """The guard turned the light off before the exposure was over, because the computer was late."""

    code = "light.cut"
    default_remedy = "The light went out too early, so there is no picture. Take it again."


class DailyLightLimit(LightLimit):
    """The daily light limit of an eye is reached."""

    code = "light.day"
    default_remedy = "This eye has had today's full light. Do not take more pictures of it."


class LightWithoutVisit(LightLimit):
    """The limit of light without a visit is reached for an eye; a visit may still give light."""

    code = "light.visit"
    default_remedy = "Begin a visit for this patient: without one an eye may have only a part of a day's light."


class BusFault(HardwareError):
    """A chip on the I2C bus does not answer, or its answer is implausible."""

    code = "bus.fault"
    default_remedy = (
        "A sensor inside the device does not answer. Turn the device off and on; if it stays, call the technician."
    )


class MemoryDamaged(BusFault):
    """The identity in the head's memory is incomplete, for example after a power failure during a write."""

    code = "head.memory"
    default_remedy = (
        "The device does not know which head is fitted. Call the technician, who writes the head's memory anew with "
        "`diffuscope calibrations use ID --archive DIR --head HEAD`."
    )


class HeadMismatch(HardwareError):
    """The head's memory names another head or another calibration than the loaded one."""

    code = "head.mismatch"
    default_remedy = "This head was calibrated as another one. Do not take pictures; call the technician."


class TooHot(HardwareError):
    """The head is above its temperature limit."""

    code = "head.hot"
    default_remedy = "The device is too warm. Turn it off, and let it cool in the shade."


class PowerLow(HardwareError):
    """The battery is nearly empty."""

    code = "power.low"
    default_remedy = "The battery is nearly empty. Charge the device before the next picture."


class CalibrationError(DiffuscopeError):
    """The calibration of a head cannot be used."""

    code = "calibration"
    default_remedy = "Calibrate the head again, or go back to an earlier calibration."


class CalibrationMissing(CalibrationError):
    """There is no active calibration, none with this id, or a capture was taken with another one."""

    code = "calibration.missing"
    default_remedy = "Calibrate the head, or import its calibration from the service centre."


class CalibrationDamaged(CalibrationError):
    """Files of a calibration are missing, or their digests differ from the stored ones."""

    code = "calibration.damaged"
    default_remedy = "This calibration is damaged. Go back to an earlier one, or import it again."


class CalibrationExpired(CalibrationError):
    """The validity period of the calibration is over."""

    code = "calibration.old"
    default_remedy = "This calibration is too old. Calibrate the head again before the next patient."


class CalibrationStale(CalibrationError):
    """Ordinary pictures show that the head has changed since its calibration."""

    code = "calibration.stale"
    default_remedy = "Something in the head has moved or aged since it was calibrated. Calibrate it again."


class CalibrationModeMismatch(CalibrationError):
    """The calibration was measured in another sensor mode than that of the head file."""

    code = "calibration.mode"
    default_remedy = "Start with the head file that the head was calibrated with, or calibrate it in this mode."


class CalibrationFormat(CalibrationError):
    """The calibration has a format that this version of the software does not read."""

    code = "calibration.format"
    default_remedy = "Export it again with the version of the software that is installed here, or calibrate the head."


class CalibrationUntrusted(CalibrationError):
    """An imported calibration has no valid signature by a trusted key."""

    code = "calibration.untrusted"
    default_remedy = "Do not use this file. Ask the service centre for it again, and for its public key."


class CalibrationRefused(CalibrationError):
    """A calibration step refused its frames; earlier steps are kept, the old calibration stays active."""

    code = "calibration.refused"
    default_remedy = "Put right what stands before the head, then start `diffuscope calibrate` again: it goes on here."


class CalibrationStopped(CalibrationError):
    """The technician cancelled a calibration; finished steps are kept, the old calibration stays active."""

    code = "calibration.stopped"
    default_remedy = "Start the calibration again when you are ready: it goes on where it was."


class StoreError(DiffuscopeError):
    """A file, record or folder of the instrument cannot be written or read."""

    code = "store"
    default_remedy = "The picture could not be saved. Call the technician."


class StoreFull(StoreError):
    """There is not enough free space on this device, for a capture or another copy of the records."""

    code = "store.full"
    default_remedy = "No space left. Nothing that was saved is lost. Copy pictures to a USB stick and remove old ones."


class StoreReadOnly(StoreError):
    """The disk takes no changes: it is mounted read-only, fails, or belongs to another user."""

    code = "store.readonly"
    default_remedy = "Nothing that was saved is lost. Copy to a USB stick or send, and call the technician."
