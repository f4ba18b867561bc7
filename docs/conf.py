"""Settings of Sphinx; `make docs` builds the site. Pages are found by their places in the repository, so links hold."""

import re
from pathlib import Path
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

project = "cconv"
copyright = "the authors of cconv"
root_doc = "docs/index"
include_patterns = ["docs/**", "README.md", "CHANGELOG.md", "experiments/README.md", "search_spaces/README.md"]
include_patterns += ["experiments/cluster/README.md", "experiments/benchmarks/results/**/claims.md"]
exclude_patterns = [".venv", ".git", "runs", "site", "cconv", "tests", "**.egg-info", "build", "dist"]

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_heading_anchors = 4
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings give shapes and units
napoleon_use_ivar = True
napoleon_custom_sections = [("Returns", "params_style")]

highlight_language = "none"  # of blocks that name no language: commands

html_theme = "furo"
html_title = "cconv"
html_extra_path = ["front"]
html_static_path: list[str] = []
html_math_renderer = "mathml"  # shown by the browser itself: nothing is fetched


def _formula(translator: Any, node: nodes.Element, display: str) -> None:
    translator.body.append(convert(node.astext(), display=display))
    raise nodes.SkipNode


def _inline(translator: Any, node: nodes.Element) -> None:
    _formula(translator, node, "inline")


def _block(translator: Any, node: nodes.Element) -> None:
    _formula(translator, node, "block")


def _refuse_foreign(app: Sphinx, error: Exception | None) -> None:
    """Refuse a site that fetches scripts, styles, fonts or pictures from elsewhere when a page is opened."""
    fetched = re.compile(
        r"""<(?:script|img|iframe|link)[^>]*(?:src|href)=["'](?:https?:)?//|url\(["']?(?:https?:)?//"""
    )
    for path in [path for path in Path(app.outdir).rglob("*") if path.suffix in (".html", ".css")]:
        if error is None and (found := fetched.search(path.read_text(encoding="utf-8"))):
            raise ExtensionError(f"{path}: fetches something from another server: {found[0]}")


def setup(app: Sphinx) -> dict[str, bool]:
    """Register formulas as MathML, and the check that pages need no network."""
    app.connect("build-finished", _refuse_foreign)
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    return {"parallel_read_safe": True}
