"""What a training run does on more cores, predicted from costs that are measured here. ``__main__`` is the program."""
