"""Bytes that nobody meant: every decoder and every file reader gets them, and may only refuse.

* ``targets``: what reads bytes, with valid examples and the error that refuses: one table
* ``message_examples``: a valid message of every type
* ``__main__``: one process for each target, in which Atheris looks for inputs that reach new lines of code
"""
