"""One launch script for each trainer, run in the environment of its own."""
