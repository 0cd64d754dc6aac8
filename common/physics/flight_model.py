"""The models of the ball's aerodynamics by name: `common.physics.flight` has their coefficients."""

from enum import IntEnum


class Flight(IntEnum):
    """Model of the aerodynamic coefficients."""

    SIMPLE = 0
    FULL = 1
    LINEAR = 2  # the simple model's form with coefficients fitted to the full one: what an observer assumes
