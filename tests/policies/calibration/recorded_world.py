"""The recorded world of the tests of the calibration, and the effort of their fits."""

from gelflow.policies.calibration.fit import FitSettings

WORLD = 8  # all five parts are inserted, with little noise
LITTLE = FitSettings(starts=1, members=24, nearby=16, poses=8, steps=1)
