"""Fitting the parameters of a scene to an image."""

from warpfrag.fit.parameters import FitParameter
from warpfrag.fit.result import FitResult, Run, ViewResult
from warpfrag.fit.run import fit
from warpfrag.fit.session import FitError, Progress
from warpfrag.fit.study import Reference, Study, StudyError, View
from warpfrag.fit.study_file import load_study

__all__ = [
    "FitError",
    "FitParameter",
    "FitResult",
    "Progress",
    "Reference",
    "Run",
    "Study",
    "StudyError",
    "View",
    "ViewResult",
    "fit",
    "load_study",
]
