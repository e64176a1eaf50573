"""Sphinx configuration."""

from sphinx.application import Sphinx

from sliplens import __version__

project = "sliplens"
author = "The sliplens developers"
copyright = "2026, the sliplens developers"
release = version = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
# a field may be named as a builtin is (`object`): which one is meant nobody need say
suppress_warnings = ["ref.python"]
exclude_patterns = ["_build"]
html_theme = "alabaster"
html_theme_options = {"description": "How close a fingertip is to losing its grip, and why.", "page_width": "1080px"}

autodoc_typehints = "description"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
napoleon_numpy_docstring = True
napoleon_google_docstring = False
# Attributes sections repeat what the fields' own lines say
napoleon_use_ivar = True


def setup(app: Sphinx) -> None:
    """Read bars in docstrings as absolute values, |T_n - T_0|, not as substitutions of reStructuredText."""

    def escape(_app: Sphinx, _what: str, _name: str, _obj: object, _options: object, lines: list[str]) -> None:
        lines[:] = [line.replace("|", r"\|") for line in lines]

    app.connect("autodoc-process-docstring", escape)
