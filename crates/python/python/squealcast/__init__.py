"""Predicts friction-induced instability (squeal) of a pad-on-disc tribometer from its operating conditions.

Friction between pad and disc makes the stiffness matrix unsymmetric: as the friction coefficient `mu` rises, the
frequencies of two modes can merge, and from there on one of them grows. A *rig* is a reduced model of pad and disc.
Units are SI and part of every name; arrays of conditions go in, numpy arrays come out.

>>> rig = squealcast.Rig.load("nine-dof-case-2")
>>> found = rig.predict(mu=numpy.linspace(0.0, 0.8, 5))
>>> found.unstable_modes
array([0, 0, 1, 1, 1], dtype=uint32)

The library is that of the program `squealcast`: on the same machine and build, predictions are equal to the last bit,
and errors have the same text.
"""

from ._errors import (
    ChartError,
    ConditionError,
    Error,
    FigureError,
    LiveError,
    PredictionError,
    RecordingError,
    ReductionError,
    RigError,
)
from ._native import (
    Chart,
    Live,
    Predictions,
    Recording,
    Rig,
    Sweep,
    Window,
    Windows,
    __version__,
    embedded_rigs,
    reduce,
)
from ._types import Level, OperatingPoint, Route

__all__ = [
    "Chart",
    "ChartError",
    "ConditionError",
    "Error",
    "FigureError",
    "Level",
    "Live",
    "LiveError",
    "OperatingPoint",
    "PredictionError",
    "Predictions",
    "Recording",
    "RecordingError",
    "ReductionError",
    "Rig",
    "RigError",
    "Route",
    "Sweep",
    "Window",
    "Windows",
    "__version__",
    "embedded_rigs",
    "reduce",
]
