"""Prints points of scipy's Sobol sequence: sobol_points.py DIMENSIONS POINTS."""

import sys

from scipy.stats import qmc

dimensions, points = int(sys.argv[1]), int(sys.argv[2])
for point in qmc.Sobol(dimensions, scramble=False).random(points):
    print(",".join(repr(float(x)) for x in point))
