"""Sphinx configuration of the documentation: `make site` builds it into out/site, where every warning is an error.

`build` copies the pages, the notes of formulas and the decision records into one folder, in which this file then is.
Nothing is loaded from the network, neither by the build nor by the pages.
"""

import re
import sys
from importlib.metadata import version as installed_version
from pathlib import Path

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment

REPOSITORY = Path(__file__).resolve().parents[3]
GALLERY = REPOSITORY / "services" / "research" / "site" / "gallery"

sys.path.insert(0, str(Path(__file__).parent))  # Sphinx-Gallery imports `gallery_order`

project = "Diffuscope"
author = "The Diffuscope authors"
project_copyright = "The Diffuscope authors, BSD-3-Clause"
version = release = installed_version("diffuscope")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_gallery.gen_gallery",
]
source_suffix = {".rst": "restructuredtext", ".md": "markdown"}
exclude_patterns = ["requirements.*", "pypi.md"]  # pypi.md: page of the package index
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3

default_role = "code"  # docstrings write names in single backticks
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
napoleon_google_docstring = False
napoleon_use_ivar = True  # fields are listed in the class; a member of its own would stand there twice
napoleon_use_rtype = False
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88

html_theme = "furo"
html_title = f"Diffuscope {release}"
html_static_path = ["static"]
html_css_files = ["diffuscope.css"]
html_copy_source = False
html_show_sphinx = False
smartquotes = False  # `--psf` stays as it is typed
templates_path: list[str] = []

sphinx_gallery_conf = {
    "examples_dirs": [str(GALLERY)],
    "gallery_dirs": ["gallery"],
    "filename_pattern": r"\.py$",  # every script is run
    "within_subsection_order": "gallery_order.order",
    "abort_on_example_error": True,
    "capture_repr": (),  # what a script prints, not the value of its last line
    "download_all_examples": True,
    "min_reported_time": 1,
    "remove_config_comments": True,
    "show_memory": False,
    "write_computation_times": False,  # its page would load scripts from another host
    "show_signature": False,
    "reset_modules": ("matplotlib",),
    "image_srcset": ["2x"],
    "matplotlib_animations": False,
}


def name_source_file(
    _: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.TextElement
) -> nodes.TextElement | None:
    """Return the text of a link to a file or folder of the repository that is no page; None reports a broken link."""
    target = str(node.get("reftarget", "")).split("#")[0]
    folder = Path(node.get("refdoc", env.docname)).parent
    bases = (REPOSITORY / folder, REPOSITORY / "services" / "research" / "site" / folder)
    return content if target and any((base / target).exists() for base in bases) else None


def shorten_types(
    _: Sphinx, what: str, name: str, thing: object, options: object, signature: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    """Return a signature with the names of the project for types of arrays, and `...` for the default of a factory."""
    array = r"(?:~numpy\.)?ndarray\[tuple\[(?:~typing\.)?Any, \.\.\.\], (?:~numpy\.)?dtype\[(?:~\w+\.)?{}\]\]"
    image = array.format("float32")
    source = r"str \| (?:~pathlib\.)?Path \| " + array.format("Any")
    names = ((source, "ImageSource"), (image, "Image"), ("<factory>", "..."))  # `<` ends the parsing of a signature
    texts = [signature, returns]
    for pattern, short in names:
        texts = [text and re.sub(pattern, short, text) for text in texts]
    return texts[0], texts[1]


def setup(app: Sphinx) -> None:
    """Connect the handlers of links to source files and of signatures."""
    app.connect("autodoc-process-signature", shorten_types)
    app.connect("missing-reference", name_source_file)
