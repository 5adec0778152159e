"""The versions of what computed a result, free of paths and host names."""

import platform
from importlib.metadata import PackageNotFoundError, version

# Those of them that are installed are listed.
PACKAGES = ("warpfrag", "warp-lang", "numpy", "scipy", "torch")


def package_versions() -> dict[str, str]:
    """Return the versions of Python and of the installed packages that results depend on."""
    versions = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return versions
