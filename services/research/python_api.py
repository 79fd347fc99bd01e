"""Python interface for researchers: reconstruct, forward model, simulate and frontier, on arrays or files.

`diffuscope` (services/package.py) exports it. Each function runs the same code as the command of its name. Images are
(rows, cols), colour images (rows, cols, 3); the centre of a PSF is at (rows//2, cols//2).
"""

import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from device.config.head_file import InstrumentSpec, load_head
from device.config.image_files import Raw, as_psf, read_psf
from device.errors import FrameError, SettingError
from device.recon.estimation.defective_pixels import without_hot_pixels
from device.recon.estimation.parameter_selection import FrequencySample
from device.recon.installed_methods import available_methods
from device.recon.methods import Method
from device.recon.model.fft_plans import Planner
from device.recon.model.forward_model import Model, taper
from device.recon.model.grid import Grid, support_radius_px
from device.sim import scene_files
from device.sim.plan import Decision, decide, format_plan
from device.sim.render import crop_or_pad
from device.sim.simulated_calibration import simulated_calibration
from device.sim.world import World
from device.values import Image, Mask, Psf, SimulatedCounts
from services import resources
from services.research.frontier import Case, measure_frontier, recorded_case, scene_case, selected_methods
from services.research.frontier_result import Frontier
from services.research.named_files import head_file, scene_file
from services.research.psf_stack import psf_stack
from services.research.reconstruct_file import (
    FileReconstruction,
    FileReconstructor,
    one_picture_reconstructor,
    parse_bayer,
)
from services.research.reconstruct_inputs import RawSource, ReconstructOptions, Source

ImageSource = str | Path | NDArray[Any] | Raw | Psf


class ReconstructionOptions(TypedDict, total=False):
    """Keywords of `reconstruct` and `Reconstructor`.

    An option that is left out is chosen from PSF and frame.

    Attributes
    ----------
    dark
        Dark frame of the same exposure, (rows, cols) of the raw.
    flat
        Frame of even light, (rows, cols) of the raw.
    head
        Geometry of the light path and sensor: a head file, the name of a shipped head or scene, or the
        result of `simulate`.
    field_deg
        Diameter of the illuminated disc in degrees, with `head`.
    method
        Name of `methods()`, or FILE.py:NAME.
    bin
        bin x bin pixels become one sample.
    rounds
        Largest number of rounds of an iterative method.
    settings
        Parameters of the method, such as {"tau": 0.1}.
    budget_s
        Time limit in seconds.
    bayer
        The raw is a mosaic of this pattern, "rggb", "bggr", "grbg" or "gbrg"; "none": it is monochrome,
        whatever a DNG says.
    refraction
        False leaves out the eye's refraction, which is estimated with `head`.
    gamma
        Exponent, 0.2 to 5, that makes the counts of raw, dark and flat frame linear in the light: 2.2 for sRGB.
    """

    dark: ImageSource
    flat: ImageSource
    head: "str | Path | SimulatedScene"
    field_deg: float
    method: str
    bin: int
    rounds: int
    settings: Mapping[str, float]
    budget_s: float
    bayer: str
    refraction: bool
    gamma: float


def reconstruct(
    raw: ImageSource, psf: ImageSource | Sequence[ImageSource], **options: Unpack[ReconstructionOptions]
) -> FileReconstruction:
    """Return the picture of one raw frame, with its report.

    Source: paper, section "Algorithm"; NUMERICS.md.

    Parameters
    ----------
    raw
        Counts, (rows, cols) or (rows, cols, 3): an array, a file (tiff, png, npy, npz, dng), or the raw of
        a `Pair`.
    psf
        Image of one bright point, (rows, cols) as `raw`, or the PSFs of a `Pair`. Several, or a folder of
        files, are a stack, of which the most likely one is used.
    **options
        `ReconstructionOptions`.

    Returns
    -------
    FileReconstruction
        Picture, float32 in linear DN, (rows, cols) or (rows, cols, 3) of `raw`, and report; marked as
        simulated if `raw` came from `simulate`.

    Raises
    ------
    FrameError
        A raw, dark or flat frame cannot be used.
    PsfError
        A PSF cannot be used.
    SettingError
        Options are out of range or contradict each other.
    TypeError
        A keyword is no option.
    """
    return one_picture_reconstructor(_options(psf, options))(_raw(raw))


