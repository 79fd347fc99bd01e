"""Wrong inputs of `diffuscope reconstruct`, each a real file or option; as a program, this writes `wrong_inputs.md`.

python -m tests.journey.wrong_inputs
"""

import io
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import tifffile
from PIL import Image
from scipy import ndimage, signal

from services.cli import main
from services.imaging.picture_files import to_png
from tests.progress_lines import without_progress

SHAPE = (96, 128)
Write = Callable[[Path], list[str]]
TABLE = Path(__file__).with_name("wrong_inputs.md")
HEADER = """# Wrong inputs of `diffuscope reconstruct` and their messages

`raw.npy` and `psf.npy` are a correct pair; each row has one mistake. Exit status 2: refused, no picture; 0: the picture
is made, with a note. What follows // is the remedy. Written by `python -m tests.journey.wrong_inputs`; a test compares.

| input | command | exit | message |
|---|---|---|---|"""


@dataclass(frozen=True)
class WrongInput:
    """A wrong input: its name, and the words of the command after its files were written to a folder.

    `answer` is a part of the message. `noted`: the picture is made, and the message is a note.
    """

    name: str
    words: Write
    answer: str
    noted: bool = False


@dataclass(frozen=True)
class Answer:
    """Exit status and printed text of a command."""

    code: object
    out: str
    err: str


def caustic(shape: tuple[int, int] = SHAPE) -> Any:
    """Return a PSF with sharp bright lines, as counts."""
    noise = np.random.default_rng(1).normal(size=shape)
    height = ndimage.gaussian_filter(noise, 3)
    rows, cols = (np.linspace(-1, 1, size) for size in shape)
    lines = 1 / (0.05 + np.abs(height / height.std()))
    inside = np.exp(-4 * (rows[:, None] ** 2 + cols[None] ** 2))
    return np.rint(3000 * lines / lines.max() * inside).astype(np.uint16)


def scene() -> Any:
    """Return a raw frame of a bright object through `caustic`, as counts with noise and a black level of 0."""
    rng = np.random.default_rng(2)
    image = np.zeros(SHAPE)
    image[30:60, 40:90] = 1
    image[40:50, 55:70] = 3
    psf = caustic().astype(float)
    frame = signal.fftconvolve(image, psf / psf.sum(), mode="same")
    return rng.poisson(1500 * np.maximum(frame, 0) / frame.max() + 20).astype(np.uint16)


def reconstruct(folder: Path, *more: str, raw: str = "raw.npy", psf: str | None = "psf.npy") -> list[str]:
    words = ["reconstruct", str(folder / raw), "-o", str(folder / "picture.npy")]
    return [*words, *(["--psf", str(folder / psf)] if psf else []), *more]


def raw_of(name: str, write: Callable[[Path], object] = lambda path: None) -> Write:
    """Return the words for a wrong raw file, which `write` writes."""

    def words(folder: Path) -> list[str]:
        write(folder / name)
        return reconstruct(folder, raw=name)

    return words


def psf_of(name: str, array: Any) -> Write:
    def words(folder: Path) -> list[str]:
        np.save(folder / name, array)
        return reconstruct(folder, psf=name)

    return words


def clipped_flat(folder: Path) -> list[str]:
    rows = np.linspace(-1, 1, SHAPE[0])[:, None]
    flat = np.random.default_rng(3).normal(4400 - 1500 * rows**2, 20, SHAPE)
    np.save(folder / "flat.npy", np.minimum(flat, 4350).astype(np.float32))
    return reconstruct(folder, "--flat", str(folder / "flat.npy"))


def option(*more: str) -> Write:
    return lambda folder: reconstruct(folder, *(word.replace("DIR", str(folder)) for word in more))


def saved(array: Any) -> Callable[[Path], None]:
    return lambda path: np.save(path, array)


def four_channels(dtype: type = np.uint16) -> Any:
    return np.dstack([scene().astype(dtype)] * 4)


