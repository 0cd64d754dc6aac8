"""Topspin's libraries, and the conventions that every file of the project keeps.

Frames
    The world is the table frame: origin at the centre of the table **top**, x from the robot to the
    opponent, y to the robot's left, z up. The robot's court is x in [-1.37, 0], the opponent's [0, 1.37],
    |y| <= 0.7625; the floor is z = -0.76. Any other frame stands in a name (``ball_vel_in_racket``).
Units
    SI and radians, without suffix. A suffix where a person types the number or where it isn't SI
    (``timeout_s``, ``rate_hz``).
Arrays
    Batch first. Physics float64 ``(..., 3)``; rollouts float32 ``[T, B]``; quaternions (w, x, y, z), w >= 0.
Layers
    Imports go down only: topspin > deploy > services > common. Services never import each other. Inside common:
    evaluation > env > rally > perception, policy > task > service > comms, physics > jit, errors.
    ``physics``, ``task``, ``perception`` and ``rally`` use numpy and numba, and pydantic for settings. Other
    libraries have one place each: msgpack in ``comms/codec.py``, Zenoh in ``comms/zenoh_transport.py``, Prometheus
    in ``service/metrics.py``, MuJoCo in ``env/`` (its renderer in ``topspin/render/``), torch in ``policy/``, the
    learner and the actor. Plots, pages, films, fits, ONNX and Gymnasium are in ``topspin/`` alone.
"""
