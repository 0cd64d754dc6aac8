"""What the traffic of a run costs as it grows. ``__main__`` is the program."""
