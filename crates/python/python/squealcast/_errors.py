"""The exceptions of the package. Each carries the text that the program prints for the same error."""


class Error(Exception):
    """Any error of squealcast."""

    __module__ = "squealcast"


class RigError(Error, ValueError):
    """A rig file or full model cannot be used: names file, field, value and limit."""

    __module__ = "squealcast"


class ConditionError(Error, ValueError):
    """Conditions or other arguments that cannot be used."""

    __module__ = "squealcast"


class PredictionError(Error):
    """A condition cannot be predicted: out of the rig's limits, or the solver failed."""

    __module__ = "squealcast"


class ChartError(Error):
    """A chart cannot be built."""

    __module__ = "squealcast"


class RecordingError(Error):
    """A recording cannot be opened or holds no rig."""

    __module__ = "squealcast"


class ReductionError(Error):
    """A full model cannot be reduced."""

    __module__ = "squealcast"


class LiveError(Error):
    """Shared memory cannot be used, or no node answers."""

    __module__ = "squealcast"


class FigureError(Error):
    """A figure or table cannot be made."""

    __module__ = "squealcast"
