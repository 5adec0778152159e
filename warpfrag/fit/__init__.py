"""Fitting the parameters of a scene to an image."""

from warpfrag.fit.parameters import FitParameter
from warpfrag.fit.result import FitResult, Run, ViewResult
from warpfrag.fit.run import fit
from warpfrag.fit.session import FitError, Progress
from warpfrag.fit.study import Study
from warpfrag.fit.study_file import load_study
from warpfrag.fit.views import Reference, StudyError, View

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
