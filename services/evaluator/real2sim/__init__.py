"""Recorded balls against a policy: ``python -m services.evaluator real2sim --data PATH``.

==============  ==============================================================================
``config``      settings
``recorded``    files -> recorded balls as rallies, with what was dropped and how well fits fit
``command``     plays them, measures, and writes what was asked for
``figures``     one recording: shots, estimate and ball, in space and by axis (matplotlib)
``page``        tables and plots -> report.md and report.html, by the machinery of ``report/``
==============  ==============================================================================
"""
