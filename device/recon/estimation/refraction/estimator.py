"""Estimation of the eye's refraction from the frame: the stretch of the stored PSF with the highest likelihood.

Defocus and astigmatism stretch the PSF about its axis (see `psf_warp`). The fine structure of |H|^2 is stretched
inversely; it modulates the power spectrum of every frame. The estimate minimises the negative log likelihood E over
mean sphere M, cylinder J0, J45 and the field edge e (`likelihood`, `edge`, NUMERICS.md 7):

    E(M, J0, J45, e) = sum over f of  log S + |R|^2 / S,    S = g_ring |H_T|^2 + s2

The search stretches the PSF of lenslets as well (`spot_stretch`); only the picture (`otf`) uses the model of their
spots. |H_T|^2 includes `likelihood.SMEAR` times its ring mean. R is the tapered spectrum of the frame minus the smooth
part of the object behind the *candidate's* PSF. If that part is blurred by a fixed PSF, the estimate is biased by one
third towards that PSF. The smooth part itself is fitted with the stored PSF for the coarse search over M, and with the
PSF and edge found for each fine search.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from device.errors import SettingError
from device.recon.estimation.defective_pixels import DefectFinder
from device.recon.estimation.psf_warp import Stretch, Wavefront, picture_otf, transform
from device.recon.estimation.refraction.burst import LARGEST_STEP_DPT, MAX_SCATTER_DPT, MIN_FRAMES, FrameScatter
from device.recon.estimation.refraction.crop import CropRefinement
from device.recon.estimation.refraction.crop_model import seen_share
from device.recon.estimation.refraction.cylinder import find_cylinder
from device.recon.estimation.refraction.edge import EdgeLikelihood
from device.recon.estimation.refraction.field import FieldEdge
from device.recon.estimation.refraction.likelihood import RefractionLikelihood
from device.recon.estimation.refraction.lit_disc import seen_disc
from device.recon.estimation.refraction.pupil import SOFT_UM, Pupil, PupilFinder
from device.recon.estimation.refraction.spot_stretch import spot_stretch
from device.recon.estimation.refraction.uncertainty import block_of_frequency, quadratic_model
from device.recon.model.fft_plans import Planner, Spectrum
from device.recon.model.field_of_view import field_radius_px
from device.recon.model.forward_model import Model, otf
from device.recon.model.grid import Pair, support_radius_px
from device.recon.model.kernels import Pixels, Places
from device.recon.model.spots import find_spots
from device.values import Calibration

SPAN_DPT = 10.5  # the eyes that are served, +-10 dpt, and the error of the first estimate
FRINGES = 0.2  # cycles by which the finest structure of |H|^2 moves between two candidates of a search over M
COARSE_FRINGES = 0.3  # the same of the coarse search with the edge
COARSE_PARAMETERS = 1  # of the edge in the coarse search: the radius
MIN_NATS = 100.0  # median minus minimum of the coarse search
MIN_FREQUENCIES = 500
SD_PER_MISSING_DPT = 0.4  # times the missing share: saturated frames of 11 eyes were off by 1.4 sd (rms) without it
ROUNDS = 3  # of smooth part, search and edge; a gap needs them, since its filling biases M towards the PSF of the fit
MAX_ROUNDS = 8  # while an edge moves that was looked for in the picture
SETTLED_SAMPLES, SETTLED_DPT = 0.15, 0.03  # changes of edge and M that end the rounds
MOVING_SAMPLES = 0.6  # last change of an edge that was not found
CROPPED_SD_DPT = 0.6  # a border through an optic disc: rms error of M and J0 of 14 frames, before the refinement
CURVATURE_STEP_DPT = 0.25
MAX_SD_DPT = 1.5
MODEL_SD_DPT = 0.02  # of each component by the model of a refinement, behind a diffuser
MAX_SAMPLE_UM = 36.0  # of a refinement: at 40 um the caustic is not sampled, and eyes are wrong by up to 8 sd
MAX_DISTANCE_SDS = 4.0  # between the refractions from the spectrum and from the frame

CUT = "light is missing at the rim of the PSF, as behind a pupil that is small or off the axis"
MIN_CYLINDER_DPT = 0.25  # |J| of a PSF with cylinder; at 0.5 a picture gains -0.02 to 0.15 dB, and as |J|^2

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Cylinder:
    """Cylinder of the eye as wavefront in dpt, as J0, J45 and their sds; x runs with the columns, y with the rows."""

    j0_dpt: float
    j0_sd_dpt: float
    j45_dpt: float
    j45_sd_dpt: float

    @property
    def in_doubt(self) -> bool:
        """True if the PSF of the mean sphere is to be used: |J| below 0.25 dpt or 3 sd (the rms of both sds).

        A picture loses in proportion to the squared error of (J0, J45), so that an estimate beyond 2 sd is expected to
        gain; but 14 % of the estimates of an eye without a cylinder are, and 1 % beyond 3 sd (Rayleigh distribution).
        """
        size_dpt = np.hypot(self.j0_dpt, self.j45_dpt)
        sd_dpt = np.hypot(self.j0_sd_dpt, self.j45_sd_dpt) / 2**0.5
        return bool(size_dpt < max(MIN_CYLINDER_DPT, 3 * sd_dpt))


@dataclass(frozen=True)
class Refraction:
    """Refraction estimate: mean sphere M in dpt (positive: myopia), its standard deviation, and the search curve.

    The report has the opposite sign (correction at the pupil). `psf_scale` is the scale of the stored PSF; `curve`
    holds (M in dpt, negative log likelihood) of every coarse candidate, sorted; `nats` is the median minus the minimum
    over the coarse grid. `edge` is the edge of the lit field that was found with M.
    `missing_sd_dpt` is the part of the sd from missing pixels, `edge_sd_dpt` that from an edge that was not found near
    its calibrated place. `cylinder` is None before `add_cylinder`, `scatter`
    before `join`.
    """

    m_dpt: float
    sd_dpt: float
    psf_scale: float
    nats: float
    curve: tuple[tuple[float, float], ...]
    edge: FieldEdge
    missing_sd_dpt: float
    cylinder: Cylinder | None = None
    scatter: FrameScatter | None = None
    edge_sd_dpt: float = 0.0

    @property
    def in_doubt(self) -> bool:
        """True if M alone does not call for another PSF: |M| < max(0.12 dpt, 2 sd); of a burst: sd of one frame."""
        sd_dpt = self.sd_dpt if self.scatter is None else self.scatter.stated_sd_dpt
        return abs(self.m_dpt) < max(0.12, 2 * sd_dpt)

    @property
    def psf_wavefront(self) -> Wavefront | None:
        """Wavefront of the PSF of the picture, with the cylinder if it is not in doubt; None for the stored PSF."""
        cylinder = self.cylinder
        if cylinder is not None and not cylinder.in_doubt:
            return Wavefront(self.m_dpt, cylinder.j0_dpt, cylinder.j45_dpt)
        return None if self.in_doubt else Wavefront(self.m_dpt)


@dataclass(frozen=True)
class NoRefraction:
    """The refraction of a frame cannot be determined.

    Attributes
    ----------
    reason
        Reason, a sentence without a full stop.
    is_far
        True: the frame is explained best at the end of +-SPAN_DPT, by a far eye or another PSF.
    is_cut
        True: light is missing from the rim of the PSF, as behind a pupil that hides part of the diffuser.
    """

    reason: str
    is_far: bool = False
    is_cut: bool = False


def can_estimate_refraction(calibration: Calibration) -> bool:
    """Return True if the refraction can be estimated: geometry and field radius are known."""
    return calibration.geometry is not None and np.isfinite(field_radius_px(calibration))


class RefractionEstimator:
    """Estimator of refraction and field edge, planned for one calibration and one sensor shape.

    Parameters
    ----------
    calibration
        Calibration of the head.
    shape
        (rows, cols) of the sensor in pixels.
    planner
        Planner of the FFTs.
    index
        Index of the PSF in the calibration.
    edge_is_known
        True: the edge of the calibration is used as it is.

    Raises
    ------
    SettingError
        Geometry or field are unknown.
    """

    def __init__(
        self, calibration: Calibration, shape: Pair, planner: Planner, index: int, edge_is_known: bool = False
    ) -> None:
        geometry = calibration.geometry
        if geometry is None or not can_estimate_refraction(calibration):
            raise SettingError("a refraction needs the head's geometry and field", "Give --head HEAD.toml.")
        self.geometry = geometry
        self._calibration, self._shape, self._planner, self._index = calibration, shape, planner, index
        spots = find_spots(calibration.psfs[index], geometry)
        self._stretch: Stretch = partial(transform, geometry)
        model_sd_dpt = MODEL_SD_DPT
        if spots is not None:
            self._stretch = by_spots = spot_stretch(spots, calibration.field_deg or 0.0)
            model_sd_dpt = by_spots.sd_dpt
        self._edges = EdgeLikelihood(calibration, geometry, self._stretch, shape, planner, index, edge_is_known)
        taper = self._edges.likelihood.taper
        bands = self._edges.likelihood.bands
        self._spread = float((taper**4).sum() * taper.size / (taper**2).sum() ** 2)
        self._blocks = block_of_frequency(bands.whole)
        reach_px = support_radius_px(calibration.psfs[index])
        self._reach_px = reach_px
        self._refinement = CropRefinement(self._edges, planner, reach_px, model_sd_dpt)
        lever = bands.high / self._edges.grid.n * 2 * reach_px * geometry.scale_per_dpt
        self.step_dpt = float(np.clip(FRINGES / lever, 0.1, 2.0))

    @cached_property
    def defects(self) -> DefectFinder:
        """Defect search of this calibration, for callers of `find` without a search of their own."""
        return DefectFinder(self._calibration, self._shape, self._index)

    @cached_property
    def likelihood(self) -> RefractionLikelihood:
        """Likelihood within the calibrated field edge, for the check of a PSF against frames."""
        otf = self._edges.likelihood.interpolated_otf
        calibration, geometry, stretch = self._calibration, self.geometry, self._stretch
        return RefractionLikelihood(calibration, geometry, stretch, self._shape, self._planner, self._index, otf)

    def find(
        self, counts: Pixels, dark: Pixels | None = None, defects: Places | None = None
    ) -> Refraction | NoRefraction:
        """Estimate the mean sphere M and the field edge of a frame.

        Parameters
        ----------
        counts
            Counts, uint16 or float32 (rows, cols).
        dark
            Dark frame of the same shape; None: that of the calibration.
        defects
            Flat indices of defective pixels, which are left out.

        Returns
        -------
        Refraction or NoRefraction
            M in dpt, positive for myopia, and the edge.
        """
        edges = self._edges
        relaxed = np.zeros(1)
        if edges.band.where.size < MIN_FREQUENCIES:
            return NoRefraction("the PSF passes too few frequencies")
        frame = edges.start(counts, dark, defects)
        if not edges.fit_smooth(relaxed) > 0:
            return NoRefraction("the frame holds no light of the field")
        edges.set_noise(relaxed)
        coarse = Search(lambda m_dpt: edges(np.array([m_dpt]), COARSE_PARAMETERS).nats)
        m_dpt = coarse.grid_search(self.step_dpt * COARSE_FRINGES / FRINGES)
        if coarse.depth_nats < MIN_NATS:
            return NoRefraction("the frame does not show the structure of this PSF")
        m_dpt, edge_sd_dpt = self._within_edge(m_dpt)
        if abs(m_dpt) >= SPAN_DPT:
            return NoRefraction(f"the refraction is beyond {SPAN_DPT:.0f} dpt", is_far=True)
        model = quadratic_model(edges, np.array([m_dpt]), CURVATURE_STEP_DPT, self._blocks)
        if not model.is_minimum:
            return NoRefraction("the likelihood has no clear minimum")
        missing_dpt = SD_PER_MISSING_DPT * frame.missing
        (m_dpt,) = model.minimum
        (sd_dpt,) = np.hypot(model.sds(self._spread), np.hypot(missing_dpt, edge_sd_dpt))
        if sd_dpt > MAX_SD_DPT:
            return NoRefraction(f"the standard deviation would be {sd_dpt:.1f} dpt")
        edge = edges.field_edge(edges.edge_model(model.minimum))
        curve = tuple(sorted(coarse.known.items()))
        scale = self.scale(float(m_dpt))
        return Refraction(
            float(m_dpt), float(sd_dpt), scale, coarse.depth_nats, curve, edge, missing_dpt, edge_sd_dpt=edge_sd_dpt
        )

    def add_cylinder(self, found: Refraction) -> Refraction | NoRefraction:
        """Estimate M, J0 and J45 of the last frame of `find`.

        Parameters
        ----------
        found
            Result of `find`.

        Returns
        -------
        Refraction or NoRefraction
            M, J0 and J45 in dpt.
        """
        try:
            return self._with_cylinder(found)
        except np.linalg.LinAlgError:  # an information matrix without full rank
            return NoRefraction("the frame does not determine a cylinder")

    def join(self, found: Refraction, frames: Sequence[Pixels], dark: Pixels | None) -> Refraction | NoRefraction:
        """Return the refraction of a burst, and the scatter between its frames.

        The sd of M grows to the scatter, if that is larger.

        Parameters
        ----------
        found
            Refraction of the first frame.
        frames
            Counts of all frames, (rows, cols), the first one first.
        dark
            Dark frame of all of them; None: that of the calibration.

        Returns
        -------
        Refraction or NoRefraction
            `found` itself if it has no refined cylinder, or for fewer than MIN_FRAMES frames.
        """
        cylinder = found.cylinder
        if cylinder is None or len(frames) < MIN_FRAMES or not self._is_refined:
            return found
        eye_dpt = np.array([found.m_dpt, cylinder.j0_dpt, cylinder.j45_dpt])
        cleaned = [(counts, dark, self.defects(counts, dark)) for counts in frames]
        try:
            steps_dpt = self._refinement.steps(eye_dpt, found.edge, cleaned)
        except np.linalg.LinAlgError:
            return NoRefraction("a frame of the burst does not determine the refraction")
        if not np.abs(steps_dpt).max() < LARGEST_STEP_DPT:  # also for NaN
            return NoRefraction("a frame of the burst has another refraction than the first one")
        scatter = FrameScatter.of(steps_dpt[:, 0], found.sd_dpt)
        if scatter.sd_dpt > MAX_SCATTER_DPT:
            return NoRefraction(f"the refractions of the frames scatter by {scatter.sd_dpt:.1f} dpt")
        m_dpt, j0_dpt, j45_dpt = (eye_dpt + (steps_dpt - steps_dpt[0]).mean(axis=0)).tolist()
        return replace(
            found,
            m_dpt=m_dpt,
            sd_dpt=found.sd_dpt * scatter.growth,
            psf_scale=self.scale(m_dpt),
            cylinder=replace(cylinder, j0_dpt=j0_dpt, j45_dpt=j45_dpt),
            scatter=scatter,
        )

    def find_pupil(self, counts: Pixels, dark: Pixels | None, defects: Places | None) -> Pupil | None:
        """Find the pupil that explains a frame.

        Parameters
        ----------
        counts
            Counts, uint16 or float32 (rows, cols).
        dark
            Dark frame of the same shape; None: that of the calibration.
        defects
            Flat indices of defective pixels, which are left out.

        Returns
        -------
        Pupil or None
            None if no pupil explains the frame better than the whole PSF.
        """
        found = self.find(counts, dark, defects)
        m_dpt = found.m_dpt if isinstance(found, Refraction) else 0.0
        spots = find_spots(self._calibration.psfs[self._index], self.geometry)
        soft_um = SOFT_UM if spots is None else spots.lens_um / 4  # sd of an even disc along an axis
        return PupilFinder(self._edges, self._planner, self._reach_px, soft_um)(counts, dark, defects, m_dpt)

    @property
    def _is_refined(self) -> bool:
        """True if the samples are fine enough for the refinement."""
        return self._edges.grid.n * self.geometry.pitch_um <= MAX_SAMPLE_UM

    def _with_cylinder(self, found: Refraction) -> Refraction | NoRefraction:
        model = find_cylinder(self._edges, found.m_dpt, self._blocks)
        if model is None:
            return NoRefraction("the likelihood has no clear minimum with a cylinder")
        sds_dpt = np.hypot(np.hypot(model.sds(self._spread), found.edge_sd_dpt), (found.missing_sd_dpt, 0, 0))
        if sds_dpt.max() > MAX_SD_DPT:
            return NoRefraction(f"the standard deviation with a cylinder would be {sds_dpt.max():.1f} dpt")
        eye_dpt = model.minimum
        if self._is_refined:
            refined = self._refinement(eye_dpt)
            if not refined.is_whole:
                return NoRefraction(CUT, is_cut=True)
            if not refined.has_settled:
                return NoRefraction("the refinement of the refraction does not converge")
            if not refined.is_explained:
                return NoRefraction("no retina explains the frame with this PSF")
            distance = np.abs(refined.eye_dpt - eye_dpt) / np.hypot(sds_dpt, refined.sds_dpt)
            if distance.max() > MAX_DISTANCE_SDS:
                return NoRefraction("the frame and its spectrum give different refractions")
            eye_dpt = refined.eye_dpt
            sds_dpt = np.hypot(refined.sds_dpt, (found.missing_sd_dpt, 0, 0))
        (m_dpt, j0_dpt, j45_dpt) = eye_dpt.tolist()
        (sd_dpt, j0_sd_dpt, j45_sd_dpt) = sds_dpt.tolist()
        return replace(
            found,
            m_dpt=m_dpt,
            sd_dpt=sd_dpt,
            psf_scale=self.scale(m_dpt),
            edge=self._edges.field_edge(self._edges.edge_model(eye_dpt)),
            cylinder=Cylinder(j0_dpt, j0_sd_dpt, j45_dpt, j45_sd_dpt),
        )

    def _within_edge(self, m_dpt: float) -> tuple[float, float]:
        """Return M with the field edge, from the M of the coarse search on, and what the edge adds to its sd in dpt.

        An edge that is not found near its calibrated place is looked for in the picture. Then M is uncertain by its
        change between both edges: that of the picture, and the one found from there on. On a cropped sensor it also is
        by what such a border cuts.
        """
        edges = self._edges
        found_dpt, is_found = self._alternate(m_dpt, ROUNDS)
        if is_found:
            return found_dpt, 0.0
        edges.expect(seen_disc(edges, np.array([m_dpt])) or edges.prior.calibrated)
        edges.fit_smooth(np.array([m_dpt]))
        seen_dpt = self._descend(m_dpt, self.step_dpt / 2)
        found_dpt, _ = self._alternate(seen_dpt, MAX_ROUNDS)
        by_crop_dpt = CROPPED_SD_DPT if seen_share(edges.grid, edges.edge, self._reach_px / edges.grid.n) < 1 else 0.0
        return found_dpt, float(np.hypot(found_dpt - seen_dpt, by_crop_dpt))

    def _alternate(self, m_dpt: float, most: int) -> tuple[float, bool]:
        """Return M after at most `most` rounds of smooth part, search over M, and edge, from an M on.

        The second value is True if the edge was found. A soft edge has no structure that looks like another refraction:
        it counts as found once M changes by less than SETTLED_DPT in a round.
        """
        edges, step_dpt = self._edges, self.step_dpt / 2
        is_soft = edges.prior.softness > 1
        for done in range(1, most + 1):
            edges.fit_smooth(np.array([m_dpt]))
            before_dpt = m_dpt
            m_dpt = self._descend(m_dpt, step_dpt)
            change_samples = edges.move_edge(edges(np.array([m_dpt])).step)
            step_dpt = self.step_dpt / 4
            stays = abs(m_dpt - before_dpt) < SETTLED_DPT
            is_settled = stays and (is_soft or change_samples < SETTLED_SAMPLES)
            if is_settled or (done >= ROUNDS and change_samples < MOVING_SAMPLES):
                break
        is_near = change_samples < MOVING_SAMPLES and not edges.prior.is_at_end(edges.edge)
        return m_dpt, is_near or (is_soft and stays)

    def _descend(self, m_dpt: float, step_dpt: float) -> float:
        """Return the M of the next minimum of the likelihood, with the linear model of the edge around `m_dpt`."""
        fine = Search(self._near(m_dpt))
        return fine.fit_parabola(fine.descend(m_dpt, step_dpt), step_dpt)[0]

    def _near(self, m_dpt: float) -> Callable[[float], float]:
        """Return the likelihood of M with the linear model of the edge around `m_dpt`."""
        model = self._edges.edge_model(np.array([m_dpt]))
        return lambda near_dpt: self._edges.near(np.array([near_dpt]), model).nats

    def scale(self, m_dpt: float) -> float:
        """Return the scale factor of the PSF for a mean sphere.

        Parameters
        ----------
        m_dpt
            Mean sphere M in dpt, positive for myopia.

        Returns
        -------
        float
            1 for M = 0, below 1 for myopia.
        """
        return 1 - self.geometry.scale_per_dpt * m_dpt

    def otf(self, model: Model, eye: Wavefront) -> Spectrum:
        """Return the OTF of an eye for a picture on the grid of a model.

        Parameters
        ----------
        model
            Forward model of the picture.
        eye
            Wavefront of the eye.

        Returns
        -------
        Spectrum
            OTF, complex64 (rows, cols//2 + 1).
        """
        spots = find_spots(self._calibration.psfs[self._index], self.geometry)
        if spots is not None:
            return otf(spots.of_eye(eye, self._calibration.field_deg or 0.0), model.grid)
        return picture_otf(self._edges.likelihood.interpolated_otf, model, self._stretch(*eye))


class Search:
    """One-dimensional search over M for the minimum of `value` (in nats), computed once for each candidate."""

    def __init__(self, value: Callable[[float], float]) -> None:
        self._value = value
        self.known: dict[float, float] = {}
        self.depth_nats = 0.0

    def __call__(self, m_dpt: float) -> float:
        """Return the value of the candidate M, which is first clipped to +-SPAN_DPT and rounded to 0.0001 dpt."""
        m_dpt = round(float(np.clip(m_dpt, -SPAN_DPT, SPAN_DPT)), 4)
        if m_dpt not in self.known:
            self.known[m_dpt] = self._value(m_dpt)
        return self.known[m_dpt]

    def grid_search(self, step_dpt: float) -> float:
        """Evaluate equidistant candidates over +-SPAN_DPT, at most `step_dpt` apart, and return the one of least value.

        `depth_nats` becomes the median minus the minimum of these values, in nats.
        """
        grid_dpt = np.linspace(-SPAN_DPT, SPAN_DPT, 2 * max(int(np.ceil(SPAN_DPT / step_dpt)), 2) + 1)
        values = [self(m_dpt) for m_dpt in grid_dpt]
        self.depth_nats = float(np.median(values) - min(values))
        return float(grid_dpt[int(np.argmin(values))])

    def descend(self, m_dpt: float, step_dpt: float) -> float:
        """Return the next local minimum in dpt, downhill from `m_dpt` in steps of `step_dpt`, within +-SPAN_DPT."""
        while True:
            least = min((m_dpt - step_dpt, m_dpt, m_dpt + step_dpt), key=self)
            if least == m_dpt or abs(least) >= SPAN_DPT:
                return float(np.clip(least, -SPAN_DPT, SPAN_DPT))
            m_dpt = least

    def fit_parabola(self, m_dpt: float, step_dpt: float) -> tuple[float, float]:
        """Return the vertex (dpt) of the parabola through m_dpt and m_dpt +- step_dpt, and its second derivative.

        Without a minimum, or beyond SPAN_DPT, the vertex is `m_dpt`; the derivative is at least 0, in nats/dpt^2.
        """
        left, middle, right = (self(m_dpt + k * step_dpt) for k in (-1, 0, 1))
        second = left - 2 * middle + right
        if second <= 0 or abs(m_dpt) + step_dpt > SPAN_DPT:
            return m_dpt, max(second, 0.0) / step_dpt**2
        return m_dpt + 0.5 * (left - right) / second * step_dpt, second / step_dpt**2
