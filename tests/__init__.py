"""While tests run, `jaxtyping` checks the shapes in annotations, if `beartype` is installed."""

from importlib.util import find_spec

from jaxtyping import install_import_hook

if find_spec("beartype"):
    checked = [f"stages.core.{folder}" for folder in ("geometry", "scene", "physics", "models")]
    install_import_hook(checked, "beartype.beartype")
