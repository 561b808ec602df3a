from __future__ import annotations

import inspect
from importlib.metadata import version as installed_version

project = "torchrl-aca"
author = "The torchrl-aca authors"
copyright = f"2026, {author}"
release = version = installed_version(project)

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.intersphinx",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx-mathjax-offline",  # ships MathJax and its fonts: formulas need no network
]
exclude_patterns = ["_build"]
default_role = "literal"  # docstrings of `training` have single backticks
html_theme = "furo"
html_title = f"torchrl-aca {release}"

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True  # an attribute that is a property too is not described twice
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"

# Links into other projects need their inventories from the network. The warning about an inventory
# that cannot be fetched has no type, so `suppress_warnings` does not reach it and `-W` makes it an
# error. Hence a tag says that there is a network: `make docs ARGS="-t online"`.
if tags.has("online"):  # noqa: F821 (Sphinx puts `tags` into this file's namespace)
    intersphinx_mapping = {
        "python": ("https://docs.python.org/3", None),
        "torch": ("https://docs.pytorch.org/docs/stable", None),
        "tensordict": ("https://docs.pytorch.org/tensordict/stable", None),
        "torchrl": ("https://docs.pytorch.org/rl/stable", None),
    }


def show_constructor(app, what, name, obj, options, signature, returns):
    """Give classes their constructor's signature where a metaclass of TorchRL hides it."""
    if what == "class" and signature == "(*args, **kwargs)":
        parameters = list(inspect.signature(obj.__init__).parameters.values())[1:]
        bare = [parameter.replace(annotation=inspect.Parameter.empty) for parameter in parameters]
        return str(inspect.Signature(bare)), returns
    return signature, returns


def setup(app):
    app.connect("autodoc-process-signature", show_constructor)
