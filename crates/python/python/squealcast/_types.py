"""Types that need no compiled code."""

from enum import IntEnum
from typing import NamedTuple


class OperatingPoint(NamedTuple):
    """One set of conditions: normal load, N; disc speed, rad/s; friction coefficient."""

    load_n: float
    speed_rad_s: float
    mu: float


class Level(IntEnum):
    """What a prediction says.

    >>> squealcast.Level(2).name
    'SQUEAL'
    """

    OK = 0
    WARN = 1
    SQUEAL = 2
    FAULT = 3


class Route(IntEnum):
    """How a prediction was made: by an eigenvalue solve, by evaluating a chart, or not at all."""

    SOLVED = 0
    CHARTED = 1
    FAULT = 2


for _type in (OperatingPoint, Level, Route):
    _type.__module__ = "squealcast"
