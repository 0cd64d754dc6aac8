"""The robot's perception of the ball: camera, filters, and the posterior of the spin. Only numpy and numba."""
