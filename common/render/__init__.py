"""Pictures of rallies: recording (plain values), a scene, stills and film.

Nothing else in the project needs a display, OpenGL, PIL or ffmpeg: they are imported here, when a picture is
made, and what is missing is named in one line (``pip install -e '.[report]'``).
"""
