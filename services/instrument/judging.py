"""What the page hears about a frame: how to aim before it, and whether it is good, at once and after its making."""

from dataclasses import asdict
from typing import Any

import numpy as np

from device.errors import FrameError
from device.recon.aim import Aim, Aimer
from device.recon.kernels import Pixels
from device.recon.laterality import laterality
from device.recon.plan import Planner
from device.recon.verdict import Gate, Verdict, after, judge
from device.spec import CameraSpec
from device.values import Calibration, Image, Report
from services.instrument.bulletin import Bulletin
from services.instrument.filing import UNMADE
from services.records.errand import Errand

CENTRE = "centre"  # the part, in a programme, whose pictures have the macula in their middle
NOWHERE = Aim("noeye", 0.0)
FAILED = Verdict("again", "make.failed", {})


class Watch:
    """Reads frames for whoever owns the head, and tells pages what it saw; one thread at a time."""

    def __init__(
        self, calibration: Calibration, shape: tuple[int, int], planner: Planner, index: int, camera: CameraSpec,
        bulletin: Bulletin,
    ) -> None:  # fmt: skip
        self._gate = Gate(calibration, shape, planner, index)
        self._aimer, self._bulletin = Aimer(camera.exposure_s, self._gate.deg_per_sample), bulletin
        self._geometry, self._field_deg, self._upright = calibration.geometry, calibration.field_deg, camera.upright
        self._told: Aim | None = None

    def aim(self, counts: Pixels, exposed_s: float) -> Aim:
        """What to do after one more live frame; pages are told when the word changes."""
        aim = self._aimer(self._gate(counts), self._gate.picture, exposed_s)
        if self._told is None or self._told.code != aim.code:
            self._told = aim
            self._bulletin.tell("aim", **asdict(aim))
        return aim

    def judge(self, id: str, counts: Pixels, dark: Pixels, begin_s: float) -> Verdict:
        """Whether a frame is good, from its raw counts, told to pages before anything is made of it."""
        try:
            reading = self._gate(counts, dark)
        except FrameError:  # of another shape than the calibration, or with no pixel that is good
            return self._say(id, FAILED)
        return self._say(id, judge(reading, self._aimer.saw_an_eye(begin_s)))

    def judge_again(self, id: str, first: Verdict, report: Report, errand: Errand) -> Verdict:
        """The last word, when the picture is made; pages are told if it is another."""
        if report.method == UNMADE and first.code is None:
            first = FAILED
        again = after(first, report.residual, report.quality.get("coverage"), errand.tries, errand.retakes)
        return again if (again.word, again.code) == (first.word, first.code) else self._say(id, again)

    def side(self, picture: Image, verdict: Verdict, errand: Errand) -> dict[str, Any] | None:
        """Which eye a good, macula-centred picture (the field's box of it) seems to be of; None where nobody looked."""
        asked = self._upright and verdict.word == "good" and errand.field == CENTRE
        if not asked or self._geometry is None or self._field_deg is None:
            return None
        plain = picture if picture.ndim == 2 else picture[..., int(np.argmax(picture.mean(axis=(0, 1))))]
        return asdict(laterality(plain, self._geometry.px_per_deg, self._field_deg))

    def _say(self, id: str, verdict: Verdict) -> Verdict:
        self._bulletin.tell("verdict", id=id, **asdict(verdict))
        return verdict
