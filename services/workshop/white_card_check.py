"""`diffuscope white-card`: white reference of colour pictures, by a white card in the light of the head's own ring.

The reference becomes part of a new calibration, which differs from the one in force in nothing else.
"""

from collections.abc import Callable
from contextlib import closing
from dataclasses import replace

import numpy as np

from device.calibration.archive import Archive, StoredCalibration
from device.calibration.calibration_validity import refuse_simulated_change
from device.calibration.procedure.calibration_sequence import TARGET_FILL_SHARE
from device.calibration.procedure.step_exposures import SHORTEST_S
from device.calibration.white_card import CARD_PLACE, CardFrames, white_reference
from device.clock import Clock
from device.config.head_file import InstrumentSpec
from device.errors import SpecError
from device.head import Head, open_head
from device.light_safety.burst import require_lit
from device.light_safety.dose_ledger import MemoryLedger
from device.optics.matrix import lamps_of
from device.values import Colour, ExposureSettings, Frame, HeadIdentity, Illumination
from services.records.capture_target import OTHER_COLOURS

FRAMES = 4  # of each colour: their spread shows a card that moves
SEARCHES = 6  # exposures in search of one that fills the pixels
BRIGHTEST = 99.9  # percentile that is filled to TARGET_FILL_SHARE
PROMPT = f"Put a matt white card, 60 mm wide, {CARD_PLACE}, in a dark room."


def measure_white_card(
    spec: InstrumentSpec, clock: Clock, ask: Callable[[str], None], progress: Callable[[str], None]
) -> StoredCalibration:
    """Measure the light of a white card in each colour of the lamp; return the calibration with it, now in force.

    `ask` prompts the operator of a real head and returns once the card is there. CalibrationRefused with the reason if
    the frames show no white card; the calibration in force then stays. SpecError for a head file without an archive,
    with pictures in another light than green, or with green LEDs only; errors of the head's parts and its archive.
    """
    if spec.calibration is None:
        raise SpecError(f"{spec.name} names no archive of calibrations", "Give one with --archive.")
    if spec.light.colour != "green":
        raise SpecError(f"{spec.name} takes its pictures in {spec.light.colour}", "Colours are joined to green ones.")
    if len(colours := _colours(spec)) == 1:
        raise SpecError(f"{spec.name} takes no colour pictures", "Its ring has green LEDs only.")
    archive = Archive(spec.calibration.archive)
    with closing(open_head(spec, clock, MemoryLedger(clock))) as head:
        head.check()
        if head.place_white_card is not None:
            head.place_white_card()
        else:
            ask(PROMPT)
        frames: dict[Colour, CardFrames] = {}
        for colour in colours:
            progress(f"measuring the card in {colour} light")
            frames[colour] = _frames(head, clock, colour)
        kept = archive.load(head.calibration.id)
        refuse_simulated_change(kept.calibration, is_simulated=head.kind == "simulated")
        calibration = replace(kept.calibration, white=white_reference(frames, head.calibration))
        archive.add_and_activate(calibration, kept.provenance)
        if head.chips.memory is not None:
            head.chips.memory.write(HeadIdentity(kept.provenance.serial, calibration.id))
        return StoredCalibration(calibration, kept.provenance)


def _colours(spec: InstrumentSpec) -> tuple[Colour, ...]:
    """Return the colours of a press that the head's lamp has, green first."""
    lamps = lamps_of(spec)
    if lamps is None:  # no LEDs of its own: a simulated head
        return "green", "red", "blue"
    colours: tuple[Colour, ...] = ("green", *OTHER_COLOURS)
    return tuple(colour for colour in colours if colour in lamps)


def _frames(head: Head, clock: Clock, colour: Colour) -> CardFrames:
    """Return a dark frame and FRAMES lit ones at an exposure that fills the brightest pixels."""
    illumination = head.light.hazard.brightest(colour)
    exposure_s = longest_s = head.spec.camera.exposure_s
    sensor = head.calibration.sensor
    for _ in range(SEARCHES):
        bright_dn = (
            float(np.percentile(_lit(head, clock, illumination, exposure_s).counts, BRIGHTEST)) - sensor.black_dn
        )
        share = bright_dn / (sensor.white_dn - sensor.black_dn)
        wanted_s = exposure_s * (1 / 8 if share > 0.95 else min(TARGET_FILL_SHARE / max(share, 1e-3), 8.0))
        wanted_s = float(np.clip(wanted_s, SHORTEST_S / 10, longest_s))
        if abs(wanted_s / exposure_s - 1) < 0.2:
            break
        exposure_s = wanted_s
    dark = head.camera.expose(ExposureSettings(exposure_s))
    dark = replace(dark, counts=dark.counts.copy())
    return CardFrames([_lit(head, clock, illumination, exposure_s) for _ in range(FRAMES)], dark, illumination.level)


def _lit(head: Head, clock: Clock, illumination: Illumination, exposure_s: float) -> Frame:
    """Return one frame in the head's light, followed by as long a darkness: the guard asks for it."""
    shot = ExposureSettings(exposure_s)
    head.camera.prepare(shot)
    begin_s = clock.now_s()
    with head.light.on(illumination):
        frame = require_lit(head.camera.expose(shot))
    clock.sleep(clock.now_s() - begin_s)
    return replace(frame, counts=frame.counts.copy())
