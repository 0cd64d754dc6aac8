"""Pictures of rallies: recording (plain values), a scene, stills and film.

The rest of the project does not need OpenGL, PIL or ffmpeg, and nothing needs a display. They are imported here when a
picture is made, and an error names a missing one in one line (``pip install -e '.[report]'``).
"""
