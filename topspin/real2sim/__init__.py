"""Recordings of real balls, played with a policy: ``topspin real2sim --data PATH``.

==============  ==============================================================================
``config``      settings
``formats``     files -> states and tracks in the world frame and SI
``fit``         a track -> the launch that explains it
``replay``      recorded balls as rallies
``kinematic``   tracks as paths that drive their balls
``dataset``     files -> rallies, with counts of what was dropped and errors of the fits
``play``        plays the rallies, measures, and writes the outputs
``figures``     one recording: detections, estimate and ball, in space and by axis (matplotlib)
``page``        tables and plots -> report.md and report.html, with the code of ``topspin/report``
``command``     the command line
==============  ==============================================================================
"""
