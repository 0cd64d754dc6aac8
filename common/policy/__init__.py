"""The D2RL policy, its normalisers and how they are stored."""
