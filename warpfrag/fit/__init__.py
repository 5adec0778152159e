"""Fitting the parameters of a scene to an image."""

from warpfrag.fit.parameters import FitParameter
from warpfrag.fit.result import FitResult
from warpfrag.fit.run import fit
from warpfrag.fit.session import FitError, Progress
from warpfrag.fit.study import Reference, Study, StudyError, load_study

__all__ = [
    "FitError",
    "FitParameter",
    "FitResult",
    "Progress",
    "Reference",
    "Study",
    "StudyError",
    "fit",
    "load_study",
]
