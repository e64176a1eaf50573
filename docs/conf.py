"""Sphinx configuration."""

import inspect
import os
import re
import sys
from pathlib import Path
from types import ModuleType

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util import logging
from sphinx.util.math import get_node_equation_number
from sphinx.writers.html5 import HTML5Translator

import sliplens

project = "sliplens"
author = "The sliplens developers"
copyright = "2026, the sliplens developers"
release = version = sliplens.__version__

sys.path.insert(0, str(Path(__file__).parent))
extensions = [
    "benchmark_tables",
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.intersphinx",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "sphinxcontrib.bibtex",
    "notfound.extension",
]
autosummary_generate = False
# names in backticks are names of the interface wherever they are known
default_role = "py:obj"
# a field may have the name of a builtin (`object`); the warning of two targets is of no use
suppress_warnings = ["ref.python"]
exclude_patterns = ["_build"]

# commands are no Python: what is, says so
highlight_language = "none"
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
bibtex_bibfiles = ["references.bib"]
bibtex_default_style = "plain"
bibtex_reference_style = "author_year"
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True
# a page is read from anywhere, a folder on disk too
notfound_urls_prefix = None

# links into other projects ask their sites for an index: for a build that may, and no page needs them
intersphinx_mapping = (
    {
        "python": ("https://docs.python.org/3", None),
        "numpy": ("https://numpy.org/doc/stable", None),
        "torch": ("https://docs.pytorch.org/docs/stable", None),
        "lightning": ("https://lightning.ai/docs/pytorch/stable", None),
        "captum": ("https://captum.ai/api", None),
    }
    if os.environ.get("SLIPLENS_DOCS_ONLINE")
    else {}
)

html_theme = "pydata_sphinx_theme"
html_title = "sliplens"
html_logo = html_favicon = "_static/logo.svg"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_math_renderer = "mathml"
html_show_sourcelink = False
html_theme_options = {
    "logo": {"text": "sliplens"},
    "show_toc_level": 2,
    "navigation_with_keys": False,
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
    "header_links_before_dropdown": 6,
    "footer_start": ["copyright"],
    "footer_end": [],
}
html_context = {"default_mode": "auto"}
html_sidebars = {"index": []}

autodoc_typehints = "description"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
napoleon_numpy_docstring = True
napoleon_google_docstring = False
# Attributes sections repeat what the fields' own lines say
napoleon_use_ivar = True

sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "gallery",
    "subsection_order": ["../examples/tutorials", "../examples/gallery"],
    "filename_pattern": r"plot_",
    "within_subsection_order": "FileNameSortKey",
    "backreferences_dir": "gallery/backreferences",
    "doc_module": ("sliplens",),
    "download_all_examples": False,
    "min_reported_time": 1e9,
    "junit": "gallery.xml",
    "write_computation_times": False,
    "thumbnail_size": (400, 280),
}


def write_math(translator: HTML5Translator, node: nodes.math | nodes.math_block) -> None:
    """Write a formula as MathML: browsers set it themselves, without a script or a font from anywhere."""
    block = isinstance(node, nodes.math_block)
    try:
        formula = tex2mathml(node.astext(), as_block=block)
    except MathError as error:
        logging.getLogger(__name__).warning("no formula: %s", error, location=node)
        formula = translator.encode(node.astext())
    if block:
        translator.body.append(translator.starttag(node, "div", CLASS="math"))
        if node["number"]:
            translator.body.append(f'<span class="eqno">({get_node_equation_number(translator, node)})')
            translator.add_permalink_ref(node, "Link to this equation")
            translator.body.append("</span>")
        translator.body.append(f"{formula}</div>\n")
    else:
        translator.body.append(formula)
    raise nodes.SkipNode


def load_algorithms() -> dict[str, str]:
    """Command and algorithm of each call as reStructuredText, from the tables of docs/api.md, for docs/api/calls.md."""
    text, facts = (Path(__file__).parent / "api.md").read_text(encoding="utf-8"), {}
    for name, row in re.findall(r"^\| \{py:\w+\}`~(sliplens\.\w+)` \|(.*)\|$", text, flags=re.MULTILINE):
        command, _, purpose = (cell.strip(" `") for cell in row.split("|"))
        algorithm = re.sub(r"\$(.+?)\$", r":math:`\1`", purpose.rpartition(": ")[2]).replace("{cite}", ":cite:")
        algorithm = re.sub(r"\[(.+?)\]\((\w+)\.md(.*?)\)", r"`\1 <../\2.html\3>`__", algorithm)
        facts[name] = f"Command: ``sliplens {command}``. " if command else ""
        if ": " in purpose:
            facts[name] += f"Algorithm: {algorithm}."
    return facts


