"""What the task is, said once: states, reward, observation, launches, randomization. numpy and numba only."""
