"""`topspin view`: a live page in 3-D that shows the robot play.

What the page shows is a function of values: ``ball`` (the sliders' ball), ``playback`` (the clock of a ball's show),
``picture`` (bodies, trail, spin, prediction), ``score``, ``curves`` and ``words`` (texts). ``stage`` and ``panel`` put
them into a browser by viser, and ``command`` has the loop.
"""