class Reconstructor:
    """Reconstruction of many frames with one PSF: what does not depend on the frame is computed once.

    Plans are made for the first frame of a shape (rows, cols) and kept. Use it from one thread at a time.

    Parameters
    ----------
    psf
        PSF or stack of PSFs, as in `reconstruct`.
    **options
        `ReconstructionOptions`.

    Raises
    ------
    SettingError
        Options are out of range or contradict each other.
    TypeError
        A keyword is no option.
    """

    def __init__(self, psf: ImageSource | Sequence[ImageSource], **options: Unpack[ReconstructionOptions]) -> None:
        self._reconstruct = FileReconstructor(_options(psf, options))

    def __call__(self, raw: ImageSource) -> FileReconstruction:
        """Return the picture of one raw frame, as `reconstruct` does.

        Parameters
        ----------
        raw
            Counts, (rows, cols) or (rows, cols, 3), as in `reconstruct`.

        Returns
        -------
        FileReconstruction
            Picture, float32 in linear DN, (rows, cols) or (rows, cols, 3) of `raw`, and report.

        Raises
        ------
        FrameError
            The frame cannot be used.
        PsfError
            A PSF does not fit the frame.
        """
        return self._reconstruct(_raw(raw))


class ForwardModel:
    """Forward model y = crop(h * x) of a PSF h: the frame y of an object x, the adjoint, and the noise of a frame.

    An object is float32 of `object_shape`, a frame float32 of `frame_shape`, both (rows, cols) in samples
    of bin x bin pixels and linear DN. The object is larger than the frame, because light from outside of it
    reaches the sensor. Source: paper, equation (1); NUMERICS.md 1.

    Parameters
    ----------
    psf
        Image of one bright point, (rows, cols), an array or a file.
    shape
        (rows, cols) of the sensor in pixels; None: that of `psf`.
    bin
        bin x bin pixels become one sample.
    field_radius_px
        Radius of the lit disc, outside of which the object is 0; None: not known.

    Raises
    ------
    PsfError
        The PSF is invalid.
    SettingError
        `bin` or radius is out of range.
    """

    def __init__(
        self,
        psf: ImageSource,
        shape: tuple[int, int] | None = None,
        *,
        bin: int = 1,
        field_radius_px: float | None = None,
    ) -> None:
        source = _source(psf)
        kernel = without_hot_pixels(read_psf(source) if isinstance(source, Path) else as_psf(source, "the PSF"))
        sensor = shape or kernel.shape
        if not 1 <= bin <= min(sensor):
            raise SettingError(f"a bin of {bin} does not fit {sensor[0]} x {sensor[1]} pixels", "Give a bin from 1.")
        if field_radius_px is not None and not field_radius_px > 0:
            raise SettingError(f"a field of radius {field_radius_px:g} px is empty", "Give a radius above 0, or None.")
        radius_px = float("inf") if field_radius_px is None else field_radius_px
        grid = Grid.tight(sensor, bin, radius_px, support_radius_px(kernel))
        self._model = Model(kernel, grid, Planner(resources.fft_plans()))
        self._sample = FrequencySample.of(self._model)

    @property
    def object_shape(self) -> tuple[int, int]:
        """(rows, cols) of an object, in samples."""
        return self._model.grid.shape

    @property
    def frame_shape(self) -> tuple[int, int]:
        """(rows, cols) of a frame, in samples."""
        return self._model.grid.window

    def forward(self, x: Image) -> Image:
        """Return the frame of an object.

        Parameters
        ----------
        x
            Object, float32 of `object_shape`.

        Returns
        -------
        Image
            Frame, float32 of `frame_shape`.

        Raises
        ------
        FrameError
            The object has another shape.
        """
        _require(x, self.object_shape, "the object")
        return self.crop(self._model.blur(x * self._model.mask))

    def adjoint(self, y: Image) -> Image:
        """Return the adjoint of `forward` for a frame.

        <forward(x), y> = <x, adjoint(y)> for every x and y.

        Parameters
        ----------
        y
            Frame, float32 of `frame_shape`.

        Returns
        -------
        Image
            Object, float32 of `object_shape`.

        Raises
        ------
        FrameError
            The frame has another shape.
        """
        adjoint: Image = self._model.blur_adjoint(self.embed(y)) * self._model.mask
        return adjoint

    def embed(self, y: Image) -> Image:
        """Return the object that is a frame in front of the sensor, and 0 elsewhere.

        Parameters
        ----------
        y
            Frame, float32 of `frame_shape`.

        Returns
        -------
        Image
            Object, float32 of `object_shape`.

        Raises
        ------
        FrameError
            The frame has another shape.
        """
        _require(y, self.frame_shape, "the frame")
        x: Image = np.zeros(self.object_shape, np.float32)
        x[self._model.grid.slices] = y
        return x

    def crop(self, x: Image) -> Image:
        """Return the part of an object in front of the sensor.

        Parameters
        ----------
        x
            Object, float32 of `object_shape`.

        Returns
        -------
        Image
            Frame, float32 of `frame_shape`.

        Raises
        ------
        FrameError
            The object has another shape.
        """
        _require(x, self.object_shape, "the object")
        return np.ascontiguousarray(x[self._model.grid.slices], np.float32)

    def noise_dn(self, y: Image) -> float:
        """Return the standard deviation of the noise of a frame.

        It is measured at the quarter of the frequencies that the PSF transmits least (NUMERICS.md 2.1). Shot
        noise differs over a frame: then it is the mean.

        Parameters
        ----------
        y
            Frame, float32 of `frame_shape`.

        Returns
        -------
        float
            Standard deviation in DN per sample.

        Raises
        ------
        FrameError
            The frame has another shape.
        """
        _require(y, self.frame_shape, "the frame")
        window = taper(self.frame_shape)
        fft = self._model.fft
        fft.space[:] = 0
        fft.space[self._model.grid.slices] = (y - np.float32(y.mean(dtype=np.float64))) * window
        size = self._model.grid.size
        variance = self._sample.noise_variance(self._sample.energies(fft.forward()), size) * size
        return float(np.sqrt(variance / float(np.vdot(window, window))))


