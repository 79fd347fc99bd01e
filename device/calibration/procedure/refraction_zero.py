"""Zero of the refraction: what fixes it in a calibration, and its check against an earlier calibration of the head.

A stretched PSF and an eye with a refraction give the same frames (OPTICS.md 2.6): a PSF magnified by 0.7 % reads as
-2.07 dpt in every eye. No frame shows it, the calibration does: its point source stands in the focus of the model
eye's lens, and an earlier PSF of the same diffuser has the same scale and pattern.
"""

from dataclasses import dataclass

from device.calibration.archive import Archive, StoredCalibration
from device.calibration.procedure.dioptres import fit_similarity, mean_sphere_dpt
from device.errors import CalibrationError, CalibrationRefused
from device.values import Colour, Geometry, Psf

MAX_ZERO_DPT = 0.25  # repeatability of an autorefractor, ISO 10342
MIN_SAME_PATTERN = 0.98  # measured again 0.9999, keystone of 1 % 0.974 to 0.988, of 3 % 0.82 to 0.90
MIN_SAME_DIFFUSER = 0.5  # turned by 1 degree 0.64; another diffuser 0.25
LIKENESS, CHANGE = "psf_likeness", "zero_change_dpt"  # figures of the provenance
ZERO_REMEDY = (
    "Put the point source into the focus of the model eye's lens, see that diffuser or lenslets and sensor sit "
    "tight, and calibrate again. If the head was taken apart, show trial lenses: they fix the zero."
)
PATTERN_REMEDY = (
    "See that diffuser or lenslets and sensor sit tight, straight and unturned, and calibrate again. If they were "
    "exchanged, this is their new pattern."
)


@dataclass(frozen=True)
class ZeroCheck:
    """Comparison of a PSF with that of the earlier calibration `id`, whose zero is known.

    `likeness` is their correlation after scale and shift. `change_dpt` is the correction that the new PSF makes of an
    eye without refraction if the earlier zero holds; None unless the patterns are those of one diffuser.
    """

    id: str
    likeness: float
    change_dpt: float | None

    @property
    def contradicts(self) -> bool:
        """Whether the earlier zero is another one."""
        return self.change_dpt is not None and abs(self.change_dpt) > MAX_ZERO_DPT

    @property
    def figures(self) -> dict[str, float]:
        """Figures for the provenance of the new calibration."""
        if self.likeness < MIN_SAME_DIFFUSER:
            return {}
        return {LIKENESS: self.likeness} | ({} if self.change_dpt is None else {CHANGE: self.change_dpt})

    @property
    def words(self) -> str:
        """One line for the operator."""
        if self.likeness < MIN_SAME_DIFFUSER:
            return f"point: another diffuser or plate than in calibration {self.id}, which says nothing of the zero"
        if self.change_dpt is None:
            return (
                f"point: the pattern is not that of calibration {self.id}, correlation {self.likeness:.2f} (the same "
                f"from {MIN_SAME_PATTERN}). {PATTERN_REMEDY}"
            )
        if self.contradicts:
            return (
                f"point: against calibration {self.id} the PSF makes every refraction {self.change_dpt:+.2f} dpt (at "
                f"most {MAX_ZERO_DPT}): the zero is not known. {ZERO_REMEDY}"
            )
        return f"point: the zero of the refraction is that of calibration {self.id}, {self.change_dpt:+.2f} dpt"


def is_in_focus(source_mm: float | None, eye_mm: float) -> bool:
    """Return whether a point source at a stated distance from the model eye's lens stands in its focus; None: False.

    CalibrationRefused if the distance is another one by more than MAX_ZERO_DPT.
    """
    if source_mm is None:
        return False
    off_dpt = mean_sphere_dpt(source_mm - eye_mm, eye_mm)
    if abs(off_dpt) > MAX_ZERO_DPT:
        raise CalibrationRefused(
            f"the point source is {source_mm:g} mm from a lens of {eye_mm:g} mm: this is an eye of {-off_dpt:+.2f} dpt "
            f"(at most {MAX_ZERO_DPT}), and every refraction would be wrong by it",
            f"Put it {eye_mm:g} mm from the lens, or give the focal length of the lens.",
        )
    return True


def earlier_with_zero(archive: Archive, serial: str) -> StoredCalibration | None:
    """Return the newest intact calibration of a head whose zero of the refraction is known; None without one."""
    for id in reversed(archive.ids()):
        try:
            stored = archive.load(id)
        except CalibrationError:
            continue
        if stored.provenance.serial == serial and stored.calibration.refraction_zero != "relative":
            return stored
    return None


def compare_zero(earlier: StoredCalibration, psf: Psf, colour: Colour, geometry: Geometry) -> ZeroCheck | None:
    """Return the comparison of a new PSF with that of an earlier calibration; None for another sensor mode."""
    calibration = earlier.calibration.for_colour(colour)
    if calibration.psfs[0].shape != psf.shape:
        return None
    found = fit_similarity(calibration.psfs[0], psf, geometry.pitch_um, geometry)
    if found.correlation < MIN_SAME_PATTERN:
        return ZeroCheck(earlier.calibration.id, found.correlation, None)
    offset = calibration.refraction_offset
    scale = found.scale / (1 + geometry.scale_per_dpt * (0.0 if offset is None else offset.m_dpt))
    return ZeroCheck(earlier.calibration.id, found.correlation, (1 / scale - 1) / geometry.scale_per_dpt)
