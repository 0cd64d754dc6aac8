"""The report: what runs came to, as a page with tables and plots, beside the paper's results.

``python -m services.evaluator report RUN...`` plays each run's policy on the same fixed rallies, takes runs that
differ in nothing but their seed together, and writes report.md, report.html, results.json and the plots.

==============  ==============================================================================
``config``      settings
``collect``     run folders -> values: settings, curves, policy
``groups``      which runs are one experiment, and what to call it
``origin``      how it was made: commands, versions, machine
``results``     plays the policies, measures, and holds every number; results.json is that
``tables``      results -> tables
``figures``     results -> plots; the only file with matplotlib
``page``        tables and plots -> report.md and report.html (``page.html.j2``; the only file with jinja2)
``command``     the command line
==============  ==============================================================================

matplotlib and jinja2 come with ``pip install -e '.[report]'``; nothing outside of this package imports them.
"""