@dataclass(frozen=True)
class SimulatedScene:
    """Simulated exposures with their ground truth, all (rows, cols) of the sensor.

    Attributes
    ----------
    name
        Name of the scene.
    raw
        Counts, uint16, of a type that marks pictures made of it as simulated.
    truth
        Reflectance of the object, float32.
    psf
        Noise-free PSF of the present eye, float32.
    vessels
        Mask of the vessels; None if not known.
    plan
        Decision on every effect, by its name.
    frames
        Frames of the burst, of which `raw` is the first.
    world
        Simulated parts that took the frames.
    """

    name: str
    raw: SimulatedCounts
    truth: Image
    psf: Image
    vessels: Mask | None
    plan: Mapping[str, Decision]
    frames: tuple[SimulatedCounts, ...]
    world: World = field(repr=False)

    def explain(self) -> str:
        """Return the plan as a text table.

        Returns
        -------
        str
            A line for each effect: simulated or not, and the figure that decided.
        """
        return format_plan(tuple(self.plan.values()))

    def write(self, folder: str | Path) -> None:
        """Write raw.tiff (raw-2.tiff, ...), truth.npy, psf.tiff, vessels.png and plan.json.

        Parameters
        ----------
        folder
            Folder of the files, made if it does not exist.

        Raises
        ------
        StoreError
            A file cannot be written.
        """
        scene_files.write(self.world, [np.asarray(frame) for frame in self.frames], Path(folder))


def simulate(
    scene: str | Path,
    *,
    everything: bool = False,
    only: Sequence[str] = (),
    without: Sequence[str] = (),
    frames: int = 1,
) -> SimulatedScene:
    """Return simulated exposures of a scene, with their ground truth.

    Only the effects that could be seen are simulated.

    Parameters
    ----------
    scene
        Scene file, or the name of one of device/sim/scenes/, such as "healthy".
    everything
        Simulate every effect.
    only
        Names of the effects to simulate.
    without
        Names of effects to leave out.
    frames
        Number of exposures of one burst, with the same diffuser and eye, and new noise and motion.

    Returns
    -------
    SimulatedScene
        Counts, truth and PSF, (rows, cols) of the sensor of the scene.

    Raises
    ------
    SettingError
        The scene or an effect is unknown, or `everything` and `only` are both given.
    SpecError
        The scene file is invalid.
    """
    spec = load_head(scene_file(scene))
    world, taken = scene_files.expose(
        spec, lambda setting: decide(setting, everything=everything, only=tuple(only), without=tuple(without)), frames
    )
    counts = tuple(frame.view(SimulatedCounts) for frame in taken)
    colour = spec.light.colour
    mask = world.retina.vessels
    return SimulatedScene(
        name=spec.name,
        raw=counts[0],
        truth=world.truth(colour),
        psf=crop_or_pad(world.psf(colour), world.shape),
        vessels=None if mask is None else crop_or_pad(mask.astype(np.float32), world.shape) > 0.5,
        plan={decision.name: decision for decision in world.plan},
        frames=counts,
        world=world,
    )


