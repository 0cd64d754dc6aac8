"""The rules of the task: states, touches, outcomes, launches, reward and layouts. Pure numpy and numba."""
