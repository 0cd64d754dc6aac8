"""Ball physics: flight, bounces, and what the ball touches when. Pure numpy and numba."""