def frontier(
    raw: ImageSource | None = None,
    psf: ImageSource | None = None,
    truth: ImageSource | None = None,
    *,
    scene: str | Path | SimulatedScene | None = None,
    head: str | Path | SimulatedScene | None = None,
    field_deg: float | None = None,
    method: str | Sequence[str] = (),
    budget_s: float = 0.26,
    repeats: int = 7,
    progress: Callable[[str], None] = lambda _: None,
) -> Frontier:
    """Return accuracy against time of every method, bin and number of rounds, on this machine.

    Give either `raw`, `psf` and `truth`, or `scene`.

    Parameters
    ----------
    raw
        Counts, (rows, cols) of one grid with `psf` and `truth`.
    psf
        Image of one bright point, (rows, cols).
    truth
        True object, (rows, cols); a shift and the intensity are fitted.
    scene
        Scene file, the name of one, or the result of `simulate`.
    head
        Geometry of the light path, as in `reconstruct`.
    field_deg
        Diameter of the lit disc in degrees, with `head`.
    method
        Name of `methods()` or FILE.py:NAME, one or several; by default all.
    budget_s
        Time in seconds within which the instrument chooses.
    repeats
        Timed runs of each point, of which the median counts.
    progress
        Function that is called with one line per step.

    Returns
    -------
    Frontier
        Points with their choice, time in s and scores.

    Raises
    ------
    SettingError
        Both or neither of frame and scene are given, or `repeats` or `budget_s` is out of range.
    FrameError
        The truth has another shape.
    """
    if repeats < 1 or not budget_s > 0:
        raise SettingError("a time is measured at least once, within a budget above 0", "Give repeats and budget_s.")
    recorded = [part for part in (raw, psf, truth) if part is not None]
    if (scene is None) == (not recorded) or len(recorded) in (1, 2):
        raise SettingError("a frontier needs a frame with its truth", "Give scene=, or raw, psf and truth together.")
    if scene is not None:
        case = _scene_case(scene)
    else:
        assert raw is not None
        assert psf is not None
        assert truth is not None
        files = _raw(raw), _source(psf), _source(truth)
        case = recorded_case(*files, _head(head), field_deg, resources.fft_plans())
    chosen = selected_methods((method,) if isinstance(method, str) else method)
    return measure_frontier(case, resources.fft_plans(), budget_s, repeats, progress, chosen)


def methods() -> dict[str, Method]:
    """Return the built-in and the installed methods.

    Returns
    -------
    dict of str to Method
        Methods by name, each with a sentence, its cost in FFT pairs and settings.

    Raises
    ------
    SettingError
        A plug-in cannot be loaded; the message names its package.
    """
    return available_methods()


def _options(psf: ImageSource | Sequence[ImageSource], given: ReconstructionOptions) -> ReconstructOptions:
    _refuse_unknown(given)
    dark = given.get("dark")
    flat = given.get("flat")
    psfs = psf if isinstance(psf, list | tuple) else (psf,)
    return ReconstructOptions(
        psfs=psf_stack([_source(source) for source in psfs]),
        method=given.get("method"),
        budget_s=given.get("budget_s"),
        dark=None if dark is None else _source(dark),
        flat=None if flat is None else _source(flat),
        head=_head(given.get("head")),
        field_deg=given.get("field_deg"),
        plans=resources.fft_plans(),
        bin=given.get("bin"),
        rounds=given.get("rounds"),
        settings=dict(given.get("settings", {})),
        bayer=parse_bayer(given.get("bayer")),
        refraction=given.get("refraction", True),
        gamma=given.get("gamma"),
    )


def _raw(image: ImageSource) -> RawSource:
    return image if isinstance(image, Raw) else _source(image)


def _source(image: ImageSource) -> Source:
    """Return an image as an input of a reconstruction; a PSF without pedestal stays as it is when cleaned again."""
    if isinstance(image, Psf | Raw):
        return image.pixels
    return Path(image) if isinstance(image, str) else image


def _refuse_unknown(given: ReconstructionOptions) -> None:
    """Raise TypeError for a keyword that is no option, with the nearest one, as Python does for an unknown argument."""
    known = ReconstructionOptions.__annotations__
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"choose from {', '.join(known)}"
            raise TypeError(f"'{name}' is no option of a reconstruction: {hint}")


def _head(head: "str | Path | SimulatedScene | None") -> Path | InstrumentSpec | None:
    if isinstance(head, SimulatedScene):
        return head.world.spec
    return None if head is None else head_file(head)


def _scene_case(scene: str | Path | SimulatedScene) -> Case:
    if not isinstance(scene, SimulatedScene):
        return scene_case(load_head(scene_file(scene)))
    counts = np.asarray(scene.raw)
    calibration = simulated_calibration(scene.world)
    return Case(scene.name, counts, scene.truth, scene.vessels, calibration, False)


def _require(image: Image, shape: tuple[int, int], what: str) -> None:
    if image.shape != shape:
        given = " x ".join(map(str, image.shape))
        raise FrameError(f"{what} has {given} samples, and {shape[0]} x {shape[1]} are needed", "See `embed`.")