def transparent(path: Path) -> None:
    Image.fromarray(np.dstack([np.full((*SHAPE, 3), 90, np.uint8), (scene() > 500).astype(np.uint8)])).save(path)


def cut(path: Path) -> None:
    tifffile.imwrite(path, scene())
    path.write_bytes(path.read_bytes()[:5000])


def labelled_dng(path: Path) -> None:
    tags = [(33421, "H", 2, (2, 2), True), (33422, "B", 4, b"\2\1\1\0", True)]
    tifffile.imwrite(path, scene(), photometric="cfa", extratags=tags)


def compressed_dng(path: Path) -> None:
    labelled_dng(path)
    with tifffile.TiffFile(path, mode="r+b") as file:
        file.pages.first.tags["Compression"].overwrite(7)


def mosaic(path: Path) -> None:
    counts = scene().astype(float)
    counts[::2, ::2] *= 0.5
    counts[1::2, 1::2] *= 0.25
    np.save(path, np.rint(counts).astype(np.uint16))


def small_dark(folder: Path) -> list[str]:
    np.save(folder / "dark.npy", np.zeros((48, 128), np.uint16))
    return reconstruct(folder, "--dark", str(folder / "dark.npy"))


def unknown_table(folder: Path) -> list[str]:
    (folder / "head.toml").write_text('name = "bench"\n[object]\nkind = "retina"\n')
    return reconstruct(folder, "--head", str(folder / "head.toml"))


