"""Recipe of the card in rpi-image-gen itself: its linter, its pipeline and its hook before the image.

Runs where a checkout of rpi-image-gen is beside this one; it needs no network and builds no root file system.
"""

import os
import re
import subprocess
from pathlib import Path

import pytest

from tests.project_files import ROOT

pytestmark = pytest.mark.systemd
CARD = ROOT / "systemd/image/card"
TREE = ROOT.parent / "rpi-image-gen"
LAYERS = ("essential", "rpi5", "diffuscope-card", "diffuscope")
# What rpi-image-gen sets before it resolves the layers.
HOST = """
DEB_BUILD_ARCH="arm64"
DEB_BUILD_GNU_TYPE="aarch64-linux-gnu"
DEB_HOST_ARCH="arm64"
DEB_HOST_GNU_TYPE="aarch64-linux-gnu"
TOOLCHAIN_MODE="native"
"""
PINNED = dict(re.findall(r"(tag|commit)=(\S+)", (CARD / "build").read_text()))
needs_tree = pytest.mark.skipif(not (TREE / "bin/ig").exists(), reason=f"no rpi-image-gen {PINNED['tag']} beside")


def run(*words: object, **more: str) -> str:
    """Run a program of rpi-image-gen with Debian's Python, which has its modules; return its output."""
    environment = {"PATH": f"{TREE}/bin:/usr/bin:/bin:/usr/sbin:/sbin"} | more
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, env=environment, cwd=TREE)
    assert done.returncode == 0, f"{' '.join(map(str, words))}: {done.stdout}{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The order of the layers, as rpi-image-gen resolves them."""
    here = tmp_path_factory.mktemp("plan")
    (here / "overrides").write_text(f"IGconf_diffuscope_keys={here}\n")
    (here / "layer").mkdir()
    paths = f"{CARD}/config:{TREE}/config"
    words = "config", "--path", paths, CARD / "config/diffuscope.yaml", "--overrides", here / "overrides"
    run("ig", *words, "--write-to", here / "user")
    own = "".join(
        f'{name}="{value}"\n'
        for name, value in {
            "IGTOP": TREE,
            "IGROOT": TREE,
            "LAYER_HOOKS": TREE / "layer-hooks",
            "RPI_TEMPLATES": TREE / "templates/rpi",
            "DYNROOT": here,
            "SRCROOT": CARD,
        }.items()
    )
    registry = run("ig", "metadata", "--emit", "registry.defs")
    (here / "env").write_text(registry + (here / "user").read_text() + HOST + own)
    folders = {
        "DYNlayer": here / "layer",
        "SRCimage": CARD / "image",
        "SRClayer": CARD / "layer",
        "IGdevice": TREE / "device",
        "IGimage": TREE / "image",
        "IGlayer": TREE / "layer",
    }
    path = ":".join(f"{name}={folder}" for name, folder in folders.items())
    outputs = "--env-out", here / "resolved", "--plan-out", here / "plan"
    run("ig", "pipeline", "--env-in", here / "env", "--layers", *LAYERS, "--path", path, *outputs)
    return here / "plan"


@needs_tree
@pytest.mark.parametrize("name", ["layer/diffuscope.yaml", "image/diffuscope-card.yaml"])
def test_the_linter_accepts_our_layers(name: str) -> None:
    run("ig", "metadata", "--lint", CARD / name)


@needs_tree
def test_the_pipeline_resolves_every_layer(plan: Path) -> None:
    order = [line.split(":")[0] for line in plan.read_text().splitlines()]
    assert order[-1] == "diffuscope", "after all that it needs"
    assert {"rpi5", "diffuscope-card", "debian-trixie-arm64-multi", "rpi-debian-trixie", "network-manager"} <= set(
        order
    )


@needs_tree
def test_the_hook_before_the_image_lays_out_the_card(plan: Path, tmp_path: Path) -> None:
    """Without it this version builds a root, makes no image, and returns 0."""
    for name in ("root", "out"):
        (tmp_path / name).mkdir()
    folders = {
        "IGTOP": TREE,
        "SRCROOT": CARD,
        "IGconf_image_assetdir": CARD / "image",
        "IGconf_target_path": tmp_path / "root",
        "IGconf_device_assetdir": TREE / "device" / "pi5",
        "IGconf_image_outputdir": tmp_path / "out",
    }
    run("bash", "bin/runner", "pre-image", plan, **{name: str(folder) for name, folder in folders.items()})
    assert (tmp_path / "out/genimage.cfg").read_text() == (CARD / "image/genimage.cfg").read_text()


def stand_in(folder: Path, body: str) -> Path:
    """Create a checkout of rpi-image-gen whose program is `body`; return its path."""
    tree = folder / "rpi-image-gen"
    tree.mkdir()
    (tree / "rpi-image-gen").write_text(f"#!/bin/sh\n{body}")
    (tree / "rpi-image-gen").chmod(0o755)
    (folder / "ca.crt").touch()
    (folder / "bin").mkdir()
    (folder / "bin/git").write_text(f"#!/bin/sh\necho {PINNED['commit']}\n")
    (folder / "bin/git").chmod(0o755)
    return tree


def build(folder: Path, tree: Path) -> subprocess.CompletedProcess[str]:
    path = {"PATH": f"{folder}/bin:{os.environ['PATH']}:/usr/sbin:/sbin"}
    words = [str(CARD / "build"), str(tree), str(folder), str(folder / "card.img")]
    return subprocess.run(words, capture_output=True, text=True, env=os.environ | path, check=False)


def test_a_build_without_an_image_is_an_error(tmp_path: Path) -> None:
    """Defect 10: rpi-image-gen returned 0."""
    done = build(tmp_path, stand_in(tmp_path, "exit 0\n"))
    assert done.returncode == 1
    assert "ended without an image" in done.stderr
    assert not (tmp_path / "card.img").exists()


def test_another_version_of_rpi_image_gen_is_refused(tmp_path: Path) -> None:
    tree = stand_in(tmp_path, "exit 0\n")
    (tmp_path / "bin/git").write_text("#!/bin/sh\necho 0123456789\n")
    done = build(tmp_path, tree)
    assert done.returncode == 1
    assert f"checkout {PINNED['commit']}" in done.stderr
