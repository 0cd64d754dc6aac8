"""Physics of the ball: flight, bounces, and the times of its contacts. Only numpy and numba."""