WRONG_INPUTS = (
    WrongInput("no such raw", raw_of("none.tiff"), "No such file"),
    WrongInput("empty raw", raw_of("empty.tiff", Path.touch), "is empty"),
    WrongInput("text as png", raw_of("a.png", lambda path: path.write_text("text\n" * 9)), "not a whole png"),
    WrongInput("half a tiff", raw_of("cut.tiff", cut), "not a whole tiff"),
    WrongInput("unknown ending", raw_of("raw.bmp", lambda path: path.write_bytes(b"BM")), "not one of"),
    WrongInput("folder as raw", raw_of("raw.tiff", Path.mkdir), "cannot be read"),
    WrongInput("one line of pixels", raw_of("line.npy", saved(np.arange(99))), "rows and columns"),
    WrongInput("fourth channel, npy", raw_of("four.npy", saved(four_channels())), "fourth channel"),
    WrongInput(
        "fourth channel, tiff",
        raw_of("four.tiff", lambda path: tifffile.imwrite(path, four_channels())),
        "alpha channel",
    ),
    WrongInput("transparent png", raw_of("clear.png", transparent), "transparent"),
    WrongInput("three frames as raw", raw_of("stack.npy", saved(np.stack([scene()] * 3))), "holds 3 frames"),
    WrongInput("negative counts", raw_of("signed.npy", saved(scene().astype(np.int32) - 900)), "negative"),
    WrongInput("more than 16 bits", raw_of("long.npy", saved(scene().astype(np.int32) * 99)), "more than 16 bits"),
    WrongInput("NaN everywhere", raw_of("nan.npy", saved(np.full(SHAPE, np.nan))), "not numbers"),
    WrongInput("black frame", raw_of("black.npy", saved(np.zeros(SHAPE, np.uint16))), "no signal"),
    WrongInput("saturated frame", raw_of("white.npy", saved(np.full(SHAPE, 4095, np.uint16))), "is saturated"),
    WrongInput(
        "nearly all at one maximum", raw_of("glare.npy", saved(np.minimum(scene(), 21))), "have the highest value, 21"
    ),
    WrongInput(
        "clipped below full scale", raw_of("clipped.npy", saved(np.minimum(scene(), 900))), "too bright", noted=True
    ),
    WrongInput("saturated flat frame", clipped_flat, "the flat frame is saturated in", noted=True),
    WrongInput(
        "npz of two arrays", raw_of("two.npz", lambda path: np.savez(path, raw=scene(), psf=caustic())), "raw, psf"
    ),
    WrongInput("compressed dng", raw_of("raw.dng", compressed_dng), "compressed by JPEG"),
    WrongInput(
        "frame of a monochrome sensor labelled as a mosaic",
        raw_of("mono.dng", labelled_dng),
        "labelled as a colour mosaic (bggr)",
        noted=True,
    ),
    WrongInput(
        "picture as raw", raw_of("eye.png", lambda path: path.write_bytes(to_png(scene(), simulated=False))), "sRGB"
    ),
    WrongInput("mosaic without --bayer", raw_of("mosaic.npy", mosaic), "looks like a colour mosaic", noted=True),
    WrongInput("no PSF", lambda folder: reconstruct(folder, psf=None), "either PSFs or a calibration"),
    WrongInput("text as PSF", psf_of("words.npy", np.array([["a", "b"]])), "no raw image"),
    WrongInput("NaN in the PSF", psf_of("nan-psf.npy", np.where(caustic() > 2500, np.nan, caustic())), "not numbers"),
    WrongInput("full PSF", psf_of("full.npy", np.full(SHAPE, 65535, np.uint16)), "is saturated"),
    WrongInput("black PSF", psf_of("zero.npy", np.zeros(SHAPE)), "sums to 0"),
    WrongInput("PSF of another size", psf_of("small.npy", caustic()[::2, ::2]), "48 x 64 pixels, the raw 96 x 128"),
    WrongInput("PSF larger than the raw", psf_of("large.npy", caustic((192, 256))), "192 x 256 pixels, the raw"),
    WrongInput(
        "raw and PSF swapped", lambda folder: reconstruct(folder, raw="psf.npy", psf="raw.npy"), "swapped", noted=True
    ),
    WrongInput(
        "colour PSF of a grey raw",
        psf_of("colour.npy", np.dstack([caustic(), caustic() // 2, caustic() // 3])),
        "were averaged",
        noted=True,
    ),
    WrongInput("dark frame of another size", small_dark, "dark.npy has 48 x 128 pixels, the raw 96 x 128"),
    WrongInput("negative time", option("--budget-s", "-1"), "is not a time"),
    WrongInput("unknown method", option("--method", "magic"), "no method 'magic'"),
    WrongInput("unknown setting", option("--set", "lambda=1"), "no setting 'lambda'"),
    WrongInput("folder that does not exist", option("-o", "DIR/none/x.npy"), "does not exist"),
    WrongInput("unknown table in a head file", unknown_table, "did you mean 'sim.object'?"),
)


def write_right_inputs(folder: Path) -> None:
    """Write the raw and the PSF to which the wrong inputs are added."""
    np.save(folder / "raw.npy", scene())
    np.save(folder / "psf.npy", caustic())


def call(words: list[str]) -> Answer:
    """Run the command line in this process."""
    out, err = io.StringIO(), io.StringIO()
    code: object = 0
    with redirect_stdout(out), redirect_stderr(err):
        try:
            main(words)
        except SystemExit as ended:
            code = ended.code
    return Answer(code, out.getvalue(), without_progress(err.getvalue()))


def row(wrong: WrongInput, folder: Path, words: list[str], answer: Answer) -> str:
    """Return the row of a wrong input as Markdown: name, command, exit status, message. The remedy follows //."""
    typed = " ".join(["diffuscope", *words])
    message = " // ".join(answer.err.strip().splitlines()).replace("|", "/")
    return f"| {wrong.name} | `{typed}` | {answer.code} | {message} |".replace(f"{folder}/", "")


def table(folder: Path) -> str:
    """Return the table of all wrong inputs as Markdown, from a run of each."""
    write_right_inputs(folder)
    asked = [(wrong, wrong.words(folder)) for wrong in WRONG_INPUTS]
    rows = [row(wrong, folder, words, call(words)) for wrong, words in asked]
    return "\n".join([HEADER, *rows]) + "\n"


if __name__ == "__main__":
    with TemporaryDirectory() as temporary:
        TABLE.write_text(table(Path(temporary)), encoding="utf-8")
