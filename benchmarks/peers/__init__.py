"""Our training beside other trainers: the same task, batch and cores. ``__main__`` is the program."""
