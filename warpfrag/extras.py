"""Optional dependencies: imported where they are used, and named when they are missing."""

import importlib
from types import ModuleType


def need(module: str, extra: str, purpose: str) -> ModuleType:
    """Import a module that one of the package's extras brings.

    Args:
        module: what to import.
        extra: the extra of `warpfrag` that installs it.
        purpose: what it is needed for, as the beginning of a sentence.

    Raises:
        ImportError: it is not installed; the message says how to install it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        # A module that is there but cannot load says why itself.
        if getattr(error, "name", None) not in (None, module, package):
            raise
        raise ImportError(f"{purpose} needs {package}, which is missing: pip install 'warpfrag[{extra}]'") from error