ALGORITHMS = load_algorithms()


def complete_docstring(_app: Sphinx, what: str, name: str, thing: object, _options: object, lines: list[str]) -> None:
    """Add command and algorithm of a call, exports of a module, and the pages of the gallery that use a name."""
    # bars are absolute values, |T_n - T_0|, not substitutions of reStructuredText
    lines[:] = [re.sub(r"docs/(\w+)\.md", r":doc:`/\1`", line.replace("|", r"\|")) for line in lines]
    if algorithm := ALGORITHMS.get(name):
        summary = lines.index("") if "" in lines else len(lines)
        lines[summary:summary] = ["", algorithm]
    if what == "module" and isinstance(thing, ModuleType):
        names = [
            one
            for one in sorted(getattr(thing, "__all__", [name for name in vars(thing) if not name.startswith("_")]))
            if (inspect.isroutine(getattr(thing, one)) or inspect.isclass(getattr(thing, one)))
            and getattr(getattr(thing, one), "__module__", "").startswith(name)
        ]
        lines[:0] = [f".. rubric:: {name}", ""]
        lines += [".. autosummary::", "   :nosignatures:", "", *(f"   {one}" for one in names), ""]
    # examples name a class by the shortest path that leads to it, whether or not it is exported there
    for used in dict.fromkeys((name, f"sliplens.{getattr(thing, '__name__', '')}")):
        pages = Path(__file__).parent / "gallery" / "backreferences" / f"{used}.examples"
        if what in ("function", "class", "exception") and pages.is_file() and pages.stat().st_size:
            lines += ["", ".. rubric:: Used in the gallery", "", f".. minigallery:: {used}", ""]


def skip_calls(_app: Sphinx, what: str, name: str, thing: object, _skip: bool, _options: object) -> bool | None:
    """Describe what is a name of `sliplens` itself once, among the calls, and not again where it lives."""
    return True if what == "module" and name in sliplens.__all__ and getattr(sliplens, name) is thing else None


def find_described(app: Sphinx, page: str, modules: list[str], name: str) -> tuple[str, str] | None:
    """Name by which a package describes what one of its modules defines, and the link from a page to there."""
    described = app.env.domains.python_domain.objects
    for depth in range(len(modules), 0, -1):
        if (found := described.get(place := ".".join((*modules[:depth], name)))) is not None:
            return place, f"{app.builder.get_relative_uri(page, found.docname)}#{found.node_id}"
    return None


def find_where_exported(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, inner: nodes.Element
) -> nodes.Node | None:
    """Lead from where a name is defined, as types name it, to the package that exports and describes it."""
    *modules, name = str(node.get("reftarget", "")).split(".")
    if node.get("refdomain") != "py" or not name:
        return None
    # a type that is imported for the type checker alone, or a name in words, stands without its module
    modules = modules or str(node.get("py:module", "sliplens")).split(".")
    described = env.domains.python_domain.objects
    classes = [place for place, one in described.items() if place.endswith(f".{name}") and one.objtype == "class"]
    found = find_described(app, node.get("refdoc", ""), modules, name)
    if found is None and len(classes) == 1:
        found = find_described(app, node.get("refdoc", ""), classes[0].split(".")[:-1], name)
    return found and nodes.reference("", "", inner, internal=True, refuri=found[1], reftitle=found[0])


def lead_back(app: Sphinx, page: str, _template: str, context: dict[str, str], _tree: nodes.document | None) -> None:
    """Lead from the source to where a name is described; viewcode takes one package for all names of a module."""

    def link(match: re.Match[str]) -> str:
        *_, owner, name = match[1].split(".")
        modules = page.split("/")[1:]
        found = find_described(app, page, modules, f"{owner}.{name}") or find_described(app, page, modules, name)
        return f'href="{found[1]}"' if found else match[0]

    if page.startswith("_modules/sliplens/"):
        context["body"] = re.sub(r'href="[^"#]*#(sliplens\.[\w.]+)"', link, context["body"])


def setup(app: Sphinx) -> None:
    """Add formulas without a script, and links that autodoc alone does not find."""
    app.add_html_math_renderer("mathml", (write_math, None), (write_math, None))
    app.connect("autodoc-process-docstring", complete_docstring)
    app.connect("autodoc-skip-member", skip_calls)
    app.connect("missing-reference", find_where_exported)
    app.connect("html-page-context", lead_back)
